"""A recording read back: the readings and the estimate of each area, scan by scan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.watch.recording.folder import list_segments, read_about
from coordinator.watch.replay.recorded_rows import LOST, note, rows_of_segment
from coordinator.watch.replay.scan_states import stands_for_scan
from dsse_core.errors import InvalidInputError

MOST_BEHIND = 10  # scans by which an area may be behind the newest; older scans are complete
ESTIMATED = ("vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg")
_WHOSE = ("time", "scan", "area", "incarnation")
NEEDED: Mapping[str, Sequence[str]] = {
    "readings": (*_WHOSE, "sequence", "taken_at", "meter", "value", "sigma"),
    "states": (*_WHOSE, "estimate", "estimated", "quality"),
    "buses": (*_WHOSE, "estimate", "bus", "phase", *ESTIMATED),
    "events": ("event", "details"),
}


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

    ``values``, shape (4, n_nodes): magnitude p.u. and angle deg of ``nodes``, buses with a phase, "" in a balanced
    network, and the standard deviations of both; nan where angles have no reference.
    """

    quality: str
    nodes: tuple[tuple[int, str], ...]
    values: np.ndarray

    def __repr__(self) -> str:
        return f"<Estimate of {len(self.nodes)} nodes, {self.quality}>"


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
        found.buses.setdefault(key, []).append(((row["bus"], row["phase"] or ""), *(row[name] for name in ESTIMATED)))
    elif row["estimated"] and stands_for_scan(row["quality"], found.shown.get(area, ((), ""))[1]):
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
