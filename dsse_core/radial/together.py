"""Scans of the same meters and sigmas side by side: one compiled iteration for LANES rows, each with its own end."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import FULL_STEPS, GO_ON
from dsse_core.radial.block import N_INVERSE, modulus
from dsse_core.radial.iteration import N_BLOCK, correct_step, find_residuals, next_step
from dsse_core.radial.kernel import N_FACTOR, N_MORE, SMALL_ANGLE, STEP, count_halves, descend, eliminate, stretch
from dsse_core.radial.lanes import LANES, as_complex_lanes, as_lanes
from dsse_core.radial.root import N_KNOWN, find_root_objective, solve_root

N_SPACE = 2 * (2 + 1) + 10 + N_FACTOR + N_MORE + 4 + N_KNOWN  # lanes for a bus: see ``_carve``
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
    """``space`` as ``iteration.carve`` has it, without weights."""
    of_v, at = _table(space, N_BLOCK, 2 * n, 2)
    of_va, at = space[at : at + 2 * n], at + 2 * n
    z, at = _table(space, at, n, 10)
    above, at = _table(space, at, n, N_KNOWN)
    factor, at = _table(space, at, n, N_FACTOR)
    more, at = _table(space, at, n, N_MORE)
    step, at = _table(space, at, n, 4)
    block, _ = _table(space, 0, 4, N_INVERSE)
    return (of_v[:n], of_va[:n], of_v[n:], of_va[n:]), z, (above, factor, more, block, step)


@compiled
def _table(space, at, n, width):
    return space[at : at + n * width].reshape((n, width, LANES)), at + n * width


@compiled
def estimate_together(
    parent, place, Y, order, meter, exact, start, start_va, starts, tolerance, limit, values, w, space,
    vm, va_found, objective, steps,
):  # fmt: skip
    """``rows.estimate_rows`` of LANES rows, whose weights ``w`` (n, 10) are the same, without currents.

    Returns True where all rows have an estimate after full steps. Else no result counts: a reading is missing or
    unusable, or a row needs shorter or more steps.
    """
    n = len(parent)
    (v, va, v_to, va_to), z, (above, factor, more, block, step) = _carve(space, n)
    if not _store_rows(meter, exact, values, z):
        return False
    states = as_complex_lanes(v), as_lanes(va), as_complex_lanes(v_to), as_lanes(va_to)
    Z, work = as_lanes(z), (as_lanes(above), as_lanes(factor), as_lanes(more), as_lanes(block), as_lanes(step))
    if len(starts) == 0:
        for i in range(n):
            states[0][i], states[1][i] = start[i], start_va[i]
    else:
        _begin(order, starts, v, va)
    taken = _iterate(parent, place, Y, Z, w, states, tolerance, limit, work, steps)
    if taken == 0:
        return False
    V, VA = (states[2], states[3]) if taken % 2 > 0 else (states[0], states[1])
    total, found = np.empty((1, LANES)), np.empty((2, LANES))
    as_lanes(total)[0] = find_residuals(
        0, n, parent, place, Y, Z, w, V, VA, False, meter, work[0], work[3][0], work[3][0, :0]
    )
    objective[:] = total[0]
    together = as_lanes(found)
    for i in range(n):
        together[0], together[1] = modulus(V[i]), VA[i]
        for k in range(LANES):
            vm[k, order[i]], va_found[k, order[i]] = found[0, k], found[1, k]
    return True


@compiled
def _store_rows(meter, exact, values, z):
    """Stores readings in ``z``; True where all are there and usable."""
    usable = True
    for i in range(len(meter)):
        for column in range(10):
            m = meter[i, column]
            if m >= 0:
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
def _iterate(parent, place, Y, z, w, states, tolerance, limit, work, steps):
    """``iteration.iterate`` with full steps for all rows that have not ended.

    Returns the number of steps by which all have ended, from one of the ``states`` to the other; 0 where some do not.
    """
    n = len(parent)
    v, va, v_to, va_to = states
    above, factor, more, block, step = work
    totals = np.zeros((4, LANES))  # J, |dva|, |dvm|, share of the step
    together, largest, before, J_before = as_lanes(totals), np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    verdict = np.full(LANES, GO_ON)
    for taken in range(FULL_STEPS):
        J = eliminate(1, n, parent, Y, z, w, v, va, False, STEP, place, above, factor, more, block, 0.0)[2]
        together[0] = J + find_root_objective(Y[0], z[0], w[0], v[0], va[0], above[0])
        solve_root(Y[0], z[0], w[0], v[0], va[0], above[0], True, False, block, step)
        for k in range(LANES):
            totals[3, k] = 1.0 if verdict[k] == GO_ON else 0.0
        length = together[3]
        together[1], together[2], finite = descend(
            0, n, parent, place, factor, v, va, step, length, v_to, va_to
        )  # fmt: skip
        if not finite:
            return 0
        waiting, turn = 0, 0.0
        for k in range(LANES):
            if verdict[k] != GO_ON:
                continue
            dva, dvm, steps[k] = totals[1, k], totals[2, k], taken + 1
            change = totals[0, k] - J_before[k]
            of_step = taken, 1.0, taken > 0, before[k], largest[k], True, False, totals[0, k], change, limit[k]
            verdict[k], share, before[k] = next_step(*of_step, tolerance, FULL_STEPS, 1.0)
            largest[k], turn, J_before[k] = max(dva, dvm), max(turn, dva), totals[0, k]
            if correct_step(share, True, True, dva, dvm)[0] != GO_ON:
                return 0
            waiting += verdict[k] == GO_ON
        if not turn < SMALL_ANGLE:
            halves = count_halves(turn)
            descend(0, n, parent, place, factor, v, va, step, length / halves, v_to, va_to)
            stretch(v, va, v_to, va_to, halves)
        v, va, v_to, va_to = v_to, va_to, v, va
        if waiting == 0:
            return taken + 1
    return 0
