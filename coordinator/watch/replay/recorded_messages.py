"""Messages and presence of a recording, in the order of time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec

from agents.messages.checks import Count, Name, Number
from agents.messages.keys import NAME, incarnation_of, live_key, name_of_live
from agents.messages.packing import NO_INCARNATION, Header, ReadingsMessage, StateMessage
from coordinator.watch.recording.entries import APPEARED, VANISHED
from coordinator.watch.recording.folder import list_segments, table_of
from coordinator.watch.recording.recorded_tables import COLUMNS
from coordinator.watch.replay.recorded_rows import LOST, note, rows_of_segment
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.split_identity import SplitIdentity

MOST_UPDATES = 10_000  # the newest that are played
MOST_VALUES = 2_000_000  # buses and meters of all updates together: some hundred megabytes
LETTERS = 50  # characters of JSON that count as one value


@dataclass(frozen=True, slots=True)
class Presence:
    """The appearance or the end of the presence token ``key``."""

    key: str
    alive: bool


Update = StateMessage | ReadingsMessage | Presence
Row = Mapping[str, Any]
Timed = tuple[float, Update]


def read_newest_messages(folder: Path, run: str, notes: list[str]) -> list[Timed]:
    """States, readings and presence recorded of ``run`` at ``folder``; the newest part of a long recording.

    The tokens of areas that were present before this part stand at its begin. Lost and omitted parts go to ``notes``.

    Raises:
        InvalidInputError: ``folder`` is no recording, or nothing in it can be read, as without pyarrow where all of it
            is Parquet.
    """
    kept: list[Timed] = []
    for segment in reversed(list_segments(folder)):
        found = _read_segment(folder, segment, run, notes)
        kept = [*found, *kept]
        newest = kept[find_begin(kept) :]
        if len(newest) < len(kept):
            kept = newest
            notes.append("the recording is long: its newest part is played")
            break
    if not kept:
        raise InvalidInputError(str(folder), ["nothing is recorded here yet", *notes])
    return [*((kept[0][0], token) for token in _find_there_before(kept, run)), *kept]


def count_values(item: Update) -> int:
    """Number of buses or meters in ``item``."""
    match item:
        case StateMessage():
            return len(item.buses)
        case ReadingsMessage():
            return len(item.meters)
    return 0


def find_begin(updates: list[Timed]) -> int:
    """Index of the first update that is played."""
    values = 0
    for k in reversed(range(len(updates))):
        values += count_values(updates[k][1])
        if len(updates) - k > MOST_UPDATES or values > MOST_VALUES:
            return min(k + 1, len(updates) - 1)
    return 0


def _find_there_before(updates: list[Timed], run: str) -> Iterator[Presence]:
    """Presence tokens of areas that were present before the first update played."""
    known = set[str]()
    for _, item in updates:
        if isinstance(item, Presence):
            known.add(name_of_live(item.key)[1])
        elif item.header.sender not in known:
            known.add(item.header.sender)
            yield Presence(live_key(run, "area", item.header.sender, item.header.incarnation), True)


def _read_segment(folder: Path, segment: str, run: str, notes: list[str]) -> list[Timed]:
    """The newest part of a segment, at most as much as is played, sorted by time.

    Each state has the buses of its estimate, unless their rows are older than this part.
    """
    presences: deque[Timed] = deque(maxlen=MOST_UPDATES)
    states, buses, readings = _Newest(), _Newest(), _Newest()
    texts: dict[str, Any] = {}
    count = 0
    try:
        for table, values in rows_of_segment(folder, segment, NEEDED):
            row = dict(zip(NEEDED[table], values, strict=True))
            if table == "states":
                count += 1
                try:
                    found = _whose(row), row["time"], _to_state(row, run, texts)
                    states.take(
                        (count,), found, 1 + sum(len(row[name] or "") for name, _ in _TABLES.values()) // LETTERS
                    )
                except ValueError as error:
                    where = str(table_of(folder, table, segment))
                    raise InvalidInputError(where, [f"row {count}: {error}"]) from None
            elif table == "buses":
                buses.take(_whose(row), tuple(row[name] for name in _OF_BUSES))
            elif table == "readings":
                readings.take(tuple(row[name] for name in _WHOSE_READINGS), tuple(row[name] for name in _OF_READINGS))
            elif row["event"] in (APPEARED, VANISHED):
                presences += _to_presence(row, run)
            elif row["event"] in LOST:
                note(notes, row["details"])
    except InvalidInputError as error:  # a foreign or damaged file; the other segments are still read
        note(notes, str(error))
    updates: list[Timed] = [*presences]
    updates += [(at, _with_buses(item, buses.rows.get(key, ()))) for ((key, at, item),) in states.rows.values()]
    updates += [(key[-1], _to_readings(key, rows, run)) for key, rows in readings.rows.items()]
    return sorted(updates, key=lambda timed: timed[0])


class _Newest:
    """Rows of the newest messages, at most as many as are played. ``rows``: message -> its rows."""

    def __init__(self) -> None:
        self.rows: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        self._values: dict[tuple[Any, ...], int] = {}
        self._count = 0

    def take(self, message: tuple[Any, ...], row: tuple[Any, ...], values: int = 1) -> None:
        """Adds a row of ``message`` that counts as ``values``; drops the oldest messages while there are too many."""
        self.rows.setdefault(message, []).append(row)
        self._values[message] = self._values.get(message, 0) + values
        self._count += values
        while len(self.rows) > 1 and (len(self.rows) > MOST_UPDATES or self._count > MOST_VALUES):
            oldest = next(iter(self.rows))
            del self.rows[oldest]
            self._count -= self._values.pop(oldest)


def _whose(row: Row) -> tuple[Any, ...]:
    """Key of the estimate of a row: area, incarnation and number."""
    return row["area"], row["incarnation"], row["estimate"]


def _to_presence(row: Row, run: str) -> Iterator[Timed]:
    """The presence of an event; none where the event, as LEFT, has a reason in the place of the incarnation: there the
    token vanishes right after.
    """
    incarnation = incarnation_of(row["details"])
    is_named = NAME.fullmatch(row["role"]) and NAME.fullmatch(row["name"])
    if incarnation is not None and is_named and row["time"] is not None:
        yield row["time"], Presence(live_key(run, row["role"], row["name"], incarnation), row["event"] == APPEARED)


def _to_header(area: str, incarnation: str, scan: int, sequence: int, run: str, at: float) -> Header:
    return Header(run, area, incarnation_of(incarnation) or NO_INCARNATION, scan, sequence, at)


def _to_state(row: Row, run: str, texts: dict[str, Any]) -> StateMessage:
    """The state of a row, without its buses. ``texts``: JSON read before -> its content, because rows repeat it.

    Raises:
        ValueError: a column of JSON has an invalid value; the error names the column.
    """
    blank: dict[str, Any] = dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va"), ())
    tables = {name: _read_table(column, row[column] or "{}", kind, texts) for name, (column, kind) in _TABLES.items()}
    plain: dict[str, Any] = {name: tuple(row[name]) if isinstance(row[name], list) else row[name] for name in _SAME}
    at = row["sent_at"] or row["time"]
    return StateMessage(
        header=_to_header(row["area"], row["incarnation"], row["scan"], row["sequence"], run, at),
        **blank,
        **plain,
        **tables,
        objective=row["objective"] or 0.0,
        degrees_of_freedom=row["degrees_of_freedom"] or 0,
        sent=dict.fromkeys(tables["ages"], (0, 0)),
        received={},
        telemetry_age=row["telemetry_age_s"] or 0.0,
        oldest_reading=row["oldest_reading_s"] or 0.0,
        taken_at=row["taken_at"] or 0.0,
        split=SplitIdentity(row["split"] or "", row["split_at"] or 0.0, row["split_edited"] or ""),
    )


def _read_table(column: str, text: str, kind: Any, texts: dict[str, Any]) -> Any:
    """The table in the JSON of ``text``, checked by the type ``kind`` as on the wire.

    Raises:
        ValueError: the text is no such table; the error names ``column``.
    """
    if (known := texts.get(column + text)) is not None:
        return known
    try:
        found = msgspec.convert(parse_json(text or "{}"), kind)
    except (ValueError, msgspec.ValidationError) as error:  # no ValueError in older versions
        raise ValueError(f"{column}: {error}") from None
    if len(texts) > MOST_UPDATES:
        texts.clear()
    texts[column + text] = found
    return found


_COUNTS, _NUMBERS = dict[Name, Count], dict[Name, Number]
_TABLES: Mapping[str, tuple[str, Any]] = {
    "rejected": ("rejected", _COUNTS),
    "faults": ("faults", _COUNTS),
    "ages": ("ages_s", _NUMBERS),
    "scans": ("scans", _COUNTS),
    "clock_skews": ("clock_skews_s", _NUMBERS),
    "switches": ("switches", dict[Name, Name]),
    "taps": ("taps", dict[Name, tuple[Number, Number]]),
}
"""Table of a state -> the column of JSON that holds it, and its type."""
_SAME = tuple(
    field.name
    for field in fields(StateMessage)
    if field.name in COLUMNS["states"]
    and field.name not in (*_TABLES, "objective", "degrees_of_freedom", "taken_at", "split")
)


_OF_BUSES = ("bus", "phase", "vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg")
_WHOSE_READINGS = ("area", "incarnation", "scan", "sequence", "taken_at", "time")
_OF_READINGS = ("meter", "value", "sigma", "measured_at", "estimate", "normalised_residual")
NEEDED: Mapping[str, Sequence[str]] = {
    "states": tuple(name for name in COLUMNS["states"] if name != "final"),
    "buses": ("time", "scan", "area", "incarnation", "estimate", *_OF_BUSES),
    "readings": (*_WHOSE_READINGS, *_OF_READINGS),
    "events": ("time", "event", "role", "name", "details"),
}


def _with_buses(state: Update, rows: Iterable[tuple[Any, ...]]) -> Update:
    if not isinstance(state, StateMessage) or not (found := {row[:2]: row for row in rows}):
        return state
    buses, phases, vm, va, sigma_vm, sigma_va = zip(*found.values(), strict=True)
    phases = tuple(phase or "" for phase in phases) if any(phases) else ()
    return replace(
        state, buses=buses, phases=phases, vm=vm, va=_radians(va), sigma_vm=sigma_vm, sigma_va=_radians(sigma_va)
    )


def _radians(angles: Iterable[float | None]) -> tuple[float, ...]:
    """``angles``, degrees, in rad; 0 for angles without reference."""
    return tuple(0.0 if angle is None else math.pi / 180 * angle for angle in angles)


def _to_readings(key: tuple[Any, ...], rows: list[tuple[Any, ...]], run: str) -> ReadingsMessage:
    """The readings message ``key`` from its rows. A single row without a meter means that no reading was used."""
    area, incarnation, scan, sequence, taken_at, at = key
    described = [row for row in rows if row[0] is not None and row[-1] is not None]
    given = [*described, *(row for row in rows if row[0] is not None and row[-1] is None)]
    meters, values, sigmas, times, _, _ = zip(*given, strict=True) if given else ((),) * len(_OF_READINGS)
    return ReadingsMessage(
        header=_to_header(area, incarnation, scan, sequence, run, at),
        taken_at=taken_at,
        meters=meters,
        values=values,
        sigmas=sigmas,
        times=times,
        estimates=tuple(row[-2] for row in described),
        normalised=tuple(row[-1] for row in described),
    )
