"""What stands at one place of a message: checks by the type of the field, and what is wrong as a refusal."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dsse_core.printable import shortened

LARGEST_COUNT = 2**53  # and of integers the largest size: exact as a float, too
LONGEST_NAME = 300  # characters of the name of a run, an area or a meter, and of every key of a map
LONGEST_NOTE = 1000  # characters
MOST_NOTES = 50


class MessageError(ValueError):
    """A payload that is not a message of this version; ``reason`` is the short word under which it is counted."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        super().__init__(f"{reason}: {detail}")


def is_worth_writing(count: int) -> bool:
    """Of refusals the 1st, 10th, 100th, ...: a flood must not fill the disk."""
    return str(count).strip("0") == "1"


def shown(value: object) -> str:
    """``value`` in at most 80 printable characters, however long or deep it is."""
    return ascii(reprlib.repr(value))[1:-1][:80]


def limit_notes(notes: Sequence[str]) -> tuple[str, ...]:
    """``notes`` as a message may carry them: long ones cut off, and of many the first and how many more there are."""
    kept = tuple(shortened(note, LONGEST_NOTE) for note in notes)
    return kept if len(kept) <= MOST_NOTES else (*kept[: MOST_NOTES - 1], f"and {len(kept) - MOST_NOTES + 1} more")


def check_name(name: str, value: object) -> str:
    return _check_text(name, value, LONGEST_NAME)


def check_note(name: str, value: object) -> str:
    return _check_text(name, value, LONGEST_NOTE)


def _check_text(name: str, value: object, longest: int) -> str:
    if not isinstance(value, str) or len(value) > longest:
        raise MessageError("malformed", f"{name} is {shown(value)}, not a text of at most {longest} characters")
    return value


def check_count(name: str, value: object) -> int:
    if type(value) is not int or not 0 <= value < LARGEST_COUNT:
        raise MessageError("malformed", f"{name} is {shown(value)}, not a count")
    return value


def check_integer(name: str, value: object) -> int:
    if type(value) is not int or abs(value) >= LARGEST_COUNT:
        raise MessageError("malformed", f"{name} is {shown(value)}, not an integer")
    return value


def check_number(name: str, value: object) -> float:
    if type(value) not in (int, float):
        raise MessageError("malformed", f"{name} is {shown(value)}, not a number")
    number = float(value)  # type: ignore[arg-type]
    if not math.isfinite(number):
        raise MessageError("not finite", f"{name} is {shown(value)}")
    return number


def check_flag(name: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise MessageError("malformed", f"{name} is {shown(value)}, not true or false")
    return value


def tuple_of(
    check: Callable[[str, object], Any], length: int | None = None
) -> Callable[[str, object], tuple[Any, ...]]:
    def check_all(name: str, value: object) -> tuple[Any, ...]:
        if not isinstance(value, tuple) or (length is not None and len(value) != length):
            raise MessageError(
                "malformed", f"{name} is {shown(value)}, not an array" + (f" of {length}" if length else "")
            )
        return tuple(check(name, item) for item in value)

    return check_all


def check_numbers(name: str, value: object) -> tuple[float, ...]:
    """As ``tuple_of(check_number)``; states are long, and nearly all are finite floats whose sum is finite, too."""
    if isinstance(value, tuple) and set(map(type, value)) <= {float} and math.isfinite(sum(value)):
        return value
    return tuple_of(check_number)(name, value)


def check_names(name: str, value: object) -> tuple[str, ...]:
    """As ``tuple_of(check_name)``, for the many names of a scan."""
    if isinstance(value, tuple) and set(map(type, value)) <= {str} and max(map(len, value), default=0) <= LONGEST_NAME:
        return value
    return tuple_of(check_name)(name, value)


def check_notes(name: str, value: object) -> tuple[str, ...]:
    notes = tuple_of(check_note)(name, value)
    if len(notes) > MOST_NOTES:
        raise MessageError("malformed", f"{len(notes)} {name}, the limit is {MOST_NOTES}")
    return notes


def map_of(check: Callable[[str, object], Any]) -> Callable[[str, object], dict[str, Any]]:
    def check_all(name: str, value: object) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise MessageError("malformed", f"{name} is {shown(value)}, not a map")
        return {check_name(name, key): check(name, item) for key, item in value.items()}

    return check_all


CHECKS: Mapping[str, Callable[[str, object], Any]] = {  # by the annotation of the field
    "bool": check_flag,
    "float": check_number,
    "int": check_count,
    "Integer": check_integer,
    "str": check_name,
    "Notes": check_notes,
    "tuple[float, ...]": check_numbers,
    "tuple[int, ...]": tuple_of(check_count),
    "tuple[str, ...]": check_names,
    "dict[str, int]": map_of(check_count),
    "dict[str, float]": map_of(check_number),
    "dict[str, tuple[int, int]]": map_of(tuple_of(check_count, 2)),
}
