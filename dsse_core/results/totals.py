"""Totals of areas as sums of the powers into branch ends and shunts, and their variances by the same sums."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.results.deviations.branch_variances import BranchGradients
from dsse_core.results.flows import find_shunt_powers
from dsse_core.results.state import GridState

TOTALS = ("load", "generation", "loss", "import")
Entries = tuple[np.ndarray, np.ndarray, np.ndarray]  # row of the total, branch or bus, and its coefficient


@dataclass(frozen=True)
class Division:
    """The area of each bus and branch, as its place in ``names``: ``of_bus`` (n_bus,), ``of_branch`` (n_branch,)."""

    names: tuple[str, ...]
    of_bus: np.ndarray
    of_branch: np.ndarray

    def owners(self, bus: np.ndarray) -> list[str]:
        """The area of each ``bus``, a row of the network, by name."""
        return [self.names[k] for k in self.of_bus[bus].tolist()]


def whole_network(network: Network, name: str = "") -> Division:
    """The division of ``network`` into a single area, ``name``."""
    return Division((name,), np.zeros(len(network.buses), np.int64), np.zeros(len(network.branches), np.int64))


def division_of(partition: Partition) -> Division:
    """The division by ``partition``: buses go to their owners, branches to the areas that hold them, open branches to
    the owners of their from buses.
    """
    names = tuple(area.name for area in partition.areas)
    if len(names) == 1:
        return whole_network(partition.network, names[0])
    table, owner, holder = partition.network.table, partition.owner, partition.holder
    return Division(names, owner, np.where(holder >= 0, holder, owner[table.rows.find(table.from_bus)]))


@dataclass(frozen=True)
class Shares:
    """Coefficients of P, or Q, of each total as a sum of powers into branches at their two ends, and into shunts.

    Rows: TOTALS, each of all areas. ``at_from``, ``at_to`` (4 n_area, n_row of the branches), ``of_shunt`` (4 n_area,
    n_nodes).
    """

    at_from: sp.csr_array
    at_to: sp.csr_array
    of_shunt: sp.csr_array


def find_shares(state: GridState, division: Division, injection: np.ndarray) -> Shares:
    """The shares of P or of Q, whichever the nodes' ``injection`` (n_nodes,) is.

    A node that injects counts as generation, any other one as load. Where the injection is nan, both totals of the area
    are.
    """
    n, branches, node = len(division.names), state.branches, np.arange(len(injection))
    of_node, of_branch = division.of_bus[state.network.table.nodes.item], division.of_branch[branches.branch]
    load, generation, loss, came = (k * n for k in range(len(TOTALS)))
    injects = injection > 0

    def of_nodes(of: np.ndarray, at: np.ndarray) -> Iterator[Entries]:
        """Entries of the powers into branches or shunts ``of`` at nodes ``at``, as parts of the injections there."""
        drawn, made = ~injects[at], injects[at] | np.isnan(injection[at])
        yield load + of_node[at[drawn]], of[drawn], np.full(drawn.sum(), -1.0)
        yield generation + of_node[at[made]], of[made], np.ones(made.sum())

    def of_end(end: np.ndarray) -> sp.csr_array:
        closed = np.flatnonzero(branches.in_service & (end >= 0))
        crossing = closed[of_node[end[closed]] != of_branch[closed]]
        entries = [
            *of_nodes(closed, end[closed]),
            (loss + of_branch[closed], closed, np.ones(len(closed))),
            (came + of_branch[crossing], crossing, np.ones(len(crossing))),
            (came + of_node[end[crossing]], crossing, np.full(len(crossing), -1.0)),
        ]
        return _gather(entries, (len(TOTALS) * n, len(end)))

    of_shunts = [*of_nodes(node, node), (loss + of_node, node, np.ones(len(node)))]
    return Shares(of_end(branches.f), of_end(branches.t), _gather(of_shunts, (len(TOTALS) * n, len(node))))


def _gather(entries: list[Entries], shape: tuple[int, int]) -> sp.csr_array:
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    return sp.csr_array((values, (rows, columns)), shape=shape)


def find_totals(state: GridState, division: Division, sorted_by: np.ndarray | None = None) -> np.ndarray:
    """P and Q of TOTALS of each area, p.u., (2, 4, n_area); nan where a part of the total is not known.

    ``sorted_by`` (n_nodes,): injections by whose signs nodes count as generation or load; by default the state's.
    """
    injection = state.injection if sorted_by is None else sorted_by
    flows, shunt = state.flows, find_shunt_powers(state.network, state.vm, state.va)
    found = []
    for part in (np.real, np.imag):
        shares = find_shares(state, division, part(injection))
        ends = shares.at_from @ part(flows.s_from) + shares.at_to @ part(flows.s_to)
        found.append((ends + shares.of_shunt @ part(shunt)).reshape(len(TOTALS), -1))
    return np.array(found)


def find_total_gradients(
    state: GridState, division: Division, at_from: np.ndarray, gradients: BranchGradients
) -> tuple[sp.csr_array, sp.csr_array]:
    """Derivatives of P of TOTALS of all areas, then of Q: by (p, q, ln u) of each branch at the end that ``at_from``
    names, (8 n_area, 3 n_branch), and by ln vm of each bus, (8 n_area, n_bus).
    """
    by_ends, by_buses = [], []
    near_is_from = at_from[:, None]
    of_from = np.where(near_is_from, gradients.near, gradients.far)
    of_to = np.where(near_is_from, gradients.far, gradients.near)
    shunt = find_shunt_powers(state.network, state.vm, state.va)
    for part in (np.real, np.imag):
        shares = find_shares(state, division, part(state.injection))
        by_ends.append(shares.at_from @ _by_branch(part(of_from)) + shares.at_to @ _by_branch(part(of_to)))
        by_buses.append(shares.of_shunt @ sp.diags_array(2 * part(shunt)))
    return sp.csr_array(sp.vstack(by_ends)), sp.csr_array(sp.vstack(by_buses))


def _by_branch(gradient: np.ndarray) -> sp.csr_array:
    """The gradients (n_branch, 3) as a matrix with a block for each branch, (n_branch, 3 n_branch)."""
    n = len(gradient)
    return sp.csr_array((gradient.ravel(), np.arange(3 * n), 3 * np.arange(n + 1)), shape=(n, 3 * n))
