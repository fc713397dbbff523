"""A radial network laid out from its root, compiled: for a small network the calls of numpy would take longest."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.radial.block import N_INVERSE
from dsse_core.radial.kernel import CHECK, N_FACTOR, N_MORE, eliminate
from dsse_core.radial.root import N_KNOWN, solve_root
from dsse_core.radial.walk import find_order

# Least pivot at no load with all sigmas 1, in parts of the largest entry of its column. On 500 random grids, impedances
# over up to four decades, it was at most 2e-16 in undetermined networks and at least 1.5e-9 elsewhere.
LEAST_PIVOT_RATIO = 1e-12
NOT_STUCK = -1


@compiled
def lay_out(ends, in_service, root, n):
    """Number of branches in service, and the tree of n buses from row ``root``.

    The tree: network row of each of its buses; place in it of each network row; number of the bus above each bus, the
    root's is 0; of each branch in service the number of the bus below it, True where its from side is above, and its
    row among all branches. Where the network is no tree the arrays are those of the buses reached. ``ends``
    (2, n_all_branches): rows of buses.
    """
    active = np.flatnonzero(in_service)
    f, t = ends[0][active], ends[1][active]
    order, upstream = find_order(f, t, root, n)
    number, parent = np.full(n, -1), np.zeros(len(order), dtype=np.int64)
    for i in range(len(order)):
        number[order[i]] = i
        parent[i] = number[upstream[order[i]]]
    child, from_parent = np.empty(len(f), dtype=np.int64), np.empty(len(f), dtype=np.bool_)
    for k in range(len(f)):
        from_parent[k] = upstream[t[k]] == f[k]
        child[k] = number[t[k] if from_parent[k] else f[k]]
    return len(active), (order, number, parent, child, from_parent, active)


@compiled
def stack(series, charging, tap, shift, shunt, order, child, from_parent, active, with_shunts):
    """Admittances of the branch above each bus and of its shunt for the compiled passes, (n_bus, 8), complex.

    Conjugates of ``ycc, ycp, ypp, ypc, ypp / ypc, 1 / ypc, ycp / conj(ypc)``, c the child's end and p the parent's
    (see ``build_admittance``), and of the shunt; from columns of ``NetworkTable`` and the tree of ``lay_out``. Shunts
    and charging are 0 if not ``with_shunts``.
    """
    stacked = np.zeros((len(order), 8), dtype=np.complex128)
    share = 1.0 if with_shunts else 0.0
    for k in range(len(child)):
        i, branch = child[k], active[k]
        y, end, ratio = 1.0 / series[branch], 0.5 * share * charging[branch], ratio_of(tap[branch], shift[branch])
        ytt = y + end
        yff, yft, ytf = ytt / (tap[branch] * tap[branch]), -y / ratio.conjugate(), -y / ratio
        down = from_parent[k]
        ycc, ycp = (ytt, ytf) if down else (yff, yft)
        ypp, ypc = (yff, yft) if down else (ytt, ytf)
        stacked[i, 0], stacked[i, 1] = ycc.conjugate(), ycp.conjugate()
        stacked[i, 2], stacked[i, 3] = ypp.conjugate(), ypc.conjugate()
        stacked[i, 4], stacked[i, 5] = (ypp / ypc).conjugate(), (1.0 / ypc).conjugate()
        stacked[i, 6] = (ycp / ypc.conjugate()).conjugate()
    for i in range(len(order)):
        stacked[i, 7] = share * shunt[order[i]].conjugate()
    return stacked


@compiled
def ratio_of(tap, shift):
    """The complex tap ratio of a branch."""
    return complex(tap * math.cos(shift), tap * math.sin(shift))


@compiled
def place_meters(kind, bus, branch, number, parent, child, columns):
    """``find_slots``, and True where all meters fit and no two have one slot.

    ``bus``, ``branch``: rows as ``MeterTable`` has them. ``columns`` (3, n_kind): see ``plan.SLOTS_AT_BUS``.
    """
    slot, taken, fit = np.empty(len(kind), dtype=np.int64), np.zeros(10 * len(parent), dtype=np.bool_), True
    for m in range(len(kind)):
        if not (0 <= kind[m] < columns.shape[1] and branch[m] < len(child)):
            fit = False
            break
        at = number[bus[m]] if bus[m] >= 0 else -1
        below = child[branch[m]] if branch[m] >= 0 else -2
        above = parent[below] if below >= 0 else -2
        column, i = columns[0, kind[m]], at
        if column < 0:
            column, i = columns[1 if at == above else 2, kind[m]], below
            fits = at >= 0 and at in (above, below) and column >= 0
        else:
            fits = at >= 0 and branch[m] == -2
        fit = fit and fits and not taken[10 * i + column]
        if not fit:
            break
        slot[m] = 10 * i + column
        taken[slot[m]] = True
    return slot, fit


@compiled
def find_flat_start(parent, child, from_parent, active, tap, shift, angle):
    """No-load voltages with 1 p.u. and ``angle`` at the root, and their angles, shape (n_bus,) each."""
    start, start_va = np.ones(len(parent), dtype=np.complex128), np.empty(len(parent))
    for k in range(len(child)):
        ratio = ratio_of(tap[active[k]], shift[active[k]])
        start[child[k]] = 1.0 / ratio if from_parent[k] else ratio
    for i in range(1, len(parent)):
        start[i] *= start[parent[i]]
    turn = complex(math.cos(angle), math.sin(angle))
    for i in range(len(parent)):
        start_va[i] = math.atan2(start[i].imag, start[i].real) + angle
        start[i] *= turn
    return start, start_va


@compiled
def find_stuck(parent, place, no_load_Y, w, start, start_va, z, work):
    """The bus with the least pivot ratio at no load, all sigmas 1, if its block is singular there, else NOT_STUCK.

    The meters are those with a weight in ``w`` (n, 10); shunts, charging and meters of currents are left out. ``z``:
    any readings.
    """
    above, factor, more, block, step = work
    alike = np.zeros_like(w)
    for i in range(len(w)):
        for k in range(10):
            if k == 2 or k == 3:
                alike[i, k] = 1.0 if w[i, k] >= 0.0 else -1.0
            elif k != 6 and k != 9:
                alike[i, k] = 1.0 if w[i, k] > 0.0 else 0.0
    n, at_root = len(parent), (no_load_Y[0], z[0], alike[0], start[0], start_va[0])
    ratio, bus, _ = eliminate(
        1, n, parent, no_load_Y, z, alike, start, start_va, False, CHECK, place, above, factor, more, block, 0.0
    )  # fmt: skip
    of_root = solve_root(*at_root, above[0], True, True, block, step)
    if not of_root >= ratio:
        ratio, bus = of_root, 0
    return NOT_STUCK if ratio > LEAST_PIVOT_RATIO else bus


@compiled
def find_stuck_with(parent, no_load_Y, slot, start, start_va):
    """``find_stuck`` with the meters of ``slot``."""
    n = len(parent)
    z, w = np.zeros((n, 10)), np.zeros((n, 10))
    for i in range(n):
        w[i, 2] = w[i, 3] = -1.0
    for m in range(len(slot)):
        w[slot[m] // 10, slot[m] % 10] = 1.0
    above, factor, more = np.zeros((n, N_KNOWN)), np.empty((n, N_FACTOR)), np.empty((n, N_MORE))
    work = above, factor, more, np.empty((4, N_INVERSE)), np.empty((n, 4))
    return find_stuck(parent, np.arange(n), no_load_Y, w, start, start_va, z, work)


@compiled
def plan_tree(ends, in_service, root, angle, series, charging, tap, shift, shunt, kind, bus, branch, columns):
    """Number of branches in service, True where all meters fit, and the stuck bus; and all arrays of a ``RadialPlan``.

    One call does the work of the functions above. The results after the first wrong one do not count.
    """
    n = len(shunt)
    n_branch, (order, number, parent, child, from_parent, active) = lay_out(ends, in_service, root, n)
    fit, stuck, has_currents = False, NOT_STUCK, False
    level, slot = np.zeros(len(order), dtype=np.int64), np.empty(0, dtype=np.int64)
    start, start_va = np.empty(0, dtype=np.complex128), np.empty(0)
    loaded = no_load = np.empty((0, 8), dtype=np.complex128)
    if len(order) == n and n_branch == n - 1:
        slot, fit = place_meters(kind, bus, branch, number, parent, child, columns)
    if fit:
        for i in range(1, n):
            level[i] = level[parent[i]] + 1
        for m in range(len(slot)):
            has_currents = has_currents or slot[m] % 10 == 6 or slot[m] % 10 == 9
        of_tree = order, child, from_parent, active
        loaded = stack(series, charging, tap, shift, shunt, *of_tree, True)
        no_load = stack(series, charging, tap, shift, shunt, *of_tree, False)
        start, start_va = find_flat_start(parent, child, from_parent, active, tap, shift, angle)
        stuck = find_stuck_with(parent, no_load, slot, start, start_va)
    return (
        (n_branch, fit, stuck),
        (order, parent, loaded, no_load, slot, start, start_va, level, has_currents),
    )
