"""Gauss-Newton on a tree, compiled: the steps of ``kernel``, and the rules of ``decision.decide`` between them."""

from __future__ import annotations

import math

import numpy as np

from dsse_core import gauss_newton
from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import FULL_STEPS, GO_ON, LOST, USE_CURRENTS
from dsse_core.limits import LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA
from dsse_core.radial.block import N_INVERSE, modulus, scaled, square_of, wrap
from dsse_core.radial.kernel import N_FACTOR, N_MORE, SMALL_ANGLE, STEP, count_halves, descend, eliminate, stretch
from dsse_core.radial.root import N_KNOWN, find_root_objective, solve_root

UNUSABLE = -1  # in place of a verdict, or of a number of missing readings: some readings are unusable
N_BLOCK = 4 * N_INVERSE
N_SPACE = 2 * (2 + 1) + 2 * 10 + N_FACTOR + N_MORE + 4 + N_KNOWN + 2  # numbers for a bus: see ``carve``
correct_step, next_step = compiled(gauss_newton.correct_step), compiled(gauss_newton.next_step)
choose_share, is_out_of_reach = compiled(gauss_newton.choose_share), compiled(gauss_newton.is_out_of_reach)


def make_space(n: int) -> np.ndarray:
    """Memory of an iteration on n buses, for ``carve``: one array, as each argument of compiled code takes time.

    Memory that is kept from estimate to estimate is faster than new memory, which the system has to clear first.
    """
    return np.zeros(N_BLOCK + N_SPACE * n)


@compiled
def carve(space, n):
    """``space`` as v, va of two states and the last step; z, w; above, factor, more, block, step of ``kernel``."""
    at = N_BLOCK + 3 * n
    state = space[N_BLOCK : at - n].view(np.complex128), space[at - n : at]
    z, at = _table(space, at, n, 10)
    w, at = _table(space, at, n, 10)
    above, at = _table(space, at, n, N_KNOWN)
    factor, at = _table(space, at, n, N_FACTOR)
    more, at = _table(space, at, n, N_MORE)
    step, at = _table(space, at, n, 4)
    block, _ = _table(space, 0, 4, N_INVERSE)
    other = space[at : at + 2 * n].view(np.complex128), space[at + 2 * n : at + 3 * n]
    last, _ = _table(space, at + 3 * n, n, 2)
    return (*state, *other, last), (z, w), (above, factor, more, block, step)


@compiled
def _table(space, at, n, width):
    """Numbers of ``space`` from ``at`` on as an array (n, width), and the place after it."""
    return space[at : at + n * width].reshape((n, width)), at + n * width


@compiled
def estimate(
    parent, place, Y, order, meter, exact, start, start_va, has_currents,
    tolerance, most_steps, limit, values, sigmas, space, state, residual,
):  # fmt: skip
    """The whole iteration in one call, from the first step to the last one, or until it is lost.

    Fills ``state`` (2, n_bus), vm and va in network order, and ``residual`` (n_meas,), and makes ``sigmas`` 0 where a
    reading is ``exact``. Returns the end, see ``iterate``, the number of steps, the size of the last one, and J; the
    end is UNUSABLE where some readings are. ``space``: see ``make_space``.
    """
    n = len(parent)
    states, (z, w), work = carve(space, n)
    if store(meter, exact, values, sigmas, z, w) != 0:
        return UNUSABLE, 0, np.inf, np.inf
    states[0][:] = start
    states[1][:] = start_va
    end, steps, largest, v, va = iterate(
        parent, place, Y, z, w, states, has_currents, tolerance, most_steps, limit, work
    )  # fmt: skip
    for i in range(n):
        state[0, order[i]], state[1, order[i]] = modulus(v[i]), va[i]
    J = find_residuals(0, n, parent, place, Y, z, w, v, va, has_currents, meter, work[0], work[3][0], residual)
    return end, steps, largest, J


@compiled
def iterate(parent, place, Y, z, w, states, has_currents, tolerance, most_steps, limit, work):
    """Gauss-Newton from the first of the ``states``. Returns the end, the number of steps, the last one's size, v, va.

    Each step leads from one of the two states to the other; ``compare_steps`` keeps the last one behind them. A step is
    taken again where its share turns out shorter, or its angles too large (see ``stretch``). The end is FINAL or
    EVALUATE, the verdict with the last step, with ``limit`` that of J; or LOST: the steps are used up, or the last one
    is larger than LARGEST_STEP or out of reach.
    """
    n = len(parent)
    v, va, v_to, va_to, last = states
    above, factor, more, block, step = work
    flows_known, stepped, end = not has_currents, False, GO_ON
    steps, share, largest, before, J_before = 0, 1.0, 0.0, 0.0, 0.0
    share_before, square_before, square, turn = 1.0, 0.0, 0.0, 0.0
    while end == GO_ON:
        J = eliminate(1, n, parent, Y, z, w, v, va, flows_known, STEP, place, above, factor, more, block, 0.0)[2]
        J += find_root_objective(Y[0], z[0], w[0], v[0], va[0], above[0])
        solve_root(Y[0], z[0], w[0], v[0], va[0], above[0], True, False, block, step)
        uses_currents = has_currents and flows_known
        coming = choose_share(steps, uses_currents, share_before, square_before, square, turn)
        share_before, square_before = share, square if stepped else 0.0
        end, share, before = next_step(
            steps, share, stepped, before, largest, flows_known, has_currents, J, J - J_before, limit, tolerance,
            most_steps, coming,
        )  # fmt: skip
        J_before = J
        if end == LOST:
            break
        dva, dvm, finite = descend(0, n, parent, place, factor, v, va, step, share, v_to, va_to)
        steps, stepped, largest = steps + 1, end == GO_ON, max(dva, dvm) if finite else np.inf
        verdict, length = correct_step(share, stepped, flows_known, dva if finite else np.inf, dvm)
        if verdict == LOST or is_out_of_reach(dvm):
            end = LOST
            break
        if length != share or not length * dva < SMALL_ANGLE:
            halves = count_halves(length * dva)
            descend(0, n, parent, place, factor, v, va, step, length / halves, v_to, va_to)
            if halves > 1.0:
                stretch(v, va, v_to, va_to, halves)
        if uses_currents or steps >= FULL_STEPS - 1:
            square, turn = compare_steps(v, va, v_to, va_to, length, last)
        v, va, v_to, va_to = v_to, va_to, v, va
        stepped = verdict == GO_ON
        square_before *= stepped
        flows_known = flows_known or verdict == USE_CURRENTS
    return end, steps, largest, v, va


