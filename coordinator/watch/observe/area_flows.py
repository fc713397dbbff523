"""Flows in one area: tables from the state that the area publishes and the network in its area file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from agents.messages.packing import StateMessage
from coordinator.watch.observe.freshness import freshness_of_state
from dsse_core.errors import InvalidInputError
from dsse_core.grid.boundary import Kind
from dsse_core.grid.nodes import name_node
from dsse_core.grid.partition import Area
from dsse_core.printable import listed
from dsse_core.results.branches import make_branch_table
from dsse_core.results.buses import make_bus_table
from dsse_core.results.state import GridState, find_state
from dsse_core.results.table import Freshness, ScanLabel, Table, mark_rows

MOST_NAMED = 12


def make_area_flows(area: Area, state: StateMessage, freshness: Freshness | None = None) -> tuple[Table, Table]:
    """Buses and branches that the area sees, in kV, kW, kvar and A.

    The state has voltages and their standard deviations; those of all other quantities, and true values, are nan. The
    injection of a boundary bus is known in the area that owns the bus, if it knows the powers into its children; else
    it is nan, and ``injection_problem`` says why. Angles without the substation's reference are nan; flows are
    known even then. ``freshness``: of the numbers; as the area states it, without that of a watcher.

    Raises:
        InvalidInputError: the state has other nodes than the area.
    """
    network = area.network
    place, own = {node: k for k, node in enumerate(state.nodes)}, network.nodes
    if place.keys() != set(own):
        names = listed([name_node(*node) for node in sorted(place.keys() ^ set(own))], MOST_NAMED)
        problem = f"the area on the bus and the file differ in bus {names}; give the file that its agent has"
        raise InvalidInputError(f"area file of {area.name!r}", [problem])
    order = [place[node] for node in own]
    vm, va, sigma_vm, sigma_va = (
        np.array(numbers, dtype=float)[order] for numbers in (state.vm, state.va, state.sigma_vm, state.sigma_va)
    )
    found, unknown = find_state(network, vm, va, taps=state.taps), np.full(len(vm), np.nan)
    found, problems = _find_own_injections(area, state, found)
    shown = found if state.referenced else replace(found, va=unknown)
    deviations = sigma_vm, sigma_va if state.referenced else unknown, np.full((2, len(vm)), np.nan)
    label = ScanLabel(str(state.header.scan), state.taken_at or math.nan)
    compared = {"decentralised": (shown.vm, shown.va)}
    counts, marks = (len(vm), len(found.branches.branch)), [freshness or freshness_of_state(state)]
    of_buses, of_branches = (mark_rows(marks, np.zeros(count, dtype=np.int64)) for count in counts)
    buses = make_bus_table(shown, [area.name] * len(vm), compared, *deviations, label, of_buses)
    branches = make_branch_table(found, label=label, marks=of_branches)
    return add_problems(buses, problems), branches


def add_problems(buses: Table, problems: Mapping[int, str]) -> Table:
    """The table with the column ``injection_problem``; ``problems``: bus -> the reason that has no injection."""
    why = [problems.get(bus, "") for bus in buses.bus.tolist()]
    return Table("buses", {name: buses[name] for name in buses.columns} | {"injection_problem": why})


def _find_own_injections(area: Area, state: StateMessage, found: GridState) -> tuple[GridState, dict[int, str]]:
    """The state with the injections of the buses alone: flows of the area's branches at a boundary bus, and the powers
    into its children. Boundary bus -> the reason that its injection is not known.
    """
    injection, network, powers = found.injection.copy(), area.network, area.powers_into_children
    is_parents = area.parent is not None and all(there.has_one_flow for there in area.boundaries.values())
    owner = area.parent.area if area.parent and is_parents else "another area"
    problems = dict.fromkeys(area.not_owned, f"{owner} owns this bus")
    if len(state.into_children) != len(powers):
        for bus in {power.bus for power in powers}:
            children = listed([*dict.fromkeys(power.area for power in powers if power.bus == bus)], MOST_NAMED)
            problems[bus] = f"{area.name} does not know the power into {children}"
    else:
        for power, value in zip(powers, state.into_children, strict=True):
            injection[network.node(power.bus, power.phase)] += value if power.kind is Kind.P else 1j * value
    for bus in problems:
        injection[network.nodes_at(bus)] = complex(np.nan, np.nan)
    return replace(found, injection=injection), problems
