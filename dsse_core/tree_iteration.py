"""Gauss-Newton on a tree, compiled: the iteration of ``estimate_state`` with the steps of ``tree_kernel``."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.gauss_newton import FLOWS_KNOWN, FULL_STEPS, LARGEST_STEP, MAX_DVA, MAX_DVM
from dsse_core.measurement_model import CURRENT_FLOOR
from dsse_core.tree_block import N_INVERSE, compiled, modulus, scaled, wrap
from dsse_core.tree_kernel import N_FACTOR, N_MORE, SMALL_ANGLE, STEP, eliminate, substitute

CONVERGED, TOO_MANY, LEFT, UNUSABLE = 0, 1, 2, 3


@compiled
def estimate(
    parent, Y, order, slot, exact, start, start_va, flows_known, has_currents,
    tolerance, max_iterations, gradient, values, sigmas, state, residual,
):  # fmt: skip
    """The whole estimate in one call: for small networks, calls and arrays made in Python take longer than solving.

    Fills ``state`` (2, n_bus), vm and va in network order, and ``residual`` (n_meas,), makes ``sigmas`` 0 where a
    reading is ``exact``, and returns how it ended, iterations, last step and J. UNUSABLE: readings that cannot be.

    The end: max |dx| < ``tolerance``, and the step, taken in full, lowers J by less than ``gradient``, which is the
    square of the norm of the gradient of J in the metric of the state's covariance, by which scale and units drop out.
    """
    if not _are_usable(exact, values, sigmas):
        return UNUSABLE, 0, np.inf, np.inf
    n = len(parent)
    z, w, v, va = np.zeros((n, 10)), np.zeros((n, 10)), start.copy(), start_va.copy()
    w[:, 2:4] = -1.0  # see ``absent``
    store(slot, values, sigmas, z, w)
    above, factor, more = np.zeros((n, 16)), np.empty((n, N_FACTOR)), np.empty((n, N_MORE))
    block, step = np.empty((4, N_INVERSE)), np.empty((n, 4))
    end, iteration, largest, gain = TOO_MANY, 0, np.inf, np.inf
    while end == TOO_MANY and iteration < max_iterations:
        iteration += 1
        eliminate(parent, Y, z, w, v, va, flows_known, STEP, above, factor, more, block, step)
        substitute(parent, factor, step)
        dva, dvm, finite = _largest(v, step)
        largest = max(dva, dvm) if finite else np.inf
        if not largest <= LARGEST_STEP:
            end = LEFT
            break
        small = largest < tolerance and dva <= MAX_DVA and dvm <= MAX_DVM
        if small:
            gain = expected_gain(parent, Y, w, v, flows_known, step)
        halved = iteration > FULL_STEPS and not small
        _move(v, va, step, 1.0 / max(max(2.0 if halved else 1.0, dva / MAX_DVA), dvm / MAX_DVM), dva)
        if small and gain <= gradient and (flows_known or not has_currents):
            end = CONVERGED
        flows_known = flows_known or largest < FLOWS_KNOWN
    predict(parent, Y, v, va, has_currents, z)
    for i in range(n):
        state[0, order[i]], state[1, order[i]] = modulus(v[i]), va[i]
    return end, iteration, largest, _subtract(slot, values, sigmas, z, residual)


@compiled
def _are_usable(exact, values, sigmas):
    """Whether readings can be; makes sigma 0 where they hold exactly."""
    usable = True
    for k in range(len(values)):
        if exact[k]:
            sigmas[k] = 0.0
            usable = usable and values[k] == 0.0
        else:
            usable = usable and abs(values[k]) < np.inf and 0.0 < sigmas[k] < np.inf
    return usable


@compiled
def _place(slot):
    """Bus and column; without a sign, which costs as much as the rest of a loop over the meters."""
    unsigned = np.uint64(slot)
    return unsigned // np.uint64(10), unsigned % np.uint64(10)


@compiled
def store(slot, values, sigmas, z, w):
    """Readings into ``z`` and weights into ``w``, both (n, 10): 1 / sigma^2, of injections sigma^2."""
    for k in range(len(slot)):
        i, column = _place(slot[k])
        z[i, column] = values[k]
        variance = sigmas[k] * sigmas[k]
        w[i, column] = variance if column == 2 or column == 3 else 1.0 / variance


@compiled
def _subtract(slot, values, sigmas, h, residual):
    """z - h(x) of every meter into ``residual``, differences of angles wrapped to (-pi, pi]. Returns J."""
    J = 0.0
    for k in range(len(slot)):
        i, column = _place(slot[k])
        r = values[k] - h[i, column]
        residual[k] = wrap(r) if column == 0 else r
        if sigmas[k] > 0.0:
            J += (residual[k] / sigmas[k]) ** 2
    return J


@compiled
def _largest(v, step):
    """max |dva|, max |dvm|, and whether all are finite."""
    dva, dvm, total = 0.0, 0.0, 0.0
    for i in range(len(v)):
        dva = max(dva, abs(step[i, 2]))
        dvm = max(dvm, (v[i].real ** 2 + v[i].imag ** 2) * step[i, 3] ** 2)
        total += step[i, 2] + step[i, 3]
    return dva, math.sqrt(dvm), math.isfinite(total)


@compiled
def _move(v, va, step, length, largest_angle):
    """Turn and lengthen all voltages. No branch inside the loop: else sines are computed although nobody needs them."""
    small = length * largest_angle < SMALL_ANGLE
    for i in range(len(v)):
        d, growth = length * step[i, 2], 1.0 + length * step[i, 3]
        va[i] += d
        if small:
            d2 = d * d
            c = 1.0 + d2 * (-1 / 2 + d2 * (1 / 24 - d2 * (1 / 720)))
            s = d + d * d2 * (-1 / 6 + d2 * (1 / 120 - d2 * (1 / 5040)))
        else:
            c, s = math.cos(d), math.sin(d)
        v[i] = scaled(v[i] * complex(c, s), growth)


@compiled
def predict(parent, Y, v, va, has_currents, h):
    """h(x) of every slot, shape (n, 10); of currents only if there are any."""
    for i in range(len(parent)):
        square = v[i].real ** 2 + v[i].imag ** 2
        h[i, 0], h[i, 1] = va[i], math.sqrt(square)
        h[i, 2], h[i, 3] = Y[i, 7].real * square, Y[i, 7].imag * square
    for i in range(1, len(parent)):
        p = parent[i]
        own, at_parent = branch_powers(i, p, Y, v)
        h[i, 2] += own.real
        h[i, 3] += own.imag
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


@compiled
def expected_gain(parent, Y, w, v, currents, step):
    """By how much the linear model expects the whole step to lower J: the sum of (H dx)^2 / sigma^2."""
    n = len(parent)
    gain = 0.0
    injected = np.zeros(n, dtype=np.complex128)
    for i in range(n - 1, -1, -1):
        square = v[i].real ** 2 + v[i].imag ** 2
        x = complex(step[i, 3], step[i, 2])
        gain += w[i, 0] * x.imag**2 + w[i, 1] * square * x.real**2
        d = injected[i] + scaled(Y[i, 7], 2.0 * square * x.real)
        if i > 0:
            p = parent[i]
            xp = complex(step[p, 3], step[p, 2])
            own, at_parent = branch_powers(i, p, Y, v)
            ycc, ypp = scaled(Y[i, 0], square), scaled(Y[i, 2], v[p].real ** 2 + v[p].imag ** 2)
            at_own_end = scaled(ycc, 2.0 * x.real) + (own - ycc) * (x + xp.conjugate())
            at_its_end = scaled(ypp, 2.0 * xp.real) + (at_parent - ypp) * (xp + x.conjugate())
            injected[p] += at_its_end
            d += at_own_end
            gain += w[i, 4] * at_its_end.real**2 + w[i, 5] * at_its_end.imag**2
            gain += w[i, 7] * at_own_end.real**2 + w[i, 8] * at_own_end.imag**2
            if currents and w[i, 6] > 0.0:
                gain += w[i, 6] * _current_change(at_parent, at_its_end, xp.real, modulus(v[p])) ** 2
            if currents and w[i, 9] > 0.0:
                gain += w[i, 9] * _current_change(own, at_own_end, x.real, modulus(v[i])) ** 2
        if w[i, 2] > 0.0:
            gain += d.real**2 / w[i, 2]
        if w[i, 3] > 0.0:
            gain += d.imag**2 / w[i, 3]
    return gain


@compiled
def _current_change(s, ds, dln, vm):
    """d|i| of ``|i| = |s| / vm``."""
    size = modulus(s)
    if size <= CURRENT_FLOOR * vm:
        return 0.0
    return (s.conjugate() * ds).real / (size * vm) - size / vm * dln