@compiled
def compare_steps(v, va, v_to, va_to, length, last):
    """Products of the step of which ``length`` has led to a state, with itself and with ``last``; fills ``last``."""
    square, turn = 0.0, 0.0
    for i in range(len(v)):
        dva, dvm = (va_to[i] - va[i]) / length, (modulus(v_to[i]) - modulus(v[i])) / length
        square += dva * dva + dvm * dvm
        turn += dva * last[i, 0] + dvm * last[i, 1]
        last[i, 0], last[i, 1] = dva, dvm
    return square, turn


@compiled
def store(meter, exact, values, sigmas, z, w):
    """Stores readings in ``z`` and weights in ``w``, both (n, 10): 1 / sigma^2, of injections sigma^2; see ``absent``.

    Entries of ``z`` without a meter do not count. ``meter`` (n, 10): the meter of each slot, -1 without one. The order
    is bus by bus, as entries written in another order leave the processor's cache several times. Makes sigma 0 where a
    reading is ``exact``. Returns the number of missing readings, which are nan, or UNUSABLE where some are.
    """
    usable, missing = True, 0
    for i in range(len(meter)):
        for column in range(10):
            m, of_injection = meter[i, column], column == 2 or column == 3
            if m < 0:
                w[i, column] = -1.0 if of_injection else 0.0
                continue
            value, sigma = values[m], sigmas[m]
            if exact[m]:
                sigmas[m] = sigma = 0.0
                fine = value == 0.0
            else:
                fine = abs(value) < np.inf and LEAST_USABLE_SIGMA < sigma < MOST_USABLE_SIGMA
            z[i, column] = value
            if fine:
                w[i, column] = sigma * sigma if of_injection else 1.0 / (sigma * sigma)
                continue
            usable = usable and math.isnan(value)
            missing += 1
            z[i, column], w[i, column] = 0.0, -1.0 if of_injection else 0.0
    return missing if usable else UNUSABLE


@compiled
def find_residuals(first, end, parent, place, Y, z, w, v, va, has_currents, meter, above, h, residual):
    """Fills ``residual`` (n_meas,), if it is not empty, with z - h(x) of all meters of buses; returns their J.

    The buses are those from ``end`` - 1 down to ``first``, from readings and weights by slot; h(x) is never in memory
    as a whole. ``meter`` (n, 10): the meter of each slot, -1 without one. Powers into branches are added up in
    ``above``, see ``eliminate``, where those into the branches out of a parent above ``first`` are left; ``h`` (10,):
    memory.
    """
    J, keep = 0.0, len(residual) > 0
    for i in range(end - 1, max(first, 0) - 1, -1):  # max: what is never negative takes fewer instructions
        here, p = place[i], parent[i]
        own, at_parent = branch_powers(i, p, Y, v)  # 0 above the root
        square = square_of(v[i])
        h[0], h[1] = va[i], math.sqrt(square)
        h[2] = Y[i, 7].real * square + own.real + above[here, 14]
        h[3] = Y[i, 7].imag * square + own.imag + above[here, 15]
        h[4], h[5], h[7], h[8] = at_parent.real, at_parent.imag, own.real, own.imag
        if has_currents:
            h[6], h[9] = modulus(at_parent) / modulus(v[p]), modulus(own) / h[1]
        above[here, 14] = above[here, 15] = 0.0
        if i > 0:
            above[place[p], 14] += at_parent.real
            above[place[p], 15] += at_parent.imag
        for k in range(10):
            m = meter[i, k]
            if m >= 0:
                r = z[i, k] - h[k]
                if k == 0:
                    r = wrap(r)
                if keep:
                    residual[m] = r
                if k != 2 and k != 3:
                    J += w[i, k] * r * r
                elif w[i, k] > 0.0:
                    J += r * r / w[i, k]
    return J


@compiled
def branch_powers(i, p, Y, v):
    """Power into the branch above bus ``i``, at its own end and at its parent's ``p``."""
    m = v[i] * v[p].conjugate()
    own = scaled(Y[i, 0], square_of(v[i])) + Y[i, 1] * m
    return own, scaled(Y[i, 2], square_of(v[p])) + Y[i, 3] * m.conjugate()
