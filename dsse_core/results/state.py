"""A state of the whole grid with its flows: of one estimate or power flow, or joined from the states of areas."""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import QUANTITY, average, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.grid.quantities import Phasors, QuantityRows
from dsse_core.results.flows import BranchModel, Flows, build_branch_model, find_flows, find_injections

Taps: TypeAlias = Mapping[str, tuple[float, float]]
"""Branch -> its estimated tap ratio, and the standard deviation of that."""


class EstimatedTap(NamedTuple):
    """An estimated tap ratio, and by how many steps it is above that of the network file; nan where it has no steps."""

    ratio: float
    sigma: float
    steps: float


@dataclass(frozen=True, repr=False)
class GridState:
    """A state. ``vm`` p.u., ``va`` rad, ``injection`` complex, p.u.: (n_nodes,), network order; nan where unknown.

    ``injection`` is generation minus load; a bus' shunt is not a part of it. ``taps``: estimated ones, by branch, which
    ``network`` has, too.
    """

    network: Network
    branches: BranchModel
    vm: np.ndarray
    va: np.ndarray
    flows: Flows
    injection: np.ndarray
    taps: Mapping[str, EstimatedTap] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<GridState of {self.network.name!r}: {len(self.vm)} nodes, {np.isnan(self.vm).sum()} unknown>"


def find_state(
    network: Network, vm: np.ndarray, va: np.ndarray, branches: BranchModel | None = None, taps: Taps | None = None
) -> GridState:
    """The state of voltages vm, va (n_nodes,), p.u. and rad; ``branches``: of ``network``, if there already.

    ``taps``: estimated ones, in place of those of ``network``.
    """
    network, estimated = _take_taps(network, taps or {})
    branches = branches or build_branch_model(network)
    v = vm * np.exp(1j * va)
    flows = find_flows(branches, v[network.table.port_node])
    return GridState(network, branches, vm, va, flows, find_injections(network, branches, flows, vm, va), estimated)


def _take_taps(network: Network, taps: Taps) -> tuple[Network, dict[str, EstimatedTap]]:
    """The network with estimated ``taps``, and these with their steps."""
    found = {}
    for name in network.estimated_taps.keys() & taps.keys():
        branch, (ratio, sigma) = network.branch(name), taps[name]
        steps = (ratio - branch.tap) / branch.tap_steps if branch.tap_steps else math.nan
        found[name] = EstimatedTap(ratio, sigma, steps)
    return network.with_taps({name: tap.ratio for name, tap in found.items()}), found


@dataclass(frozen=True, repr=False)
class AreaVoltages:
    """The voltages that an area states of the nodes that it sees, in its order: vm p.u., va rad.

    ``referenced``: whether the angles count from the substation. Flows are known without that, too. ``scan``: number of
    the scan whose state it is. ``taps``: those that the area estimates.
    """

    vm: np.ndarray
    va: np.ndarray
    referenced: bool
    scan: int = 0
    taps: Taps = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<AreaVoltages of {len(self.vm)} nodes, {'absolute' if self.referenced else 'relative'} angles>"


def join_states(partition: Partition, by_area: Mapping[str, AreaVoltages]) -> GridState:
    """The state that areas have found together; an area that is not in ``by_area`` knows nothing.

    The voltage of a bus is that of its owner. The flow in a branch follows from the voltages of the area that holds it.
    The injection of a boundary bus is the sum of the powers into its shunt and the branches of all areas there; nan
    where their voltages are of different scans.
    """
    of_areas = [own.taps for own in by_area.values()]
    network, taps = _take_taps(partition.network, dict(ChainMap(*map(dict, of_areas))))
    branches, n = build_branch_model(network), network.n_nodes
    vm, va = np.full(n, np.nan), np.full(n, np.nan)
    at_ports = np.full(len(network.table.ports), complex(np.nan, np.nan))
    for k, area in enumerate(partition.areas):
        if (found := by_area.get(area.name)) is None:
            continue
        rows = partition.rows_of_nodes[area.name]
        owned = partition.owner[network.table.nodes.item[rows]] == k
        vm[rows[owned]] = found.vm[owned]
        if found.referenced:
            va[rows[owned]] = found.va[owned]
        v = found.vm * np.exp(1j * found.va)
        at_ports[partition.rows_of_ports[area.name]] = v[area.network.table.port_node]
    flows = find_flows(branches, at_ports)
    injection = find_injections(network, branches, flows, vm, va)
    for bus, names in partition.boundaries.items():
        if len({by_area[name].scan for name in names if name in by_area}) > 1:
            injection[network.nodes_at(bus)] = complex(np.nan, np.nan)
    return GridState(network, branches, vm, va, flows, injection, taps)


def read_state(state: GridState, meters: Sequence[Meter]) -> np.ndarray:
    """The readings of perfect ``meters``, which fit the network, in this state, p.u. and rad, (n_meas,).

    Angles lie in (-pi, pi].
    """
    (table, of_meter), (s, i) = tabulate_meters(state.network, meters).spread(), state.branches.list_ports(state.flows)
    at_branch, port, node, other = table.branch >= 0, table.port, table.node, table.other
    s = np.where(at_branch, s[port], state.injection[node])
    vm, va = state.vm[node], state.va[node]
    if other is not None and (between := other >= 0).any():
        v = state.vm * np.exp(1j * state.va)
        u = v[node] - np.where(between, v[other], 0.0)
        with np.errstate(invalid="ignore"):  # what is unknown stays so
            s = np.where(between, s * u / v[node], s)  # the same current
        vm, va = np.where(between, abs(u), vm), np.where(between, np.angle(u), va)
    phasors = _PhasorsOfState(s, i[port], at_branch, vm, va)
    return average(QuantityRows(QUANTITY[table.kind]).read(phasors), of_meter)


class _PhasorsOfState(Phasors):
    """Powers, voltages and, at branches, currents that a state has in its own form, to the last bit."""

    def __init__(self, s: np.ndarray, i: np.ndarray, at_branch: np.ndarray, vm: np.ndarray, va: np.ndarray) -> None:
        self.s, self._i, self._at_branch, self._vm, self._va = s, i, at_branch, vm, va

    def currents(self, rows: np.ndarray) -> np.ndarray:
        at_branch, vm, va = self._at_branch[rows], self._vm[rows], self._va[rows]
        if at_branch.all():
            return np.asarray(self._i[rows])
        with np.errstate(invalid="ignore"):
            of_buses = (self.s[rows] / (vm * np.exp(1j * va))).conj()
        return np.asarray(np.where(at_branch, self._i[rows], of_buses))

    def magnitudes(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(self._vm[rows])

    def angles(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(np.pi - (np.pi - self._va[rows]) % (2 * np.pi))
