"""Switches that the events of a scenario operate: their true status in the course of a run, and the status read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dsse_core.grid.switches import CLOSED, name_statuses
from scenarios.faults.faults import FaultEvent

SWITCH = "switch"


@dataclass(frozen=True, slots=True)
class Operated:
    """Switches that events operate. ``closed``: switch -> True where it is closed in truth. ``read``: switch -> status
    that the plant reads.
    """

    closed: Mapping[str, bool]
    read: Mapping[str, str]


def find_operated(events: Sequence[FaultEvent], switches: Mapping[str, bool], elapsed_s: float) -> Operated:
    """The switches that ``events``, in the order of their time, have operated ``elapsed_s`` after the start of the run.

    ``switches``: all switches, with their status at the start.
    """
    own = [event for event in events if event.kind == SWITCH]
    closed = {switch: switches[switch] for event in own for switch in event.names}
    read = name_statuses(closed)
    for event in own:
        (switch,) = event.names
        if event.at_s <= elapsed_s:
            closed[switch] = event.to == CLOSED
        if event.over_s <= elapsed_s:
            read[switch] = event.status or event.to
    return Operated(closed, read)


def find_next(events: Sequence[FaultEvent], elapsed_s: float) -> float | None:
    """The next time after ``elapsed_s`` at which events change a switch or its status, s; None without one."""
    times = {at for event in events if event.kind == SWITCH for at in (event.at_s, event.over_s)}
    return min((at for at in times if at > elapsed_s), default=None)
