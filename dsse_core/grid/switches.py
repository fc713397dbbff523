"""Statuses of switches, branches that may be opened and closed while areas run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from dsse_core.grid.columns import take_items
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.meter_table import read_meters_of
from dsse_core.grid.network import Network

Status = Literal["open", "closed"]
OPEN: Status = "open"
CLOSED: Status = "closed"


def name_statuses(closed: Mapping[str, bool]) -> dict[str, str]:
    """Switch -> "open" or "closed", of switch -> True where it is closed."""
    return {switch: CLOSED if is_closed else OPEN for switch, is_closed in closed.items()}


def read_statuses(named: Mapping[str, str]) -> dict[str, bool]:
    """Switch -> True where it is closed, of the statuses that a message names; others than these two are left out."""
    return {switch: status == CLOSED for switch, status in named.items() if status in (OPEN, CLOSED)}


def take_fed(network: Network, readings: Sequence[Measurement]) -> tuple[Network, Sequence[Measurement]]:
    """The part of ``network`` that closed branches join to the substation, and its ``readings``."""
    readings = keep_in_service(network, readings)
    dead = set(network.find_unreached_buses(network.slack.bus)) if network.slack else set()
    if not dead:
        return network, readings
    part = replace(
        network,
        buses=tuple(bus for bus in network.buses if bus.id not in dead),
        branches=tuple(branch for branch in network.branches if not {branch.from_bus, branch.to_bus} & dead),
        generators=tuple(generator for generator in network.generators if generator.bus not in dead),
        loads=tuple(load for load in network.loads if load.bus not in dead),
    )
    return part, [reading for reading in readings if reading.meter.bus not in dead]


def keep_in_service(network: Network, readings: Sequence[Measurement]) -> Sequence[Measurement]:
    """``readings`` without those of meters at branches that are open."""
    rows = _find_rows(network, read_meters_of(readings))
    return readings if rows is None else take_items(readings, rows)


def keep_meters_in_service(network: Network, meters: Sequence[Meter]) -> Sequence[Meter]:
    """``meters`` without those at branches that are open."""
    rows = _find_rows(network, meters)
    return meters if rows is None else take_items(meters, rows)


def _find_rows(network: Network, meters: Sequence[Meter]) -> np.ndarray | None:
    """The positions of the meters that are not at open branches; None where these are all."""
    if network.table.in_service.all():
        return None
    is_open = {branch.id for branch in network.branches if not branch.in_service}
    in_service = np.array([meter.branch not in is_open for meter in meters], dtype=bool)
    return None if in_service.all() else np.flatnonzero(in_service)
