"""Checks of the rows of a recording's tables by the types of the wire, before the rows are used."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from agents.messages.checks import BusId, Count, Digest, Integer, MessageError, Name, Names, Notes, Number, shown
from agents.messages.keys import NAME
from agents.messages.packing import MAX_BYTES, ReadingsMessage, StateMessage
from dsse_core.errors import InvalidInputError
from dsse_core.grid.nodes import ANY_PHASE

LATEST = 253_402_300_800.0  # s since 1970: the year 10000, where calendars end; so long before 1970 is the earliest
LARGEST_ANGLE = math.radians(sys.float_info.max)  # rad, a number in degrees, too
LONGEST_TEXT = 6 * MAX_BYTES  # characters of JSON: the largest message of the bus, each byte as an escape

Time = Annotated[float, Meta(ge=-LATEST, lt=LATEST)]
AnyName = Annotated[str, Meta(pattern=rf"\A{NAME.pattern}\Z")]  # of a run or an area
Process = Annotated[str, Meta(pattern=r"\A[0-9a-f]{1,14}-[0-9a-f]{8,14}\Z")]  # an incarnation
Phase = Annotated[str, Meta(pattern=rf"\A({ANY_PHASE})\Z")]
Details = Annotated[str, Meta(max_length=LONGEST_TEXT)]

_WHOSE = {"time": Time, "scan": Count, "area": AnyName, "incarnation": Process}
_READING = {
    "sequence": Count,
    "taken_at": Time,
    "meter": Name | None,
    "value": Number | None,
    "sigma": Number | None,
    "measured_at": Time | None,
    "estimate": Number | None,
    "normalised_residual": Number | None,
}
TYPES: Mapping[str, Mapping[str, Any]] = {
    "states": _WHOSE
    | {
        "estimate": Count,
        "final": bool,
        "sequence": Count,
        "sent_at": Time,
        "taken_at": Time | None,
        "quality": Name,
        "notes": Notes,
        "estimated": bool,
        "referenced": bool,
        "checked": bool,
        "objective": Number | None,
        "degrees_of_freedom": Integer | None,
        "removed": Names,
        "critical": Names,
        "meters_off": Names,
        "switches": Details | None,
        "taps": Details | None,
        "telemetry_age_s": Number,
        "oldest_reading_s": Number,
        "messages": Count,
        "bytes": Count,
        "lost": Count,
        **dict.fromkeys(("rejected", "faults", "ages_s", "scans", "clock_skews_s"), Details),
        "old_sides": Names,
        "split": Digest | None,
        "split_at": Time | None,
        "split_edited": Digest | None,
    },
    "buses": _WHOSE
    | {
        "estimate": Count,
        "bus": BusId,
        "phase": Phase | None,
        "vm_pu": Number,
        "va_deg": Number | None,
        "sigma_vm_pu": Number,
        "sigma_va_deg": Number | None,
    },
    "readings": _WHOSE | _READING,
    "events": {"time": Time | None, "event": Name, "role": Name, "name": Name, "details": Details},
}
"""Table -> column that is read back -> type of its values."""
_GIVEN = ("value", "sigma", "measured_at")  # of each meter
_DESCRIBED = ("estimate", "normalised_residual")  # together or not at all
_ONCE = {"readings": ("time", "area", "incarnation", "sequence"), "buses": ("time", "area", "incarnation", "estimate")}
"""Table -> columns of the message that a row is of, in which each meter or node stands once."""
_ID = {"readings": ("meter",), "buses": ("bus", "phase")}
_PLACE = re.compile(r"^(.*) - at `\$\[([0-9]+)\]\[([0-9]+)\](.*)`$", re.DOTALL)


class RowCheck:
    """Check of the rows of one file, batch by batch in their order. ``columns``: those of ``table`` that are read."""

    def __init__(self, path: Path, table: str, columns: Sequence[str]) -> None:
        self._path = path
        types = TYPES.get(table, {})
        self._type: Any = list[tuple[tuple(types.get(name, Any) for name in columns)]]  # type: ignore[misc]
        self._columns = tuple(columns)
        self._count = 0  # of rows up to now
        place = {name: k for k, name in enumerate(columns)}
        once = place.keys() >= {*_ID.get(table, ("",))[:1], *_ONCE.get(table, ())}
        self._id = [place[name] for name in _ID.get(table, ()) if name in place]
        self._message = itemgetter(*(place[name] for name in _ONCE[table])) if table in _ID and once else None
        self._given = [place[name] for name in _GIVEN if table == "readings" and name in place and "meter" in place]
        self._described = [place[name] for name in _DESCRIBED if table == "readings" and name in place]
        self._last: tuple[Any, ...] = ()
        self._seen: set[Any] = set()

    def check(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Checks that ``rows``, which follow those of the last call, are rows that a recorder writes.

        Raises:
            InvalidInputError: naming file, row and column.
        """
        try:
            msgspec.convert(rows, self._type)
        except msgspec.ValidationError as error:
            found = _PLACE.match(str(error))
            row, column = (int(found[2]), int(found[3])) if found else (0, 0)
            what = found[1] if found else str(error)
            raise self._error(row, self._columns[column], f"{what}, found {shown(rows[row][column])}") from None
        if self._given or len(self._described) > 1:
            self._check_given(rows)
        if self._message is not None:
            self._check_once(rows, self._message)
        self._count += len(rows)

    def _check_given(self, rows: Sequence[tuple[Any, ...]]) -> None:
        meter, described = self._id[0], self._described
        for k, row in enumerate(rows):
            for place in self._given:
                if (row[place] is None) != (row[meter] is None):
                    lack = "missing of meter" if row[place] is None else f"{row[place]} stands without a meter,"
                    raise self._error(k, self._columns[place], f"{lack} {shown(row[meter])}")
            if len(described) > 1 and (row[described[0]] is None) != (row[described[1]] is None):
                names = " and ".join(_DESCRIBED)
                raise self._error(k, self._columns[self._described[1]], f"{names} go together, and one is missing")

    def _check_once(self, rows: Sequence[tuple[Any, ...]], message_of: Callable[[tuple[Any, ...]], Any]) -> None:
        places, last, seen = self._id, self._last, self._seen
        for k, row in enumerate(rows):
            if (message := message_of(row)) != last:
                last, seen = message, set()
            at = tuple(row[place] for place in places)
            if at in seen:
                named = at[0] if at[-1] is None else ".".join(map(str, at))
                raise self._error(k, self._columns[places[0]], f"{shown(named)} stands twice in one message")
            seen.add(at)
        self._last, self._seen = last, seen

    def _error(self, row: int, column: str, what: str) -> InvalidInputError:
        problem = f"row {self._count + row + 1}: {column}: {what}; this row and those behind it are left out"
        return InvalidInputError(str(self._path), [problem])


def check_recordable(message: StateMessage | ReadingsMessage) -> None:
    """Checks that the rows of ``message`` can be written and read back: the bus carries times that no calendar has, and
    angles too large for a number in degrees.

    Raises:
        MessageError: naming the field.
    """
    times = {
        "time": (message.header.time,),
        "taken_at": (message.taken_at,),
        "times": message.times if isinstance(message, ReadingsMessage) else (),
    }
    if isinstance(message, StateMessage):
        times["split"] = (message.split.time,)
    for name, values in times.items():
        if values and not (min(values) >= -LATEST and max(values) < LATEST):
            raise MessageError("malformed", f"{name} is beyond the year 9999")
    if isinstance(message, StateMessage):
        for name, angles in (("va", message.va), ("sigma_va", message.sigma_va)):
            if angles and max(map(abs, angles)) > LARGEST_ANGLE:
                raise MessageError("not finite", f"{name}: an angle is beyond all numbers in degrees")
