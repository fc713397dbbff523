"""A recording read back: the readings and the estimate of each area, scan by scan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from agents.protocol.quality import GOOD
from coordinator.watch.recording.closing import rows_of_log
from coordinator.watch.recording.folder import list_segments, log_of, read_about, table_of
from coordinator.watch.recording.parquet import read_rows
from coordinator.watch.recording.rows import ADDED, COLUMNS, Row
from dsse_core.errors import LONGEST_LINE, InvalidInputError
from dsse_core.printable import on_one_line, printable, shortened_inside

MOST_BEHIND = 10  # scans by which an area may be behind the newest; older scans are complete
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
    """The recorded estimate of an area of a scan.

    ``values``, shape (4, n_bus): magnitude p.u. and angle deg of ``buses``, and the standard deviations of both; nan
    where angles have no reference.
    """

    quality: str
    buses: tuple[int, ...]
    values: np.ndarray

    def __repr__(self) -> str:
        return f"<Estimate of {len(self.buses)} buses, {self.quality}>"


@dataclass(frozen=True, slots=True)
class Tick:
    """One recorded scan.

    ``readings``: area -> its last readings of the scan. ``estimates``: area -> its last good estimate of the scan, or
    its last one if none is good. ``twice``: areas that took other readings during the scan, for instance after a
    restart. The record does not tell on which of these readings the estimates of other areas rest.
    """

    scan: int
    readings: Mapping[str, Snapshot]
    estimates: Mapping[str, Estimate]
    twice: tuple[str, ...] = ()

    @property
    def at(self) -> float:
        """Time at which the last of its readings were taken, s since 1970; nan without readings."""
        return max((snapshot.taken_at for snapshot in self.readings.values()), default=math.nan)


@dataclass
class _Scan:
    """Rows of one scan read so far."""

    # area -> its last readings message, and the rows of it by meter; an area repeats the message
    readings: dict[str, tuple[tuple[Any, ...], dict[str, tuple[Any, ...]]]] = field(default_factory=dict)
    twice: set[str] = field(default_factory=set)  # areas with an earlier, different readings message
    shown: dict[str, tuple[tuple[Any, ...], str]] = field(default_factory=dict)  # area -> key of an estimate, quality
    buses: dict[tuple[Any, ...], list[tuple[Any, ...]]] = field(default_factory=dict)  # key of an estimate -> rows


def read_ticks(folder: Path, notes: list[str]) -> Iterator[Tick]:
    """All scans in the recording at ``folder``, in order. Adds a text to ``notes`` for each part that is lost, and for
    each file that cannot be read, as Parquet where pyarrow is not installed.

    Raises:
        InvalidInputError: ``folder`` is no recording.
    """
    read_about(folder)
    scans: dict[int, _Scan] = {}
    for segment in list_segments(folder):
        try:
            for table, row in rows_of_segment(folder, segment, NEEDED):
                _take(scans, table, dict(zip(NEEDED[table], row, strict=True)), notes)
        except InvalidInputError as error:  # a foreign or damaged file; the other files are still read
            note(notes, str(error))
        complete = max(scans, default=0) - MOST_BEHIND
        for scan in sorted(scan for scan in scans if scan < complete):
            yield _build(scan, scans.pop(scan))
    for scan in sorted(scans):
        yield _build(scan, scans[scan])


def note(notes: list[str], text: str) -> None:
    """Adds ``text`` to ``notes`` on the lost parts of a recording, up to ``MOST_NOTES``; then a last note on more."""
    if len(notes) < MOST_NOTES:
        notes.append(shortened_inside(printable(on_one_line(text)), LONGEST_LINE))
    elif len(notes) == MOST_NOTES:
        notes.append("and more of this kind")


def rows_of_segment(folder: Path, segment: str, needed: Mapping[str, Sequence[str]]) -> Iterator[Row]:
    """The rows of ``segment`` in the tables of ``needed`` (table -> columns to read), with these columns.

    The rows come from the log, in order, if it still exists because closing has not ended; else from the files, table
    by table. Details of events on lost parts begin with the file.

    Raises:
        InvalidInputError: a file cannot be read, or is not part of a recording.
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
    """The ``row`` of an event, with the file in its details if the event is about a lost part."""
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
