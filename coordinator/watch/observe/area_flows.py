"""Flows in one area: tables from the state that the area publishes and the network in its area file."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from agents.messages.packing import StateMessage
from dsse_core.errors import InvalidInputError
from dsse_core.grid.partition import Area
from dsse_core.printable import listed
from dsse_core.results.branches import make_branch_table
from dsse_core.results.buses import make_bus_table
from dsse_core.results.state import find_state
from dsse_core.results.table import ScanLabel, Table

MOST_NAMED = 12


def make_area_flows(area: Area, state: StateMessage) -> tuple[Table, Table]:
    """Buses and branches that the area sees, in kV, kW, kvar and A.

    The state has voltages and their standard deviations; those of all other quantities, and true values, are nan. The
    injection of a boundary bus includes the flows from outside the area. Angles without the substation's reference are
    nan; flows are known even then.

    Raises:
        InvalidInputError: the state has other buses than the area.
    """
    network = area.network
    place = {bus: k for k, bus in enumerate(state.buses)}
    if place.keys() != network.row.keys():
        names = listed(sorted(place.keys() ^ network.row.keys()), MOST_NAMED)
        problem = f"the area on the bus and the file differ in bus {names}; give the file that its agent has"
        raise InvalidInputError(f"area file of {area.name!r}", [problem])
    order = [place[bus] for bus in network.row]
    vm, va, sigma_vm, sigma_va = (
        np.array(numbers, dtype=float)[order] for numbers in (state.vm, state.va, state.sigma_vm, state.sigma_va)
    )
    found, unknown = find_state(network, vm, va), np.full(len(vm), np.nan)
    shown = found if state.referenced else replace(found, va=unknown)
    deviations = sigma_vm, sigma_va if state.referenced else unknown, np.full((2, len(vm)), np.nan)
    label = ScanLabel(str(state.header.scan), state.taken_at or math.nan)
    compared = {"decentralised": (shown.vm, shown.va)}
    buses = make_bus_table(shown, [area.name] * len(vm), compared, *deviations, label)
    return buses, make_branch_table(network, found.branches, found.flows, label=label)
