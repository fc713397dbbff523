"""Bus and branch admittances of a network (MATPOWER ``makeYbus``), sparse, p.u."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.network import Network


@dataclass(frozen=True)
class Admittance:
    """``stacked`` (n + 2 n_branch, n): ``ybus`` (n, n), ``yf`` and ``yt`` (n_branch, n) below each other.

    For voltages ``v`` the currents are ``ybus v`` into the network, ``yf v`` and ``yt v`` into the ends of branches.
    Rows of ``ybus`` follow ``network.buses``, rows of ``yf`` and ``yt`` follow ``network.active_branches``.
    Every row stores an entry, be it zero, for its own bus.
    """

    stacked: sp.csr_array

    @cached_property
    def ybus(self) -> sp.csr_array:
        return sp.csr_array(self.stacked[: self.stacked.shape[1]])


def build_admittance(network: Network, *, with_shunts: bool = True) -> Admittance:
    """Build the admittances; a branch with tap ``t = tap * exp(j shift)`` at its from side has

    ``yff = (ys + (g + j b) / 2) / |t|^2``, ``yft = -ys / conj(t)``, ``ytf = -ys / t``, ``ytt = ys + (g + j b) / 2``.
    ``with_shunts=False`` leaves out g, b and bus shunts, all that draws current without load.
    """
    table = network.table
    f, t, ys, ratio = table.f, table.t, table.ys, table.ratio
    n, n_branch = len(table.bus_id), len(f)
    ytt = ys + table.ends * with_shunts
    yff = ytt / abs(ratio) ** 2
    yft = -ys / ratio.conj()
    ytf = -ys / ratio
    shunt = table.shunt * with_shunts

    bus, at_from, at_to = np.arange(n), n + np.arange(n_branch), n + n_branch + np.arange(n_branch)
    entries = np.concatenate([yff, yft, ytf, ytt, shunt, yff, yft, ytf, ytt])
    rows = np.concatenate([f, f, t, t, bus, at_from, at_from, at_to, at_to])
    columns = np.concatenate([f, t, f, t, bus, f, t, f, t])
    return Admittance(sp.coo_array((entries, (rows, columns)), shape=(n + 2 * n_branch, n)).tocsr())


def flat_start(network: Network, reference: int) -> tuple[np.ndarray, np.ndarray]:
    """The voltages (vm, va) that the unloaded network would have with 1 p.u., 0 rad at bus ``reference``.

    Walks from the reference over the branches and follows tap ratios and phase shifts.
    """
    vm, va = walk_unloaded(network, reference)
    return vm, np.angle(np.exp(1j * va))


def walk_unloaded(network: Network, reference: int) -> tuple[np.ndarray, np.ndarray]:
    """``flat_start`` with angles as the walk adds them up: they may be beyond half a turn."""
    vm, va = np.zeros(len(network.buses)), np.zeros(len(network.buses))
    vm[network.row[reference]] = 1.0
    queue = [reference]
    while queue:
        here = queue.pop()
        row = network.row[here]
        for branch in network.branches_at[here]:
            there = network.row[branch.other_end(here)]
            if vm[there] == 0:
                is_forward = here == branch.from_bus
                vm[there] = vm[row] / branch.tap if is_forward else vm[row] * branch.tap
                va[there] = va[row] - branch.shift if is_forward else va[row] + branch.shift
                queue.append(branch.other_end(here))
    vm[vm == 0] = 1.0  # buses out of reach of the reference; observability analysis names them
    return vm, va
