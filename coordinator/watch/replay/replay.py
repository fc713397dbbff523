"""A recording played back: its readings go scan by scan to the same areas, whose states are compared with the record.

The areas take the recorded readings with the standard deviations that were used. Ages are in them already, so readings
do not age again. Scans have their recorded numbers. Faults of links are those of the area files.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from agents.messages.packing import Header, Incarnation, StateMessage, TelemetryMessage
from agents.protocol.quality import GOOD
from agents.security.access import PLANT
from coordinator.watch.replay.ticks import Estimate, Snapshot, Tick, read_ticks
from dsse_core.errors import InvalidInputError
from dsse_core.printable import listed

MOST_NAMED = 8
TOLERANCE = 1e-9  # p.u. and rad


class Stage(Protocol):
    """Interface of the areas to which a recording is played: on the simulator, or in processes."""

    def play(self, tick: Tick) -> Mapping[str, StateMessage]:
        """Gives the areas the readings of one scan. Returns area -> its state, at rest or after a time limit."""
        ...


@dataclass
class Comparison:
    """Result of a replay.

    ``scans``: number of scans played. ``compared``, ``not_good``: number of states compared that were recorded as good,
    and as not good. ``left_out``: scan -> reason for not playing it. ``unequal``: number of states that differ at all
    from the record. ``largest``, shape (4,): largest differences of the states recorded as good, of vm p.u., va deg and
    the standard deviations of both. ``of_others``: the same of the states not recorded as good. ``missing``: (scan,
    area) of states recorded as good that the replay did not find. ``notes``: lost parts of the recording.
    """

    scans: int = 0
    compared: int = 0
    not_good: int = 0
    unequal: int = 0
    largest: np.ndarray = field(default_factory=lambda: np.zeros(4))
    of_others: np.ndarray = field(default_factory=lambda: np.zeros(4))
    left_out: dict[int, str] = field(default_factory=dict)
    missing: list[tuple[int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def describe_left_out(self) -> list[str]:
        """A line for each reason for which scans were not played, with the first of these scans."""
        why: dict[str, list[int]] = defaultdict(list)
        for scan, reason in self.left_out.items():
            why[reason].append(scan)
        return [f"left out, {reason}: scan {listed(scans, MOST_NAMED)}" for reason, scans in why.items()]

    def as_json(self) -> dict[str, object]:
        """The findings by name, of which a program learns what ``dsse replay`` prints."""
        of_states = ("vm_pu", "va_deg", "vm_sigma_pu", "va_sigma_deg")
        names = ("agrees", "is_whole", "scans", "compared", "not_good", "unequal", "notes")
        return {name: getattr(self, name) for name in names} | {
            "largest": dict(zip(of_states, self.largest.tolist(), strict=True)),
            "left_out": {str(scan): reason for scan, reason in self.left_out.items()},
            "missing": [{"scan": scan, "area": area} for scan, area in self.missing],
        }

    @property
    def is_whole(self) -> bool:
        """True where all recorded scans have been played, and no part of the recording is known to be lost."""
        return not self.left_out and not self.notes

    @property
    def agrees(self) -> bool:
        """True where the replay found all good states of the played scans again, within ``TOLERANCE``."""
        largest = np.append(self.largest[[0, 2]], np.radians(self.largest[[1, 3]]))
        return bool(self.compared) and not self.missing and bool((largest <= TOLERANCE).all())


def replay(
    folder: Path,
    stage: Stage,
    names: Sequence[str],
    speed: float | None = None,
    on_scan: Callable[[Tick, Mapping[str, StateMessage]], None] = lambda tick, states: None,
) -> Comparison:
    """Plays the recording at ``folder`` on ``stage``; ``names``: of all areas of the stage.

    ``speed``: factor by which it is faster than the record; None: without waiting. ``on_scan``: called after each
    scan, with the state of each area.

    Raises:
        InvalidInputError: ``folder`` is no recording, or no scan has the readings of all areas that took part.
    """
    found = Comparison()
    pace = _Pace(speed)
    for tick in read_ticks(folder, found.notes):
        if why := find_hole(tick, names):
            found.left_out[tick.scan] = why
            continue
        pace.wait_for(tick.at)
        _compare(found, tick, states := stage.play(tick))
        on_scan(tick, states)
    if not found.scans:
        problem = "there is no scan of which the readings of all areas that took part are recorded"
        raise InvalidInputError(str(folder), [problem, *found.describe_left_out(), *found.notes])
    return found


def find_hole(tick: Tick, names: Sequence[str]) -> str:
    """Reason not to play a scan; empty if it can be played. An area without any record did not take part in it."""
    if strange := (tick.readings.keys() | tick.estimates.keys()) - set(names):
        return f"area {listed(sorted(strange), MOST_NAMED)} is not among the area files"
    if lost := tick.estimates.keys() - tick.readings.keys():
        return f"no readings of {listed(sorted(lost), MOST_NAMED)} are recorded"
    if tick.twice:
        return f"{listed(tick.twice, MOST_NAMED)} took readings twice, as after a restart"
    return "" if tick.readings else "no readings are recorded"


class _Pace:
    """Waits between scans as long as in the record, divided by ``speed``; never without a speed."""

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._first: tuple[float, float] | None = None  # the first time in the recording, and now

    def wait_for(self, at: float) -> None:
        if self._speed is None:
            return
        self._first = self._first or (at, time.monotonic())
        due = self._first[1] + (at - self._first[0]) / self._speed
        time.sleep(max(0.0, due - time.monotonic()))


def _compare(found: Comparison, tick: Tick, states: Mapping[str, StateMessage]) -> None:
    found.scans += 1
    for area, recorded in tick.estimates.items():
        state = states.get(area)
        if state is None or state.header.scan != tick.scan or set(state.nodes) != set(recorded.nodes):
            if recorded.quality == GOOD:
                found.missing.append((tick.scan, area))
            continue
        differences = _find_differences(recorded, state)
        found.unequal += bool(differences.any())
        if recorded.quality == GOOD:
            found.compared += 1
            found.largest = np.maximum(found.largest, differences)
        else:
            found.not_good += 1
            found.of_others = np.maximum(found.of_others, differences)


def _find_differences(recorded: Estimate, state: StateMessage) -> np.ndarray:
    """Largest difference of each of the four quantities, shape (4,); infinite where angles have a reference in one of
    the two states alone.
    """
    place = {node: k for k, node in enumerate(state.nodes)}
    order = [place[node] for node in recorded.nodes]
    played = np.array([state.vm, state.va, state.sigma_vm, state.sigma_va], dtype=float)[:, order]
    played[[1, 3]] = np.degrees(played[[1, 3]]) if state.referenced else np.nan
    both_unknown = np.isnan(played) & np.isnan(recorded.values)
    return np.asarray(np.nan_to_num(abs(np.where(both_unknown, 0.0, played - recorded.values)), nan=np.inf).max(axis=1))


def make_telemetry_message(
    run: str, area: str, scan: int, snapshot: Snapshot, incarnation: Incarnation, now: float
) -> TelemetryMessage:
    """The readings of ``snapshot`` as the telemetry message of a plant at ``now``, s since 1970."""
    count = len(snapshot.meters)
    header = Header(run, PLANT, incarnation, scan, scan, now)
    columns = snapshot.meters, snapshot.values, snapshot.sigmas, (now,) * count, (True,) * count
    return TelemetryMessage(header, area, *columns)


def format_replay(found: Comparison, where: str, wall_s: float) -> str:
    """Lines on the scans played on the stage ``where``, their differences from the record, and the scans left out."""
    scans = f"{found.scans} of {found.scans + len(found.left_out)} scans" if found.left_out else f"{found.scans} scans"
    lines = [f"{scans} played on {where} in {wall_s:.1f} s, {found.compared} good states compared"]
    played = "" if found.is_whole else " of the scans that were played"
    if not found.compared and not found.missing:
        lines.append("no good state is recorded of them, so that nothing was compared")
    elif found.agrees and not found.unequal:
        lines.append(f"all states{played} are those that were recorded, to the bit")
    elif found.compared:
        words = f"within {TOLERANCE:g}" if found.agrees else "DIFFERENT"
        lines.append(f"{words} p.u. and rad: {_describe(found.largest)}")
    if found.not_good:
        others = f"{found.not_good} states were not good when they were recorded"
        lines.append(f"{others}; they rest on more than readings: {_describe(found.of_others)}")
    if found.missing:
        names = [f"{area} in {scan}" for scan, area in found.missing]
        lines.append(f"not found again: {listed(names, MOST_NAMED)}")
    notes = [*found.describe_left_out(), *found.notes]
    return "\n".join([*lines, *(f"note: {text}" for text in notes)])


def _describe(differences: np.ndarray) -> str:
    vm, va, sigma_vm, sigma_va = differences
    return (
        f"largest difference of vm {vm:.3g} p.u., va {va:.3g} deg, their standard deviations {sigma_vm:.3g} p.u., "
        f"{sigma_va:.3g} deg"
    )
