"""A run at one moment for the live table: the state of each area, and the obstacles to consensus."""

from __future__ import annotations

from dataclasses import dataclass

from agents.messages.packing import StateMessage
from coordinator.watch.observe.observer import Observer
from coordinator.watch.observe.watcher import count_exchanges

UPDATE_S = 0.1  # of wall time between two updates


@dataclass(frozen=True, slots=True)
class AreaProgress:
    """Progress of one area.

    Mismatches: the largest at a boundary bus with a neighbour on the same scan, p.u. and rad; of angles that count from
    the substation. None where there is none.
    """

    name: str
    state: str
    scan: int
    exchanges: int
    mismatch_vm: float | None
    mismatch_va: float | None
    messages: int
    lost: int


@dataclass(frozen=True, slots=True)
class Progress:
    """All areas after ``elapsed_s``. ``obstacles``: the missing conditions of consensus, in words."""

    elapsed_s: float
    areas: tuple[AreaProgress, ...]
    obstacles: tuple[str, ...]


def describe_progress(observer: Observer, elapsed_s: float, obstacles: tuple[str, ...]) -> Progress:
    """Progress of every area that ``observer`` watches; ``obstacles``, costly to find, come from the caller."""
    absent = set(observer.find_absent())
    names = [area.name for area in observer.partition.areas]
    return Progress(elapsed_s, tuple(_describe_area(observer, name, name not in absent) for name in names), obstacles)


def _describe_area(observer: Observer, name: str, alive: bool) -> AreaProgress:
    state = observer.watcher.state_of(name)
    if state is None:
        return AreaProgress(name, "joined" if alive else "starting", 0, 0, None, None, 0, 0)
    mismatches = _find_mismatches(observer, name, state)
    agrees = all(va is not None and va <= observer.tolerance_va for _, va in mismatches)
    return AreaProgress(
        name=name,
        state=_describe_state(state, agrees) if alive else "gone",
        scan=state.header.scan,
        exchanges=count_exchanges(state),
        mismatch_vm=max((vm for vm, _ in mismatches if vm is not None), default=None),
        mismatch_va=max((va for _, va in mismatches if va is not None), default=None),
        messages=state.messages,
        lost=state.lost,
    )


def _find_mismatches(observer: Observer, name: str, own: StateMessage) -> list[tuple[float | None, float | None]]:
    """Differences of magnitude and angle at boundary buses with neighbours that have an estimate, p.u. and rad.

    Both are None where the scans differ; the angle is None unless the angles of both areas count from the substation.
    """
    if not own.buses:
        return []
    found: list[tuple[float | None, float | None]] = []
    for other, boundary in observer.partition.area(name).boundaries.items():
        theirs = observer.watcher.state_of(other)
        if theirs is None or not theirs.buses:
            continue
        is_of_scan = theirs.header.scan == own.header.scan
        is_referenced = own.referenced and theirs.referenced
        for vm, va in observer.find_mismatches(boundary.buses, name, other).values():
            found.append((vm if is_of_scan else None, va if is_of_scan and is_referenced else None))
    return found


def _describe_state(state: StateMessage, agrees: bool) -> str:
    if not state.buses:
        return "waits for telemetry" if state.header.scan == 0 else "no estimate"
    if not state.referenced:
        return "relative angles"
    return "agrees" if agrees else "adjusts"
