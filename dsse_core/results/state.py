"""A state of the whole grid with its flows: of one estimate or power flow, or joined from the states of areas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.meter_table import KINDS, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.results.flows import BranchModel, Flows, build_branch_model, find_flows, find_injections

KIND = MeasurementKind


@dataclass(frozen=True, repr=False)
class GridState:
    """A state. ``vm`` p.u., ``va`` rad, ``injection`` complex, p.u.: (n_bus,), network order; nan where unknown.

    ``injection`` is generation minus load; a bus' shunt is not a part of it.
    """

    network: Network
    branches: BranchModel
    vm: np.ndarray
    va: np.ndarray
    flows: Flows
    injection: np.ndarray

    def __repr__(self) -> str:
        return f"<GridState of {self.network.name!r}: {len(self.vm)} buses, {np.isnan(self.vm).sum()} unknown>"


def find_state(network: Network, vm: np.ndarray, va: np.ndarray, branches: BranchModel | None = None) -> GridState:
    """The state of voltages vm, va (n_bus,), p.u. and rad; ``branches``: of ``network``, if there already."""
    branches = branches or build_branch_model(network)
    v = vm * np.exp(1j * va)
    flows = find_flows(branches, v[branches.f], v[branches.t])
    return GridState(network, branches, vm, va, flows, find_injections(network, branches, flows, vm))


@dataclass(frozen=True, repr=False)
class AreaVoltages:
    """The voltages that an area states of the buses that it sees, in its order: vm p.u., va rad.

    ``referenced``: whether the angles count from the substation. Flows are known without that, too. ``scan``: number of
    the scan whose state it is.
    """

    vm: np.ndarray
    va: np.ndarray
    referenced: bool
    scan: int = 0

    def __repr__(self) -> str:
        return f"<AreaVoltages of {len(self.vm)} buses, {'absolute' if self.referenced else 'relative'} angles>"


def join_states(partition: Partition, by_area: Mapping[str, AreaVoltages]) -> GridState:
    """The state that areas have found together; an area that is not in ``by_area`` knows nothing.

    The voltage of a bus is that of its owner. The flow in a branch follows from the voltages of the area that holds it.
    The injection of a boundary bus is the sum of the powers into its shunt and the branches of all areas there; nan
    where their voltages are of different scans.
    """
    network = partition.network
    branches, n = build_branch_model(network), len(network.buses)
    vm, va = np.full(n, np.nan), np.full(n, np.nan)
    ends = np.full((2, len(network.branches)), complex(np.nan, np.nan))
    for k, area in enumerate(partition.areas):
        if (found := by_area.get(area.name)) is None:
            continue
        rows, at = partition.rows_of_buses[area.name], partition.rows_of_branches[area.name]
        owned = partition.owner[rows] == k
        vm[rows[owned]] = found.vm[owned]
        if found.referenced:
            va[rows[owned]] = found.va[owned]
        v, table = found.vm * np.exp(1j * found.va), area.network.table
        ends[0, at], ends[1, at] = (v[table.rows.find(end)] for end in (table.from_bus, table.to_bus))
    flows = find_flows(branches, ends[0], ends[1])
    injection = find_injections(network, branches, flows, vm)
    for bus, names in partition.boundaries.items():
        if len({by_area[name].scan for name in names if name in by_area}) > 1:
            injection[network.row[bus]] = complex(np.nan, np.nan)
    return GridState(network, branches, vm, va, flows, injection)


def read_state(state: GridState, meters: Sequence[Meter]) -> np.ndarray:
    """The readings of perfect ``meters``, which fit the network, in this state, p.u. and rad, (n_meas,).

    Angles lie in (-pi, pi].
    """
    table, f = tabulate_meters(state.network, meters), state.branches.f
    bus, active = table.bus, state.network.table.active
    branch = np.append(active, -1)[np.maximum(table.branch, -1)]
    at_from = (branch >= 0) & (np.append(f, -1)[branch] == bus)
    s = state.injection[bus]
    i = np.zeros(len(meters), dtype=complex)
    for of_end, power, current in (
        ((branch >= 0) & at_from, state.flows.s_from, state.flows.i_from),
        ((branch >= 0) & ~at_from, state.flows.s_to, state.flows.i_to),
    ):
        s[of_end], i[of_end] = power[branch[of_end]], current[branch[of_end]]
    groups = (KIND.VM,), (KIND.VA,), (KIND.CURRENT,), (KIND.Q_FLOW, KIND.Q_INJECTION)
    chosen = [np.isin(table.kind, [KINDS.index(kind) for kind in group]) for group in groups]
    return np.asarray(
        np.select(chosen, [state.vm[bus], np.pi - (np.pi - state.va[bus]) % (2 * np.pi), abs(i), s.imag], s.real)
    )
