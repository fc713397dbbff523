"""The table of areas: load, generation, losses, and what comes in over the boundaries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.results.flows import find_shunt_powers
from dsse_core.results.state import GridState
from dsse_core.results.table import PHASE, Table
from dsse_core.results.units import base_kw

OF_A_RUN = (
    "gap_vm_pu",
    "gap_va_deg",
    "error_vm_pu",
    "error_va_deg",
    "exchanges",
    "messages",
    "bytes",
    "lost",
    "rejected",
    "objective",
    "degrees_of_freedom",
    "removed",
    "critical",
)
"""Figures of an area that only a run has, and then ``quality``."""


@dataclass(frozen=True)
class Division:
    """The area of each bus and branch, as its place in ``names``: ``of_bus`` (n_bus,), ``of_branch`` (n_branch,)."""

    names: tuple[str, ...]
    of_bus: np.ndarray
    of_branch: np.ndarray

    def owners(self) -> list[str]:
        """The area of each bus by name."""
        return [self.names[k] for k in self.of_bus.tolist()]


def whole_network(network: Network, name: str = "") -> Division:
    """One area."""
    return Division((name,), np.zeros(len(network.buses), np.int64), np.zeros(len(network.branches), np.int64))


def division_of(partition: Partition) -> Division:
    """A boundary bus belongs to its owner, a branch to the area that holds it; an open one to that of its from bus."""
    names = tuple(area.name for area in partition.areas)
    if len(names) == 1:
        return whole_network(partition.network, names[0])
    number = {name: k for k, name in enumerate(names)}
    owner, network = partition.owner_of_bus, partition.network
    of_branch = {branch.id: number[area.name] for area in partition.areas for branch in area.network.branches}
    return Division(
        names,
        np.array([number[owner[bus.id]] for bus in network.buses], dtype=np.int64),
        np.array([of_branch.get(b.id, number[owner[b.from_bus]]) for b in network.branches], dtype=np.int64),
    )


def make_area_table(
    state: GridState,
    division: Division,
    of_run: Mapping[str, np.ndarray] | None = None,
    quality: Sequence[str] | None = None,
) -> Table:
    """One row per area; ``of_run``: the columns OF_A_RUN. Balance: ``generation + import = load + loss``.

    A bus that injects counts as generation with what it injects, the substation too, one that draws as load; P and Q
    each by itself. ``loss``: of the area's branches with their charging, and of the shunts at its buses. ``import``:
    what comes from other areas over the boundary buses. An area of which something is not known has nan.
    """
    kw, n = base_kw(state.network), len(division.names)
    s = state.injection
    shunt = find_shunt_powers(state.network, state.vm)
    loss = _sum(division.of_branch, state.flows.loss, n) + _sum(division.of_bus, shunt, n)
    generation = np.maximum(s.real, 0) + 1j * np.maximum(s.imag, 0)
    made, drawn = _sum(division.of_bus, generation, n), _sum(division.of_bus, generation - s, n)
    came = _find_imports(state, division)
    columns: dict[str, np.ndarray | Sequence[str]] = {
        "area": division.names,
        "phase": [PHASE] * n,
        "owned_buses": np.bincount(division.of_bus, minlength=n),
    }
    for what, power in (("load", drawn), ("generation", made), ("loss", loss), ("import", came)):
        columns |= {f"{what}_kw": power.real * kw, f"{what}_kvar": power.imag * kw}
    unknown = np.full(n, np.nan)
    columns |= {key: (of_run or {}).get(key, unknown) for key in OF_A_RUN}
    return Table("areas", columns | {"quality": quality or [""] * n})


def _find_imports(state: GridState, division: Division) -> np.ndarray:
    """What flows into branches of an area at buses of another one, minus what flows from its buses into others'."""
    n = len(division.names)
    found = np.zeros(n, dtype=complex)
    for end, power in ((state.branches.f, state.flows.s_from), (state.branches.t, state.flows.s_to)):
        crossing = np.flatnonzero(division.of_bus[end] != division.of_branch)
        found += _sum(division.of_branch[crossing], power[crossing], n)
        found -= _sum(division.of_bus[end[crossing]], power[crossing], n)
    return found


def _sum(where: np.ndarray, power: np.ndarray, n: int) -> np.ndarray:
    return np.asarray(np.bincount(where, power.real, n) + 1j * np.bincount(where, power.imag, n))
