"""Gauss-Newton on a tree, compiled: the steps of ``kernel``, and the rules of ``decision.decide`` between them."""

from __future__ import annotations

import math

import numpy as np

from dsse_core import gauss_newton
from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import GO_ON, LOST, USE_CURRENTS
from dsse_core.limits import LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA
from dsse_core.radial.block import N_INVERSE, modulus, scaled, wrap
from dsse_core.radial.kernel import N_FACTOR, N_MORE, SMALL_ANGLE, STEP, descend, eliminate, turned
from dsse_core.radial.root import N_KNOWN

UNUSABLE = -1  # in place of a verdict: some readings are unusable
N_BLOCK = 4 * N_INVERSE
N_SPACE = 2 * (2 + 1) + 2 * 10 + N_FACTOR + N_MORE + 4 + N_KNOWN  # numbers for a bus: see ``carve``, ``carve_next``
correct_step, next_step = compiled(gauss_newton.correct_step), compiled(gauss_newton.next_step)
is_out_of_reach = compiled(gauss_newton.is_out_of_reach)


def make_space(n: int) -> np.ndarray:
    """Memory of an iteration on n buses, for ``carve``: one array, as each argument of compiled code takes time.

    Memory that is kept from estimate to estimate is faster than new memory, which the system has to clear first.
    """
    return np.zeros(N_BLOCK + N_SPACE * n)


@compiled
def carve(space, n):
    """``space`` as v, va, z, w, above, factor, more, step and block; see ``kernel``."""
    at = N_BLOCK
    v = space[at : at + 2 * n].view(np.complex128)
    at += 2 * n
    va = space[at : at + n]
    at += n
    z = space[at : at + 10 * n].reshape((n, 10))
    at += 10 * n
    w = space[at : at + 10 * n].reshape((n, 10))
    at += 10 * n
    above = space[at : at + N_KNOWN * n].reshape((n, N_KNOWN))
    at += N_KNOWN * n
    factor = space[at : at + N_FACTOR * n].reshape((n, N_FACTOR))
    at += N_FACTOR * n
    more = space[at : at + N_MORE * n].reshape((n, N_MORE))
    at += N_MORE * n
    step = space[at : at + 4 * n].reshape((n, 4))
    return v, va, z, w, above, factor, more, step, space[:N_BLOCK].reshape((4, N_INVERSE))


@compiled
def carve_next(space, n):
    """The rest of ``space``: v and va of the state that a step leads to."""
    end = N_BLOCK + N_SPACE * n
    return space[end - 3 * n : end - n].view(np.complex128), space[end - n : end]


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
    v, va, z, w, above, factor, more, step, block = carve(space, n)
    if not store(meter, exact, values, sigmas, z, w):
        return UNUSABLE, 0, np.inf, np.inf
    v[:] = start
    va[:] = start_va
    end, steps, largest = iterate(
        parent, place, Y, z, w, v, va, has_currents, tolerance, most_steps, limit,
        above, factor, more, block, step, carve_next(space, n),
    )  # fmt: skip
    for i in range(n):
        state[0, order[i]], state[1, order[i]] = modulus(v[i]), va[i]
    J = find_residuals(parent, place, Y, z, w, v, va, has_currents, meter, above, block[0], residual)
    return end, steps, largest, J


