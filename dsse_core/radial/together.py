"""Scans of the same meters and sigmas side by side: one compiled iteration for LANES rows, each with its own end."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import FULL_STEPS, GO_ON
from dsse_core.radial.block import N_INVERSE, modulus
from dsse_core.radial.iteration import correct_step, find_objective, move, next_step, place_of
from dsse_core.radial.kernel import N_FACTOR, N_MORE, STEP, eliminate, substitute
from dsse_core.radial.lanes import LANES, as_complex_lanes, as_lanes
from dsse_core.radial.root import N_KNOWN

N_BLOCK = 4 * N_INVERSE
N_SPACE = 2 + 1 + 10 + N_FACTOR + N_MORE + 4 + N_KNOWN  # lanes for a bus: see ``_carve``
ALIGNED = 64  # bytes
MOST_BUSES = 20_000  # from some 10,000 on memory limits the speed; a thread needs 3 kB of it for each bus


def count_bytes(n: int) -> int:
    """Size of ``make_space`` of n buses."""
    return 8 * LANES * (N_BLOCK + N_SPACE * n)


def make_space(n: int) -> np.ndarray:
    """Memory of an iteration on n buses, (:, LANES), each row of it in one line of the processor's cache.

    Empty for no bus, for more than MOST_BUSES, and where code is not compiled, as lanes exist in compiled code only.
    """
    if not 0 < n <= MOST_BUSES or not hasattr(estimate_together, "py_func"):
        return np.empty((0, LANES))
    memory = np.zeros(LANES * (N_BLOCK + N_SPACE * n) + ALIGNED // 8)
    first = -memory.ctypes.data % ALIGNED // 8
    return memory[first : first + LANES * (N_BLOCK + N_SPACE * n)].reshape(-1, LANES)


@compiled
def _carve(space, n):
    """``space`` as v, va, z, above, factor, more, step and block; see ``kernel``."""
    at = N_BLOCK
    v = space[at : at + 2 * n].reshape((n, 2, LANES))
    at += 2 * n
    va = space[at : at + n]
    at += n
    z = space[at : at + 10 * n].reshape((n, 10, LANES))
    at += 10 * n
    above = space[at : at + N_KNOWN * n].reshape((n, N_KNOWN, LANES))
    at += N_KNOWN * n
    factor = space[at : at + N_FACTOR * n].reshape((n, N_FACTOR, LANES))
    at += N_FACTOR * n
    more = space[at : at + N_MORE * n].reshape((n, N_MORE, LANES))
    at += N_MORE * n
    step = space[at : at + 4 * n].reshape((n, 4, LANES))
    return v, va, z, above, factor, more, step, space[:N_BLOCK].reshape((4, N_INVERSE, LANES))


@compiled
def estimate_together(
    parent, place, Y, order, slot, exact, start, start_va, starts, tolerance, limit, values, w, space,
    vm, va_found, objective, steps,
):  # fmt: skip
    """``rows.estimate_rows`` of LANES rows, whose weights ``w`` (n, 10) are the same, without currents.

    Returns True where all rows have an estimate after full steps. Else no result counts: a reading is missing or
    unusable, or a row needs shorter or more steps.
    """
    n = len(parent)
    v, va, z, above, factor, more, step, block = _carve(space, n)
    if not _store_rows(slot, exact, values, z):
        return False
    V, VA, Z, S = as_complex_lanes(v), as_lanes(va), as_lanes(z), as_lanes(step)
    if len(starts) == 0:
        for i in range(n):
            V[i], VA[i] = start[i], start_va[i]
    else:
        _begin(order, starts, v, va)
    of_tree = parent, place, Y, Z, w, V, VA
    work = as_lanes(above), as_lanes(factor), as_lanes(more), as_lanes(block), S
    if not _iterate(of_tree, work, tolerance, limit, steps):
        return False
    total = np.empty((1, LANES))
    as_lanes(total)[0] = find_objective(parent, Y, Z, w, V, VA, False, S)
    objective[:] = total[0]
    for i in range(n):
        S[i, 0] = modulus(V[i])
        for k in range(LANES):
            vm[k, order[i]], va_found[k, order[i]] = step[i, 0, k], va[i, k]
    return True


@compiled
def _store_rows(slot, exact, values, z):
    """Stores readings in ``z``; True where all are there and usable."""
    usable = True
    for m in range(len(slot)):
        i, column = place_of(slot[m])
        for k in range(LANES):
            value = values[k, m]
            z[i, column, k] = value
            usable = usable and abs(value) < np.inf and not (exact[m] and value != 0.0)
    return usable


@compiled
def _begin(order, starts, v, va):
    for i in range(len(order)):
        for k in range(LANES):
            begin = min(k, len(starts) - 1)
            angle, magnitude = starts[begin, 1, order[i]], starts[begin, 0, order[i]]
            va[i, k], v[i, 0, k], v[i, 1, k] = angle, magnitude * math.cos(angle), magnitude * math.sin(angle)


@compiled
def _iterate(of_tree, work, tolerance, limit, steps):
    """``iteration.iterate`` with full steps for all rows that have not ended; True where all end by these."""
    parent, place, Y, z, w, v, va = of_tree
    above, factor, more, block, step = work
    totals = np.zeros((4, LANES))  # J, |dva|, |dvm|, share of the step
    together, largest, before = as_lanes(totals), np.zeros(LANES), np.zeros(LANES)
    verdict = np.full(LANES, GO_ON)
    for taken in range(FULL_STEPS):
        together[0] = eliminate(parent, Y, z, w, v, va, False, STEP, place, above, factor, more, block, step)[2]
        together[1], together[2], finite = substitute(parent, factor, v, step)
        if not finite:
            return False
        waiting = 0
        for k in range(LANES):
            totals[3, k] = 1.0 if verdict[k] == GO_ON else 0.0
            if verdict[k] != GO_ON:
                continue
            J, dva, dvm, steps[k] = totals[0, k], totals[1, k], totals[2, k], taken + 1
            verdict[k], share, before[k] = next_step(
                taken, 1.0, taken > 0, before[k], largest[k], True, False, J, limit[k], tolerance, FULL_STEPS
            )
            largest[k] = max(dva, dvm)
            if correct_step(share, True, True, dva, dvm)[0] != GO_ON:
                return False
            waiting += verdict[k] == GO_ON
        move(v, va, step, together[3], together[1])
        if waiting == 0:
            return True
    return False
