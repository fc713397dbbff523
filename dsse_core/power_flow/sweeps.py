"""Power flows of a radial network by backward and forward sweeps, row by row, compiled with numba.

With the currents ``i_c`` and ``i_p`` into a branch at its child's and its parent's end:

backward: ``i_c = conj(s / v_c) - y_shunt v_c - sum of i_p below``, ``i_p = (ypp i_c - det v_c) / ycp``,
forward: ``v_c = (i_c - ycp v_p) / ycc``; ``det = ycc ypp - ycp ypc = y (2 ys + y) / |t|^2``, y at each end.
"""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.grid.network import Network
from dsse_core.power_flow.path_sums import MOST_SWEEPS, SMALLEST_CHANGE, TreePaths
from dsse_core.radial.block import modulus, scaled
from dsse_core.radial.iteration import branch_powers
from dsse_core.radial.layout import stack


def build_tables(network: Network, paths: TreePaths) -> tuple[np.ndarray, np.ndarray]:
    """``ypp / ycp, -det / ycp, 1 / ycc, ycp / ycc`` of the branch above each bus, and its shunt, shape (n_bus, 5); and
    the admittances of ``layout.stack``.
    """
    table, place = network.table, np.empty(len(paths.order), dtype=np.int64)
    place[paths.order] = np.arange(len(place))
    f, t = place[table.f], place[table.t]
    child, columns = np.maximum(f, t), (table.series, table.charging, table.tap, table.shift, table.shunt)
    Y = stack(*columns, paths.order, child, f < t, table.active, True)
    ycc, ycp, ypp = Y[child, :3].conj().T
    factors = np.zeros((len(place), 5), dtype=complex)
    det = table.ends * (2 * table.ys + table.ends) / abs(table.ratio) ** 2
    factors[child, :4] = np.stack([ypp / ycp, -det / ycp, 1 / ycc, ycp / ycc], axis=1)
    factors[:, 4] = Y[:, 7].conj()
    return factors, Y


@compiled
def sweep_rows(order, parent, factors, Y, start, start_va, limit, p, q, v, current, s, vm, va, sweeps, met):
    """A power flow for each row of ``p`` and ``q`` (n_row, n_bus), network order, from ``start`` (n_bus,), tree order.

    Fills ``vm``, ``va`` (n_row, n_bus) in network order, ``sweeps`` and whether every bus but the root has ``met`` its
    schedule to ``limit`` (n_bus,), tree order: (n_row,). ``v``, ``current``, ``s``: memory, (n_bus,) each, complex.
    """
    n = len(parent)
    for k in range(len(p)):
        for i in range(n):
            s[i] = complex(p[k, order[i]], q[k, order[i]])
            v[i] = start[i]
        sweeps[k] = _sweep(parent, factors, s, v, current)
        met[k] = sweeps[k] > 0 and _meets(parent, Y, v, s, current, limit)
        if not met[k]:
            continue
        for i in range(n):
            turned = v[i] * start[i].conjugate()
            vm[k, order[i]] = modulus(v[i])
            va[k, order[i]] = start_va[i] + math.atan2(turned.imag, turned.real)


@compiled
def _meets(parent, Y, v, s, power, limit):
    """True where the power into the network of every bus but the root is ``s`` to ``limit``; overwrites ``power``."""
    for i in range(len(parent)):
        power[i] = scaled(Y[i, 7], v[i].real ** 2 + v[i].imag ** 2)
    for i in range(1, len(parent)):
        own, at_parent = branch_powers(i, parent[i], Y, v)
        power[i] += own
        power[parent[i]] += at_parent
    met = True
    for i in range(1, len(parent)):
        met = met and modulus(power[i] - s[i]) <= limit[i]
    return met


@compiled
def _sweep(parent, factors, s, v, current):
    """Improves ``v`` in place; returns the number of sweeps, 0 where they do not converge; overwrites ``current``."""
    n = len(parent)
    for sweep in range(1, MOST_SWEEPS + 1):
        for i in range(n):
            current[i] = (s[i] / v[i]).conjugate() - factors[i, 4] * v[i]
        for i in range(n - 1, 0, -1):
            current[parent[i]] -= factors[i, 0] * current[i] + factors[i, 1] * v[i]
        change = 0.0
        for i in range(1, n):
            following = factors[i, 2] * current[i] - factors[i, 3] * v[parent[i]]
            change = max(change, abs(following - v[i]))
            v[i] = following
        if not change < np.inf:
            return 0
        if change < SMALLEST_CHANGE:
            return sweep
    return 0