@compiled
def iterate(
    parent, place, Y, z, w, v, va, has_currents, tolerance, most_steps, limit, above, factor, more, block, step, ahead
):  # fmt: skip
    """Gauss-Newton from ``v`` and ``va``, which are changed. Returns the end, the number of steps, the last one's size.

    Each step leads from one memory of v and va to the other, ``ahead``, see ``carve_next``. A step is taken again where
    its share turns out shorter, or its angles too large for ``small`` (see ``descend``). The end is FINAL or EVALUATE,
    the verdict with the last step, with ``limit`` that of J; or LOST: the steps are used up, or the last one is larger
    than LARGEST_STEP or out of reach.
    """
    found, found_va = v, va
    v_to, va_to = ahead
    moves = 0
    flows_known, stepped, end = not has_currents, False, GO_ON
    steps, share, largest, before = 0, 1.0, 0.0, 0.0
    while end == GO_ON:
        J = eliminate(parent, Y, z, w, v, va, flows_known, STEP, place, above, factor, more, block, step)[2]
        end, share, before = next_step(
            steps, share, stepped, before, largest, flows_known, has_currents, J, limit, tolerance, most_steps
        )
        if end == LOST:
            break
        dva, dvm, finite = descend(parent, place, factor, v, va, step, share, True, v_to, va_to)
        steps, stepped, largest = steps + 1, end == GO_ON, max(dva, dvm) if finite else np.inf
        verdict, length = correct_step(share, stepped, flows_known, dva if finite else np.inf, dvm)
        if verdict == LOST or is_out_of_reach(dvm):
            end = LOST
            break
        if length != share or not length * dva < SMALL_ANGLE:
            descend(parent, place, factor, v, va, step, length, length * dva < SMALL_ANGLE, v_to, va_to)
        v, va, v_to, va_to, moves = v_to, va_to, v, va, moves + 1
        stepped = verdict == GO_ON
        flows_known = flows_known or verdict == USE_CURRENTS
    if moves % 2 > 0:
        for i in range(len(v)):
            found[i], found_va[i] = v[i], va[i]
    return end, steps, largest


@compiled
def forget_meters(w):
    """Sets ``w`` (n, 10) to the weights without any meter: see ``absent``."""
    for i in range(len(w)):
        for k in range(10):
            w[i, k] = 0.0
        w[i, 2] = w[i, 3] = -1.0


@compiled
def place_of(slot):
    """Bus and column of ``slot``, unsigned: signed division would double the time of a loop over the meters."""
    unsigned = np.uint64(slot)
    return unsigned // np.uint64(10), unsigned % np.uint64(10)


@compiled
def store(meter, exact, values, sigmas, z, w):
    """Stores readings in ``z`` and weights in ``w``, both (n, 10): 1 / sigma^2, of injections sigma^2; see ``absent``.

    Entries of ``z`` without a meter do not count. ``meter`` (n, 10): the meter of each slot, -1 without one. The order
    is bus by bus, as entries written in another order leave the processor's cache several times. Makes sigma 0 where a
    reading is ``exact``. Returns True where all readings are usable.
    """
    usable = True
    for i in range(len(meter)):
        for column in range(10):
            m, of_injection = meter[i, column], column == 2 or column == 3
            if m < 0:
                w[i, column] = -1.0 if of_injection else 0.0
                continue
            value, sigma = values[m], sigmas[m]
            if exact[m]:
                sigmas[m] = sigma = 0.0
                usable = usable and value == 0.0
            else:
                usable = usable and abs(value) < np.inf and LEAST_USABLE_SIGMA < sigma < MOST_USABLE_SIGMA
            z[i, column] = value
            w[i, column] = sigma * sigma if of_injection else 1.0 / (sigma * sigma)
    return usable


@compiled
def subtract(slot, values, sigmas, h, residual):
    """Stores z - h(x) of every meter in ``residual``, differences of angles wrapped to (-pi, pi]. Returns J."""
    J = 0.0
    for k in range(len(slot)):
        i, column = place_of(slot[k])
        r = values[k] - h[i, column]
        residual[k] = wrap(r) if column == 0 else r
        if sigmas[k] > 0.0:
            J += (residual[k] / sigmas[k]) ** 2
    return J


@compiled
def find_residuals(parent, place, Y, z, w, v, va, has_currents, meter, above, h, residual):
    """Fills ``residual`` as ``predict`` and ``subtract`` do, from readings and weights by slot. Returns J.

    h(x) is never in memory as a whole. ``meter`` (n, 10): the meter of each slot, -1 without one. Powers into branches
    are added up in ``above``, see ``eliminate``; ``h`` (10,): memory.
    """
    J = 0.0
    for i in range(len(parent) - 1, -1, -1):
        here, p = place[i], parent[i]
        square = v[i].real ** 2 + v[i].imag ** 2
        own, at_parent = branch_powers(i, p, Y, v) if i > 0 else (0j, 0j)
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
                residual[m] = r
                if k != 2 and k != 3:
                    J += w[i, k] * r * r
                elif w[i, k] > 0.0:
                    J += r * r / w[i, k]
    return J


