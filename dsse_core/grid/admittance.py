"""Bus and branch admittances of a network (MATPOWER ``makeYbus``), sparse, p.u."""

from __future__ import annotations

from collections.abc import Callable
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
    table = network.table
    n, active = len(table.bus_id), table.active
    tap, shift = table.tap[active], table.shift[active]
    if (tap == 1.0).all() and (shift == 0.0).all():
        return np.ones(n), np.zeros(n)
    from scipy.sparse.csgraph import breadth_first_order

    start = network.row[reference]
    _, above = breadth_first_order(table.graph, start, directed=False)
    gain, turn = np.ones(n), np.zeros(n)  # from the bus above, of buses out of reach none: observability names them
    for here, there, factor, angle in ((table.t, table.f, tap, shift), (table.f, table.t, 1 / tap, -shift)):
        walked = np.flatnonzero(above[there] == here)[::-1]  # of parallel branches the first
        gain[there[walked]], turn[there[walked]] = factor[walked], angle[walked]
    above = np.where(above < 0, np.arange(n), above)
    return follow(above, gain, np.multiply), follow(above, turn, np.add)


def follow(above: np.ndarray, own: np.ndarray, join: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """``own`` of each bus joined with those of all buses above it, (n_bus,), in log2(depth) steps.

    ``above`` (n_bus,): the next bus on the way to the top, there the bus itself, whose ``own`` changes nothing.
    """
    while True:
        further = above[above]
        own = join(own, own[above])
        if (further == above).all():
            return own
        above = further
