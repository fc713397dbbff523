"""Types of the values in a message, which msgspec checks, and the error of a payload that is rejected."""

from __future__ import annotations

import reprlib
import sys
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from dsse_core.limits import LARGEST_BUS
from dsse_core.printable import shortened
from dsse_core.split_identity import DIGITS

LARGEST_COUNT = 2**53  # and of integers the largest size: exact as a float, too
LONGEST_NAME = 300  # characters of the name of a run, an area or a meter, and of every key of a map
LONGEST_NOTE = 1000  # characters
MOST_NOTES = 50

Count = Annotated[int, Meta(ge=0, lt=LARGEST_COUNT)]
BusId = Annotated[int, Meta(ge=-LARGEST_BUS, le=LARGEST_BUS)]  # numbers that a file may give a bus
Integer = Annotated[int, Meta(gt=-LARGEST_COUNT, lt=LARGEST_COUNT)]
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]  # finite: nan is not within, either
Name = Annotated[str, Meta(max_length=LONGEST_NAME)]
Note = Annotated[str, Meta(max_length=LONGEST_NOTE)]  # sentences; other texts in a message are names
Digest = Annotated[str, Meta(max_length=DIGITS, pattern="^[0-9a-f]*$")]
Numbers = tuple[Number, ...]
PerPhase = Annotated[tuple[Number, ...], "of each phase, in a message one number alone"]
Names = tuple[Name, ...]
Notes = Annotated[tuple[Note, ...], Meta(max_length=MOST_NOTES)]


class MessageError(ValueError):
    """A payload that is not a message of this version; ``reason`` is the short word under which it is counted.

    ``at_field``: the field that does not fit this version, and what is wrong there; empty for other reasons than
    "malformed" and "not finite".
    """

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.at_field = detail if reason in ("malformed", "not finite") else ""
        super().__init__(f"{reason}: {detail}")


def should_log(count: int) -> bool:
    """True for the 1st, 10th, 100th, ... rejection: a flood of them must not fill the disk."""
    return str(count).strip("0") == "1"


def shown(value: object) -> str:
    """``value`` in at most 80 printable characters, however long or deep it is."""
    return ascii(reprlib.repr(value))[1:-1][:80]


def limit_notes(notes: Sequence[str]) -> tuple[str, ...]:
    """``notes`` as a message may carry them: long ones cut off, and of many the first and how many more there are."""
    kept = tuple(shortened(note, LONGEST_NOTE) for note in notes)
    return kept if len(kept) <= MOST_NOTES else (*kept[: MOST_NOTES - 1], f"and {len(kept) - MOST_NOTES + 1} more")
