"""Statuses of switches, as the areas that hold them have published them."""

from __future__ import annotations

from collections.abc import Mapping

from agents.messages.packing import StateMessage
from dsse_core.grid.partition import Partition
from dsse_core.grid.switches import read_statuses


def find_statuses(partition: Partition, states: Mapping[str, StateMessage]) -> dict[str, bool]:
    """Switch -> True where it is closed in the estimate of the area that holds it."""
    found: dict[str, bool] = {}
    for area in partition.areas:
        if area.network.switches and area.name in states:
            closed = read_statuses(states[area.name].switches)
            found |= {switch: closed[switch] for switch in area.network.switches if switch in closed}
    return found