@compiled
def find_objective(parent, Y, z, w, v, va, has_currents, power):
    """J from readings and weights by slot, without a row for every meter; ``power`` (n, 4) is overwritten."""
    J = 0.0
    for i in range(len(parent)):
        square = v[i].real ** 2 + v[i].imag ** 2
        power[i, 0], power[i, 1] = Y[i, 7].real * square, Y[i, 7].imag * square
        if w[i, 0] > 0.0:
            J += w[i, 0] * wrap(z[i, 0] - va[i]) ** 2
        if w[i, 1] > 0.0:
            J += w[i, 1] * (z[i, 1] - math.sqrt(square)) ** 2
    for i in range(1, len(parent)):
        p = parent[i]
        own, at_parent = branch_powers(i, p, Y, v)
        power[i, 0] += own.real
        power[i, 1] += own.imag
        power[p, 0] += at_parent.real
        power[p, 1] += at_parent.imag
        J += w[i, 4] * (z[i, 4] - at_parent.real) ** 2 + w[i, 5] * (z[i, 5] - at_parent.imag) ** 2
        J += w[i, 7] * (z[i, 7] - own.real) ** 2 + w[i, 8] * (z[i, 8] - own.imag) ** 2
        if has_currents:
            J += w[i, 6] * (z[i, 6] - modulus(at_parent) / modulus(v[p])) ** 2
            J += w[i, 9] * (z[i, 9] - modulus(own) / modulus(v[i])) ** 2
    for i in range(len(parent)):
        for k in range(2):
            if w[i, 2 + k] > 0.0:
                J += (z[i, 2 + k] - power[i, k]) ** 2 / w[i, 2 + k]
    return J


@compiled
def move(v, va, step, length, largest_angle):
    """Turns and lengthens all voltages by ``length`` of their steps, whose angles are ``largest_angle`` at most."""
    small = length * largest_angle < SMALL_ANGLE
    for i in range(len(v)):
        d = length * step[i, 2]
        va[i] += d
        v[i] = turned(v[i], d, 1.0 + length * step[i, 3], small)


@compiled
def predict(parent, Y, v, va, has_currents, h):
    """Fills h(x) of every slot, shape (n, 10); of currents only with ``has_currents``."""
    predict_part(0, len(parent), parent, Y, v, va, has_currents, h)


@compiled
def predict_part(first, end, parent, Y, v, va, has_currents, h):
    """``predict`` of the buses from ``first`` to ``end`` - 1, without the flows out of a parent before ``first``."""
    for i in range(first, end):
        square = v[i].real ** 2 + v[i].imag ** 2
        h[i, 0], h[i, 1] = va[i], math.sqrt(square)
        h[i, 2], h[i, 3] = Y[i, 7].real * square, Y[i, 7].imag * square
    for i in range(max(first, 1), end):
        p = parent[i]
        own, at_parent = branch_powers(i, p, Y, v)
        h[i, 2] += own.real
        h[i, 3] += own.imag
        if p >= first:
            h[p, 2] += at_parent.real
            h[p, 3] += at_parent.imag
        h[i, 4], h[i, 5], h[i, 7], h[i, 8] = at_parent.real, at_parent.imag, own.real, own.imag
        if has_currents:
            h[i, 6], h[i, 9] = modulus(at_parent) / h[p, 1], modulus(own) / h[i, 1]


@compiled
def branch_powers(i, p, Y, v):
    """Power into the branch above bus ``i``, at its own end and at its parent's ``p``."""
    m = v[i] * v[p].conjugate()
    own = scaled(Y[i, 0], v[i].real ** 2 + v[i].imag ** 2) + Y[i, 1] * m
    return own, scaled(Y[i, 2], v[p].real ** 2 + v[p].imag ** 2) + Y[i, 3] * m.conjugate()
