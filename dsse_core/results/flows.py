"""Currents and powers at both ends of every branch, and injections of all buses, from voltages; p.u."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.grid.admittance import find_two_ports
from dsse_core.grid.network import Network


@dataclass(frozen=True)
class BranchModel:
    """All branches of a network as arrays, (n_branch,), in the order of ``network.branches``.

    ``f``, ``t``: rows of their buses. ``yff``, ``yft``, ``ytf``, ``ytt``: see ``find_two_ports``; 0 for branches
    out of service. ``det``: ``yff ytt - yft ytf``, found without cancellation.
    """

    f: np.ndarray
    t: np.ndarray
    yff: np.ndarray
    yft: np.ndarray
    ytf: np.ndarray
    ytt: np.ndarray
    det: np.ndarray
    in_service: np.ndarray


def build_branch_model(network: Network) -> BranchModel:
    """The branches of ``network``, those out of service included."""
    network.check_balanced("the table of its branches")
    table = network.table
    (f, t), in_service = table.end_rows, table.in_service
    yff, yft, ytf, ytt = (in_service * y for y in find_two_ports(table, np.arange(len(in_service))))
    end = 0.5 * table.charging
    det = in_service * end * (2 / table.series + end) / table.tap**2
    return BranchModel(f, t, yff, yft, ytf, ytt, det, in_service)


@dataclass(frozen=True)
class Flows:
    """Complex currents ``i_from``, ``i_to`` and powers ``s_from``, ``s_to`` into each branch at its two ends, p.u.,
    (n_branch,); 0 where the branch is out of service, nan where a voltage at its ends is nan.
    """

    i_from: np.ndarray
    i_to: np.ndarray
    s_from: np.ndarray
    s_to: np.ndarray

    @property
    def loss(self) -> np.ndarray:
        """The sum of the powers at both ends, complex, p.u., (n_branch,): series losses and charging."""
        return np.asarray(self.s_from + self.s_to)


def find_flows(branches: BranchModel, v_from: np.ndarray, v_to: np.ndarray) -> Flows:
    """The flows at the complex voltages of the two ends of each branch, (n_branch,), p.u."""
    there = branches.in_service
    v_from, v_to = np.where(there, v_from, 0.0), np.where(there, v_to, 0.0)
    i_from = branches.yff * v_from + branches.yft * v_to
    i_to = branches.ytf * v_from + branches.ytt * v_to
    return Flows(i_from, i_to, v_from * i_from.conj(), v_to * i_to.conj())


def find_shunt_powers(network: Network, vm: np.ndarray) -> np.ndarray:
    """The power that the shunt of each bus consumes, complex, (n_bus,), p.u.; ``vm`` (n_bus,)."""
    shunt = network.table.shunt.conj()
    return np.where(shunt == 0, 0.0, shunt * vm**2)


def find_injections(network: Network, branches: BranchModel, flows: Flows, vm: np.ndarray) -> np.ndarray:
    """Generation minus load of each bus, complex, (n_bus,), p.u.: the sum of powers into its branches and its shunt.

    Nan where ``vm`` (n_bus,) is.
    """
    n = len(network.buses)
    s = find_shunt_powers(network, vm)
    for end, power in ((branches.f, flows.s_from), (branches.t, flows.s_to)):
        s = s + np.bincount(end, power.real, n) + 1j * np.bincount(end, power.imag, n)
    return np.where(np.isnan(vm), complex(np.nan, np.nan), s)
