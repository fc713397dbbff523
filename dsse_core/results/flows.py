"""Currents and powers at both ends of every branch, and injections at all nodes, from voltages; p.u."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import find_primitives, find_shunts, find_two_ports
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import PhaseRows


@dataclass(frozen=True)
class BranchModel:
    """The conductors of all branches of a network, (n_row,), branch by branch: one of a balanced branch, else one for
    each phase that the branch has at either end.

    ``branch``: row of the branch. ``phase``: place in PHASES. ``f``, ``t``: nodes of the conductor's ends, -1 where it
    has no such end. ``from_port``, ``to_port``: ports there, -1 also out of service.
    """

    network: Network
    branch: np.ndarray
    phase: np.ndarray
    f: np.ndarray
    t: np.ndarray
    from_port: np.ndarray
    to_port: np.ndarray
    in_service: np.ndarray

    @cached_property
    def y(self) -> np.ndarray:
        """The entries of the admittances of branches in service, in the order of ``NetworkTable.of_ports``."""
        return find_primitives(self.network, with_shunts=True)

    def list_ports(self, flows: Flows) -> tuple[np.ndarray, np.ndarray]:
        """Powers and currents into all ports, (n_port + 1,), complex, p.u.; the last one, 0, stands for no port."""
        found = np.zeros((2, len(self.network.table.ports) + 1), dtype=complex)
        found[:, self.from_port], found[:, self.to_port] = (flows.s_from, flows.i_from), (flows.s_to, flows.i_to)
        found[:, -1] = 0.0
        return found[0], found[1]

    @cached_property
    def two_ports(self) -> TwoPorts:
        """The branches as two-ports, in a balanced network."""
        table, there = self.network.table, self.in_service
        yff, yft, ytf, ytt = (there * y for y in find_two_ports(table, np.arange(len(there))))
        end = 0.5 * table.charging
        return TwoPorts(yff, yft, ytf, ytt, there * end * (2 / table.series + end) / table.tap**2)


@dataclass(frozen=True)
class TwoPorts:
    """``yff``, ``yft``, ``ytf``, ``ytt``: see ``find_two_ports``; (n_branch,), 0 for branches out of service. ``det``:
    ``yff ytt - yft ytf``, found without cancellation.
    """

    yff: np.ndarray
    yft: np.ndarray
    ytf: np.ndarray
    ytt: np.ndarray
    det: np.ndarray


def build_branch_model(network: Network) -> BranchModel:
    """The branches of ``network``, those out of service included."""
    table = network.table
    rows = PhaseRows(np.bitwise_or(*table.branch_phases))
    nodes, ports, active = [], [], table.active_row[rows.item]
    for end in (0, 1):
        is_there = table.branch_phases[end, rows.item] >> rows.phase & 1 != 0
        nodes.append(np.where(is_there, table.nodes.find(table.end_rows[end, rows.item], rows.phase), -1))
        of_end = np.where(active < 0, -1, end * len(table.active) + active)
        ports.append(np.where(is_there, table.ports.find(of_end, rows.phase), -1))
    (f, t), (from_port, to_port), in_service = nodes, ports, table.in_service[rows.item]
    return BranchModel(network, rows.item, rows.phase, f, t, from_port, to_port, in_service)


@dataclass(frozen=True)
class Flows:
    """Complex currents ``i_from``, ``i_to`` and powers ``s_from``, ``s_to`` into each conductor at its two ends, p.u.,
    (n_row,); 0 out of service and where it has no such end, nan where a voltage of its branch is nan.
    """

    i_from: np.ndarray
    i_to: np.ndarray
    s_from: np.ndarray
    s_to: np.ndarray

    @property
    def loss(self) -> np.ndarray:
        """The sum of the powers at both ends, complex, p.u., (n_row,): series losses and charging."""
        return np.asarray(self.s_from + self.s_to)


def find_flows(branches: BranchModel, v: np.ndarray) -> Flows:
    """The flows at the complex voltages ``v`` of all ports, (n_port,), p.u."""
    row, column = branches.network.table.of_ports
    i = _add_up(row, branches.y * v[column], len(v))
    s = np.append(v * i.conj(), 0.0)  # the last one stands for no port
    i = np.append(i, 0.0)
    return Flows(i[branches.from_port], i[branches.to_port], s[branches.from_port], s[branches.to_port])


def _add_up(at: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """The sums of the complex ``values`` (k,) at the same places ``at`` (k,), (n,); what is at -1 does not count."""
    there = at >= 0
    at, values = at[there], values[there]
    return np.asarray(np.bincount(at, values.real, n) + 1j * np.bincount(at, values.imag, n))


def find_shunt_powers(network: Network, vm: np.ndarray, va: np.ndarray) -> np.ndarray:
    """The power that shunts consume at each node, complex, (n_nodes,), p.u.; ``vm``, ``va`` (n_nodes,).

    A shunt of a bus without ground draws no common current of its phases.
    """
    y, row, column = find_shunts(network)
    y, row, column = y[y != 0], row[y != 0], column[y != 0]
    v = vm * np.exp(1j * va)
    return _add_up(row, v[row] * (y * v[column]).conj(), len(v))


def differentiate_shunt_powers(network: Network, vm: np.ndarray, va: np.ndarray) -> sp.csr_array:
    """The derivatives of ``find_shunt_powers`` by [va; vm], complex, (n_nodes, 2 n_nodes).

    With ``i = Y v`` and ``s = v i*``: ``ds = dv i* + v (Y dv)*``, and ``dv = j v dva + v / |v| dvm``.
    """
    y, row, column = find_shunts(network)
    n, v = len(vm), vm * np.exp(1j * va)
    Y = sp.csr_array((y, (row, column)), shape=(n, n))
    by_v = [1j * v, v / vm]
    own, at = sp.diags_array((Y @ v).conj()), sp.diags_array(v)
    return sp.csr_array(sp.hstack([own @ sp.diags_array(dv) + at @ (Y @ sp.diags_array(dv)).conj() for dv in by_v]))


def find_injections(
    network: Network, branches: BranchModel, flows: Flows, vm: np.ndarray, va: np.ndarray
) -> np.ndarray:
    """Generation minus load at each node, complex, (n_nodes,), p.u.: the sum of powers into its branches and its shunt.

    Nan where ``vm`` (n_nodes,) is.
    """
    s = find_shunt_powers(network, vm, va)
    for end, power in ((branches.f, flows.s_from), (branches.t, flows.s_to)):
        s = s + _add_up(end, power, len(vm))
    return np.where(np.isnan(vm), complex(np.nan, np.nan), s)
