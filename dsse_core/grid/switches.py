"""Statuses of switches, branches that may be opened and closed while areas run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from dsse_core.grid.columns import take_items
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.meter_table import average, find_virtual, read_meters_of, tabulate_meters
from dsse_core.grid.network import Network

Status = Literal["open", "closed"]
OPEN: Status = "open"
CLOSED: Status = "closed"
UNKNOWN = "unknown"
STATUS = "status"  # kind of the readings of statuses
READ_AS: dict[str, float] = {OPEN: 0.0, CLOSED: 1.0, UNKNOWN: -1.0}  # value of such a reading; others are unknown


def name_status_meter(switch: str) -> str:
    """The id of the status of ``switch`` among the readings of meters."""
    return f"{STATUS}@{switch}"


def read_status(value: float) -> str:
    """The status that a reading states."""
    return next((status for status, number in READ_AS.items() if value == number), UNKNOWN)


def name_statuses(closed: Mapping[str, bool]) -> dict[str, str]:
    """Switch -> "open" or "closed", of switch -> True where it is closed."""
    return {switch: CLOSED if is_closed else OPEN for switch, is_closed in closed.items()}


def read_statuses(named: Mapping[str, str]) -> dict[str, bool]:
    """Switch -> True where it is closed, of the statuses that a message names; others than these two are left out."""
    return {switch: status == CLOSED for switch, status in named.items() if status in (OPEN, CLOSED)}


def take_own(network: Network, statuses: Mapping[str, str]) -> dict[str, str]:
    """The ``statuses`` of switches of ``network``."""
    return {switch: status for switch, status in statuses.items() if switch in network.switches}


def take_fed(network: Network, readings: Sequence[Measurement]) -> tuple[Network, Sequence[Measurement]]:
    """The whole ``network`` with its dead nodes, and the ``readings`` of meters in service where there is supply."""
    network, readings = network.supplied(), keep_in_service(network, readings)
    if not network.dead:
        return network, readings
    return network, take_items(readings, np.flatnonzero(~find_dead_meters(network, read_meters_of(readings))))


def find_dead_meters(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """True for each of ``meters`` in service that has an end at a dead node, of a total all its ends, (n_meas,).

    Also for a virtual total that follows from other meters: all its nodes with supply have virtual P and Q themselves.
    """
    if not network.dead:
        return np.zeros(len(meters), dtype=bool)
    table, of_meter = tabulate_meters(network, meters).spread()
    is_dead = np.append(network.is_dead, False)  # the last one for the ground
    dead = is_dead[table.node] if table.other is None else is_dead[table.node] | is_dead[table.other]
    if of_meter is not None:
        virtual, is_total = find_virtual(meters)[of_meter], np.bincount(of_meter)[of_meter] > 1
        is_idle = np.bincount(table.node[virtual & ~is_total & ~dead], minlength=len(is_dead)) == 2  # P and Q
        dead |= virtual & is_total & is_idle[table.node]
    return np.asarray(average(dead.astype(float), of_meter) == 1.0)


def keep_in_service(network: Network, readings: Sequence[Measurement]) -> Sequence[Measurement]:
    """``readings`` without those of meters at branches that are open."""
    rows = find_meters_in_service(network, read_meters_of(readings))
    return readings if len(rows) == len(readings) else take_items(readings, rows)


def find_meters_in_service(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """The positions of the ``meters`` that are not at open branches."""
    if network.table.in_service.all():
        return np.arange(len(meters))
    is_open = {branch.id for branch in network.branches if not branch.in_service}
    return np.flatnonzero(np.array([meter.branch not in is_open for meter in meters], dtype=bool))
