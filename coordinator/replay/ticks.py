"""A recording read back: scan by scan what each area used, and what it made of that."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from agents.protocol.quality import GOOD
from coordinator.recording.closing import rows_of_log
from coordinator.recording.folder import list_segments, log_of, read_about, table_of
from coordinator.recording.parquet import read_rows
from coordinator.recording.rows import ADDED, COLUMNS, Row
from dsse_core.errors import LONGEST_LINE, InvalidInputError
from dsse_core.printable import on_one_line, printable, shortened_inside

MOST_BEHIND = 10  # scans by which an area may be behind the newest; what is older than that is complete
MOST_NOTES = 50
ESTIMATED = ("vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg")
_WHOSE = ("time", "scan", "area", "incarnation")
NEEDED: Mapping[str, Sequence[str]] = {
    "readings": (*_WHOSE, "sequence", "taken_at", "meter", "value", "sigma"),
    "states": (*_WHOSE, "estimate", "estimated", "quality"),
    "buses": (*_WHOSE, "estimate", "bus", *ESTIMATED),
    "events": ("event", "details"),
}
LOST = ("damaged log", "unreadable", "lost")  # events


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The readings that an area used: id, value and sigma, p.u. and rad; ``taken_at``: s since 1970."""

    taken_at: float
    meters: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class Estimate:
    """What an area showed of a scan: (4, n_bus) magnitude p.u. and angle deg of ``buses``, and their deviations; nan
    where an angle counts from nowhere.
    """

    quality: str
    buses: tuple[int, ...]
    values: np.ndarray

    def __repr__(self) -> str:
        return f"<Estimate of {len(self.buses)} buses, {self.quality}>"


@dataclass(frozen=True, slots=True)
class Tick:
    """One scan. ``readings``, ``estimates``: area -> its last of the scan, the last good estimate if there is one.

    ``twice``: areas that took other readings in the course of it, as after a restart: which of them an estimate of
    another area rests on is not recorded.
    """

    scan: int
    readings: Mapping[str, Snapshot]
    estimates: Mapping[str, Estimate]
    twice: tuple[str, ...] = ()

    @property
    def at(self) -> float:
        """When its readings were taken, s since 1970; nan without any."""
        return max((snapshot.taken_at for snapshot in self.readings.values()), default=math.nan)


@dataclass
class _Scan:
    """What has been read of one scan."""

    # area -> its last message, and its rows by meter: an area repeats it
    readings: dict[str, tuple[tuple[Any, ...], dict[str, tuple[Any, ...]]]] = field(default_factory=dict)
    twice: set[str] = field(default_factory=set)  # areas of which there was another before
    shown: dict[str, tuple[tuple[Any, ...], str]] = field(default_factory=dict)  # area -> key of an estimate, quality
    buses: dict[tuple[Any, ...], list[tuple[Any, ...]]] = field(default_factory=dict)  # key of an estimate -> rows


def read_ticks(folder: Path, notes: list[str]) -> Iterator[Tick]:
    """All scans in the recording at ``folder``, in order; what is lost of it is added to ``notes`` in words.

    Raises:
        InvalidInputError: it is no recording, or has Parquet and pyarrow is not installed.
    """
    read_about(folder)
    scans: dict[int, _Scan] = {}
    for segment in list_segments(folder):
        try:
            for table, row in rows_of_segment(folder, segment, NEEDED):
                _take(scans, table, dict(zip(NEEDED[table], row, strict=True)), notes)
        except InvalidInputError as error:  # a foreign file, or one that is damaged; the others are read all the same
            note(notes, str(error))
        complete = max(scans, default=0) - MOST_BEHIND
        for scan in sorted(scan for scan in scans if scan < complete):
            yield _build(scan, scans.pop(scan))
    for scan in sorted(scans):
        yield _build(scan, scans[scan])


def note(notes: list[str], text: str) -> None:
    """Add ``text`` to the ``notes`` of what a recording lacks: of thousands the first, and that there are more."""
    if len(notes) < MOST_NOTES:
        notes.append(shortened_inside(printable(on_one_line(text)), LONGEST_LINE))
    elif len(notes) == MOST_NOTES:
        notes.append("and more of this kind")


def rows_of_segment(folder: Path, segment: str, needed: Mapping[str, Sequence[str]]) -> Iterator[Row]:
    """The rows of the tables of ``needed``, the columns that it names of each; table by table or in order; from the log
    if that is there: closing was broken off, or has not begun. Details of what is lost begin with the file.

    Raises:
        InvalidInputError: a file cannot be read, or is none of a recording.
    """
    if (log := log_of(folder, segment)).exists():
        pick = {
            table: itemgetter(*(list(COLUMNS[table]).index(name) for name in names)) for table, names in needed.items()
        }
        for table, row in rows_of_log(folder, segment):
            if table in needed:
                picked = pick[table](row)
                yield table, _name_file(log, needed[table], picked) if table == "events" else picked
        return
    for table, columns in needed.items():
        if (path := table_of(folder, table, segment)).exists():
            for row in read_rows(path, columns, ADDED.get(table, ())):
                yield table, _name_file(path, columns, row) if table == "events" else row


def _name_file(path: Path, columns: Sequence[str], row: tuple[Any, ...]) -> tuple[Any, ...]:
    """The ``row`` of an event; where something is lost, with the file in its details."""
    event, details = columns.index("event"), columns.index("details")
    if row[event] not in LOST:
        return row
    return (*row[:details], f"{path}: {row[event]}: {row[details]}", *row[details + 1 :])


def _take(scans: dict[int, _Scan], table: str, row: dict[str, Any], notes: list[str]) -> None:
    if table == "events":
        if row["event"] in LOST:
            note(notes, row["details"])
        return
    if not row["scan"]:
        return  # before telemetry
    found, area = scans.setdefault(row["scan"], _Scan()), row["area"]
    if table == "readings":
        message = row["incarnation"], row["sequence"], row["taken_at"]
        if found.readings.get(area, (None,))[0] != message:
            found.twice |= {area} & found.readings.keys()
            found.readings[area] = message, {}
        if row["meter"] is not None:
            found.readings[area][1][row["meter"]] = row["meter"], row["value"], row["sigma"]
        return
    key = area, row["incarnation"], row["estimate"]
    if table == "buses":
        found.buses.setdefault(key, []).append((row["bus"], *(row[name] for name in ESTIMATED)))
    elif row["estimated"] and (row["quality"] == GOOD or found.shown.get(area, ((), ""))[1] != GOOD):
        found.shown[area] = key, row["quality"]


def _build(scan: int, found: _Scan) -> Tick:
    readings = {
        area: Snapshot(message[2], *(map(tuple, zip(*rows.values(), strict=True)) if rows else ((), (), ())))
        for area, (message, rows) in found.readings.items()
    }
    estimates = {
        area: _build_estimate(quality, found.buses[key])
        for area, (key, quality) in found.shown.items()
        if key in found.buses
    }
    return Tick(scan, readings, estimates, tuple(sorted(found.twice)))


def _build_estimate(quality: str, rows: list[tuple[Any, ...]]) -> Estimate:
    unique = {row[0]: row[1:] for row in rows}  # a scan at the edge of two files may stand in both
    values = np.array([[math.nan if v is None else v for v in row] for row in unique.values()], dtype=float).T
    return Estimate(quality, tuple(unique), values)
