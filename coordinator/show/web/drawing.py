"""The drawing of a grid, its constant part: places of buses, branches, areas, limits; the API's ``/api/grid``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from agents.messages.packing import StateMessage
from coordinator.show.figures.feeder_layout import find_places, lay_out
from coordinator.show.figures.feeder_profile import find_distances
from dsse_core.estimation.state_limits import DEFAULT_OPERATING_LIMITS, OperatingLimits
from dsse_core.grid.columns import read_given
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import write_phases
from dsse_core.results.flows import build_branch_model
from dsse_core.results.table import ALL_PHASES, name_phases
from scenarios.scenario import Scenario

BUSES_IN_A_ROW = 8  # of an area that is known from the bus alone
DECIMALS = 6  # of distances


@dataclass(frozen=True)
class Drawing:
    """A drawn grid as it is sent. ``version``: differs between different drawings; every moment names its version."""

    version: str
    payload: bytes


def encode_drawing(content: Mapping[str, Any], mode: str) -> Drawing:
    """The drawing of ``content`` for a page of ``mode``."""
    version = hashlib.sha256(msgspec.json.encode(content)).hexdigest()[:16]
    return Drawing(version, msgspec.json.encode({"version": version, "mode": mode, **content}))


def draw_scenario(scenario: Scenario) -> dict[str, Any]:
    """The grid of ``scenario``: buses in the order of its network, branches in that of its branches; with phases nodes
    and conductors in the order of the tables.
    """
    partition, network = scenario.partition, scenario.network
    on_map = find_places(network)
    place, (distance, axis) = lay_out(network).place if on_map is None else on_map, find_distances(network)
    ids = network.table.bus_id.tolist()
    sees: dict[int, list[str]] = {bus: [] for bus in ids}
    for area in partition.areas:
        for bus in area.network.buses:
            sees[bus.id].append(area.name)
    holds = {branch.id: area.name for area in partition.areas for branch in area.network.branches}
    return {
        "known": True,
        "title": scenario.name,
        "axis": axis,
        "is_map": on_map is not None,
        "operating_limits": _describe_limits(scenario.operating_limits),
        "buses": {
            "id": ids,
            "phase": [write_phases(phases) or ALL_PHASES for phases in network.table.nodes.sets.tolist()],
            "name": list(read_given(network.buses, "name")) or [""] * len(ids),
            "base_kv": network.table.base_kv.tolist(),
            "x": place[:, 0].tolist(),
            "y": place[:, 1].tolist(),
            "distance": [round(value, DECIMALS) if np.isfinite(value) else None for value in distance.tolist()],
            "area": [partition.owner_of_bus[bus] for bus in ids],
            "areas": [sees[bus] for bus in ids],
        },
        "branches": {
            "id": list(network.branch_ids),
            "from_bus": network.table.from_bus.tolist(),
            "to_bus": network.table.to_bus.tolist(),
            "in_service": [branch.in_service for branch in network.branches],
            "area": [holds.get(branch.id, "") for branch in network.branches],
        },
        "areas": [
            {
                "name": area.name,
                "buses": [bus.id for bus in area.network.buses],
                "neighbours": [{"area": n.area, "bus": n.bus} for n in area.neighbours],
            }
            for area in partition.areas
        ],
        **_list_nodes(network.nodes),
        **({} if network.table.nodes.is_balanced else _list_conductors(network)),
    }


def _list_conductors(network: Network) -> dict[str, Any]:
    conductors = build_branch_model(network)
    branches = [network.branch_ids[k] for k in conductors.branch.tolist()]
    return {"conductors": {"branch": branches, "phase": name_phases(conductors.phase)}}


def draw_states(run: str, states: Mapping[str, StateMessage]) -> dict[str, Any]:
    """The grid as far as ``states`` tell, with the keys of ``draw_scenario``: areas side by side, their buses in rows,
    no branches.
    """
    keys = "id", "phase", "name", "base_kv", "x", "y", "distance", "area", "areas"
    buses: dict[str, list[Any]] = {key: [] for key in keys}
    row_of: dict[int, int] = {}
    phases = _find_phases(states.values())
    areas, left = [], 0
    for name, state in states.items():
        own = tuple(dict.fromkeys(state.buses))  # with phases a bus is there once for each
        for k, bus in enumerate(own):
            if bus in row_of:
                buses["areas"][row_of[bus]].append(name)
                continue
            row_of[bus] = len(buses["id"])
            place = left + k % BUSES_IN_A_ROW, k // BUSES_IN_A_ROW
            values = bus, "".join(phases[bus]) or ALL_PHASES, "", None, *place, None, name, [name]
            for key, value in zip(buses, values, strict=True):
                buses[key].append(value)
        left += min(BUSES_IN_A_ROW, len(own)) + 2
        shared = {other: sorted({*state.buses} & {*states[other].buses}) for other in state.sent if other in states}
        neighbours = [{"area": other, "bus": bus} for other, found in shared.items() for bus in found]
        areas.append({"name": name, "buses": list(own), "neighbours": neighbours})
    return {
        "known": False,
        "title": run,
        "axis": "",
        "is_map": False,
        "operating_limits": _describe_limits(DEFAULT_OPERATING_LIMITS),
        "buses": buses,
        "branches": {key: [] for key in ("id", "from_bus", "to_bus", "in_service", "area")},
        "areas": areas,
        **_list_nodes([(bus, phase) for bus in buses["id"] for phase in phases[bus]]),
    }


def _find_phases(states: Iterable[StateMessage]) -> dict[int, list[str]]:
    """Bus -> its phases in all ``states``, [""] in a balanced network."""
    seen: dict[int, set[str]] = {}
    for state in states:
        for bus, phase in state.nodes:
            seen.setdefault(bus, set()).add(phase)
    return {bus: sorted(phases) for bus, phases in seen.items()}


def _list_nodes(nodes: Sequence[tuple[int, str]]) -> dict[str, Any]:
    """The columns of ``nodes``, which are there with phases only."""
    if not any(phase for _, phase in nodes):
        return {}
    return {"nodes": {"bus": [bus for bus, _ in nodes], "phase": [phase or ALL_PHASES for _, phase in nodes]}}


def _describe_limits(limits: OperatingLimits) -> dict[str, Any]:
    return {
        "lowest_vm_pu": limits.lowest_vm,
        "highest_vm_pu": limits.highest_vm,
        "most_loading_percent": limits.most_loading_percent,
        "most_residual": limits.most_residual,
        "most_unbalance_percent": limits.most_unbalance_percent,
    }
