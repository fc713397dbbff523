"""One Gauss-Newton step on a tree by elimination from the leaves to the root, compiled with numba.

The unknowns of a bus are the multipliers ``lam`` of its P and Q injection and the change ``f`` of the power that leaves
its parent towards it; the change of its voltage ``x = (dva, dvm / vm)`` follows from its parent's:

``x = T x_p + Z f``, ``T = [[1, t0], [0, t1]]``, ``Z = [[-qi, -qr], [qr, -qi]]``, ``q = 1 / (conj(y_pc) v_p conj(v))``.

In these unknowns no information is a difference of large numbers, however short the branch: a flow meter at the
parent's end sees ``f`` alone, one at the other end ``alpha f + beta dvm_p / vm_p`` with ``beta`` of the size of losses.
With the multipliers an injection may be exact (variance 0) and touches its bus and the branches there only:

``[-R  H_i] [lam]   [r_i      ]``
``[H_i' G ] [dx ] = [H_g' W r_g]``.

Eliminating ``(lam, f)`` of a bus, a 4 x 4 block D solved with pivoting, leaves a 4 x 4 message about
``(lam_p, x_p)``. On the same factors the blocks of the inverse that the tree needs follow from the root downwards.

Three passes do all work, of the centre, of an area with its neighbours' messages (``boundary``) and of many scans side
by side: ``eliminate``, ``root.solve_root``, ``descend``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.grid.quantities import CURRENT_FLOOR
from dsse_core.radial.block import N_INVERSE, cut_round_off, modulus, scaled, solve_blocks, square_of, wrap
from dsse_core.radial.root import N_KNOWN

SMALL_ANGLE = 0.1  # rad; below it four terms give sine and cosine to the last digit
# Determinant over product of the diagonal from which on 2 x 2 blocks need no pivoting; it is never above 1.
SURELY_DEFINITE, ALWAYS_PIVOTING = 1e-4, 2.0
N_FACTOR = 24  # of a bus: X (16), y (4), t (2), q (2)
N_MORE = 9  # alpha (4) and beta (2) for row_of_branch, where there is such a row; (D^-1)_lamlam (3)

# Modes. STEP: a step. INVERT: also (D^-1)_lamlam. CHECK: only the least pivot ratio, which tells if every block can be
# solved. UPWARD: as INVERT, and always with pivoting, so that no information seems to be there about unmetered
# quantities.
STEP, INVERT, CHECK, UPWARD = 0, 1, 2, 3


class Work(NamedTuple):
    """Memory of a pass; see ``eliminate``, ``above`` being 0 between passes."""

    place: np.ndarray
    above: np.ndarray
    factor: np.ndarray
    more: np.ndarray
    block: np.ndarray
    step: np.ndarray

    @classmethod
    def of(cls, n: int) -> Work:
        factor, more = np.empty((n, N_FACTOR)), np.empty((n, N_MORE))
        return cls(np.arange(n), np.zeros((n, N_KNOWN)), factor, more, np.empty((4, N_INVERSE)), np.empty((n, 4)))


def absent(n: int) -> np.ndarray:
    """Weights (n, 10) without any meter: weight 0, or for an injection, of which the variance counts, -1."""
    weights = np.zeros((n, 10))
    weights[:, 2:4] = -1.0
    return weights


@compiled
def eliminate(first, end, parent, Y, z, w, v, va, currents, mode, place, above, factor, more, block, least_of_flow):
    """Eliminates the buses from ``end`` - 1 down to ``first`` > 0, whose subtrees are complete.

    Returns the least pivot ratio, its bus (CHECK), and J of the meters in use there, at ``v`` and ``va``. ``above``
    (:, 16) may hold other information about ``(lam, x)`` of any bus, in its row ``place``, (n,). Without such
    information buses of one level may share one row, as a subtree is numbered in one piece. The information about the
    parents above ``first`` is left there, such as that about the root, for ``solve_root``. ``factor`` (n, 24) and
    ``more`` (n, 9) are filled for later passes. ``least_of_flow``: information that is added about each branch's power.
    """
    check, upward = mode == CHECK, mode == UPWARD
    invert, surely = mode == INVERT or upward, ALWAYS_PIVOTING if check or upward else SURELY_DEFINITE
    width = N_INVERSE if invert else 9
    least, at, J = 1.0, 0, 0.0
    for i in range(end - 1, first - 1, -1):
        own_place = place[i]
        u2 = v[i].real ** 2 + v[i].imag ** 2
        ysh = scaled(Y[i, 7], u2)
        has_p, has_q = w[i, 2] >= 0.0, w[i, 3] >= 0.0
        # the branch to the parent
        p = parent[i]
        parent_place = place[p]
        p2 = v[p].real ** 2 + v[p].imag ** 2
        m = v[i] * v[p].conjugate()
        ycc = scaled(Y[i, 0], u2)
        own = ycc + Y[i, 1] * m
        at_parent = scaled(Y[i, 2], p2) + Y[i, 3] * m.conjugate()
        over = 1.0 / (u2 * p2)
        q = scaled(Y[i, 5] * m, over)
        kappa = scaled(Y[i, 4] * m, p2 * over)
        qr, qi = q.real, q.imag
        t0, t1 = 2.0 * kappa.imag, -(1.0 + 2.0 * kappa.real)
        gamma = Y[i, 6]
        a00, a10 = gamma.real + 2.0 * qr * ycc.real, gamma.imag + 2.0 * qr * ycc.imag
        a01, a11 = gamma.imag - 2.0 * qi * ycc.real, -gamma.real - 2.0 * qi * ycc.imag
        beta = Y[i, 1] * Y[i, 4].conjugate()
        b0, b1 = 2.0 * (ycc.real * t1 - beta.real * p2), 2.0 * (ycc.imag * t1 - beta.imag * p2)
        factor[i, 20], factor[i, 21], factor[i, 22], factor[i, 23] = t0, t1, qr, qi
        if w[i, 7] > 0.0 or w[i, 8] > 0.0 or w[i, 9] > 0.0:
            more[i, 0], more[i, 1], more[i, 2], more[i, 3] = a00, a01, a10, a11
            more[i, 4], more[i, 5] = b0, b1
        # the rows of lam: injections
        L00, L01, L11 = above[own_place, 0] - w[i, 2], above[own_place, 1], above[own_place, 2] - w[i, 3]
        X00, X01 = above[own_place, 3], above[own_place, 4] + 2.0 * ysh.real
        X10, X11 = above[own_place, 5], above[own_place, 6] + 2.0 * ysh.imag
        misfit_p = z[i, 2] - (ysh.real + own.real + above[own_place, 14])
        misfit_q = z[i, 3] - (ysh.imag + own.imag + above[own_place, 15])
        r0, r1 = above[own_place, 10] + misfit_p, above[own_place, 11] + misfit_q
        c0, c1 = 1.0, 1.0
        if not has_p:
            L00, L01, X00, X01, r0, c0 = -1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        elif w[i, 2] > 0.0:
            J += misfit_p * misfit_p / w[i, 2]
        if not has_q:
            L11, L01, X10, X11, r1, c1 = -1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        elif w[i, 3] > 0.0:
            J += misfit_q * misfit_q / w[i, 3]
        # information about x
        N00, N01, N11 = above[own_place, 7], above[own_place, 8], above[own_place, 9]
        s0, s1 = above[own_place, 12], above[own_place, 13]
        if check:
            N00, N01, N11 = cut_round_off(N00), cut_round_off(N01), cut_round_off(N11)
        vm = math.sqrt(u2)
        if w[i, 0] > 0.0:
            N00 += w[i, 0]
            r = wrap(z[i, 0] - va[i])
            s0 += w[i, 0] * r
            J += w[i, 0] * r * r
        if w[i, 1] > 0.0:
            N11 += w[i, 1] * u2
            r = z[i, 1] - vm
            s1 += w[i, 1] * vm * r
            J += w[i, 1] * r * r
        for k in range(16):
            above[own_place, k] = 0.0
        # x = T x_p + Z f
        Z00, Z01 = N01 * qr - N00 * qi, -N00 * qr - N01 * qi
        Z10, Z11 = N11 * qr - N01 * qi, -N01 * qr - N11 * qi
        G00, G01, G11 = qr * Z10 - qi * Z00, qr * Z11 - qi * Z01, -qr * Z01 - qi * Z11
        G00, G11 = G00 + least_of_flow, G11 + least_of_flow
        F00, F01 = Z00, t0 * Z00 + t1 * Z10
        F10, F11 = Z01, t0 * Z01 + t1 * Z11
        g0, g1 = qr * s1 - qi * s0, -qr * s0 - qi * s1
        h01 = N00 * t0 + N01 * t1
        P00, P01, P11 = N00, h01, t0 * h01 + t1 * (N01 * t0 + N11 * t1)
        s1 = t0 * s0 + t1 * s1
        # flows
        if w[i, 4] > 0.0:
            G00 += w[i, 4]
            r = z[i, 4] - at_parent.real
            g0 += w[i, 4] * r
            J += w[i, 4] * r * r
        if w[i, 5] > 0.0:
            G11 += w[i, 5]
            r = z[i, 5] - at_parent.imag
            g1 += w[i, 5] * r
            J += w[i, 5] * r * r
        for k in range(6, 10):
            if w[i, k] > 0.0 and (currents or (k != 6 and k != 9)):
                k0, k1, kx, h = row_of_branch(k, own, at_parent, vm, p2, (a00, a01, a10, a11, b0, b1, t1, qr, qi))
                r = z[i, k] - h
                G00 += w[i, k] * k0 * k0
                G01 += w[i, k] * k0 * k1
                G11 += w[i, k] * k1 * k1
                F01 += w[i, k] * k0 * kx
                F11 += w[i, k] * k1 * kx
                P11 += w[i, k] * kx * kx
                g0 += w[i, k] * k0 * r
                g1 += w[i, k] * k1 * r
                s1 += w[i, k] * kx * r
                J += w[i, k] * r * r
        E00, E01 = X00, X00 * t0 + X01 * t1 + c0 * b0
        E10, E11 = X10, X10 * t0 + X11 * t1 + c1 * b1
        C00, C01 = X01 * qr - X00 * qi + c0 * a00, -X00 * qr - X01 * qi + c0 * a01
        C10, C11 = X11 * qr - X10 * qi + c1 * a10, -X10 * qr - X11 * qi + c1 * a11
        det = L00 * L11 - L01 * L01
        definite = L00 < 0.0 and L11 < 0.0 and det > surely * L00 * L11
        if definite:
            # lam first, then f: 2 x 2 blocks, and only sums of positive terms
            over = 1.0 / det
            M00, M01, M11 = -L11 * over, L01 * over, -L00 * over
            Q00, Q01 = M00 * C00 + M01 * C10, M00 * C01 + M01 * C11
            Q10, Q11 = M01 * C00 + M11 * C10, M01 * C01 + M11 * C11
            H00, H01 = G00 + C00 * Q00 + C10 * Q10, G01 + C00 * Q01 + C10 * Q11
            H11 = G11 + C01 * Q01 + C11 * Q11
            det = H00 * H11 - H01 * H01
            definite = det > surely * H00 * H11
        if definite:
            over = 1.0 / det
            V00, V01, V11 = H11 * over, -H01 * over, H00 * over
            k0, k1 = F00 + Q00 * E00 + Q10 * E10, F10 + Q01 * E00 + Q11 * E10
            A00, A10 = V00 * k0 + V01 * k1, V01 * k0 + V11 * k1
            k0, k1 = F01 + Q00 * E01 + Q10 * E11, F11 + Q01 * E01 + Q11 * E11
            A01, A11 = V00 * k0 + V01 * k1, V01 * k0 + V11 * k1
            k0, k1 = g0 + Q00 * r0 + Q10 * r1, g1 + Q01 * r0 + Q11 * r1
            A02, A12 = V00 * k0 + V01 * k1, V01 * k0 + V11 * k1
            U00, U01 = Q00 * V00 + Q01 * V01, Q00 * V01 + Q01 * V11
            U10, U11 = Q10 * V00 + Q11 * V01, Q10 * V01 + Q11 * V11
            factor[i, 0], factor[i, 1], factor[i, 4], factor[i, 5] = U00, U01, U10, U11
            if invert:
                more[i, 6], more[i, 7] = U00 * Q00 + U01 * Q01 - M00, U00 * Q10 + U01 * Q11 - M01
                more[i, 8] = U10 * Q10 + U11 * Q11 - M11
            B00, B01 = Q00 * A00 + Q01 * A10 - M00 * E00 - M01 * E10, Q00 * A01 + Q01 * A11 - M00 * E01 - M01 * E11
            B10, B11 = Q10 * A00 + Q11 * A10 - M01 * E00 - M11 * E10, Q10 * A01 + Q11 * A11 - M01 * E01 - M11 * E11
            B02, B12 = Q00 * A02 + Q01 * A12 - M00 * r0 - M01 * r1, Q10 * A02 + Q11 * A12 - M01 * r0 - M11 * r1
        else:
            block[0, 0], block[0, 1], block[0, 2], block[0, 3] = L00, L01, C00, C01
            block[1, 0], block[1, 1], block[1, 2], block[1, 3] = L01, L11, C10, C11
            block[2, 0], block[2, 1], block[2, 2], block[2, 3] = C00, C10, G00, G01
            block[3, 0], block[3, 1], block[3, 2], block[3, 3] = C01, C11, G01, G11
            block[0, 4], block[0, 5], block[0, 6], block[0, 7], block[0, 8] = 0.0, 0.0, E00, E01, r0
            block[1, 4], block[1, 5], block[1, 6], block[1, 7], block[1, 8] = 0.0, 0.0, E10, E11, r1
            block[2, 4], block[2, 5], block[2, 6], block[2, 7], block[2, 8] = 1.0, 0.0, F00, F01, g0
            block[3, 4], block[3, 5], block[3, 6], block[3, 7], block[3, 8] = 0.0, 1.0, F10, F11, g1
            if invert:
                block[0, 9], block[1, 9], block[2, 9], block[3, 9] = 1.0, 0.0, 0.0, 0.0
                block[0, 10], block[1, 10], block[2, 10], block[3, 10] = 0.0, 1.0, 0.0, 0.0
            ratio = solve_blocks(block, width, check)
            if check and not ratio >= least:
                least, at = ratio, i
            if invert:
                more[i, 6], more[i, 7], more[i, 8] = block[0, 9], block[0, 10], block[1, 10]
            factor[i, 0], factor[i, 1], factor[i, 4], factor[i, 5] = block[0, 4], block[0, 5], block[1, 4], block[1, 5]
            B00, B01, B02, B10, B11, B12 = block[0, 6], block[0, 7], block[0, 8], block[1, 6], block[1, 7], block[1, 8]
            V00, V01, V11 = block[2, 4], block[2, 5], block[3, 5]
            A00, A01, A02, A10, A11, A12 = block[2, 6], block[2, 7], block[2, 8], block[3, 6], block[3, 7], block[3, 8]
        factor[i, 2], factor[i, 3], factor[i, 6], factor[i, 7] = B00, B01, B10, B11
        factor[i, 8], factor[i, 9], factor[i, 10], factor[i, 11] = V00, V01, A00, A01
        factor[i, 12], factor[i, 13], factor[i, 14], factor[i, 15] = V01, V11, A10, A11
        factor[i, 16], factor[i, 17], factor[i, 18], factor[i, 19] = B02, B12, A02, A12
        # the message
        above[parent_place, 0] -= V00
        above[parent_place, 1] -= V01
        above[parent_place, 2] -= V11
        above[parent_place, 3] -= A00
        above[parent_place, 4] -= A01
        above[parent_place, 5] -= A10
        above[parent_place, 6] -= A11
        above[parent_place, 7] += P00 - (E00 * B00 + E10 * B10 + F00 * A00 + F10 * A10)
        above[parent_place, 8] += P01 - (E00 * B01 + E10 * B11 + F00 * A01 + F10 * A11)
        above[parent_place, 9] += P11 - (E01 * B01 + E11 * B11 + F01 * A01 + F11 * A11)
        above[parent_place, 10] -= A02
        above[parent_place, 11] -= A12
        above[parent_place, 12] += s0 - (E00 * B02 + E10 * B12 + F00 * A02 + F10 * A12)
        above[parent_place, 13] += s1 - (E01 * B02 + E11 * B12 + F01 * A02 + F11 * A12)
        above[parent_place, 14] += at_parent.real
        above[parent_place, 15] += at_parent.imag
    return least, at, J


@compiled
def row_of_branch(k, own, at_parent, vm, p2, coefficients):
    """A flow at the child's end or a current, slots 6 to 9: derivatives by f (2) and dvm_p / vm_p, and h."""
    if k == 6:
        s, vp = modulus(at_parent), math.sqrt(p2)
        if s <= CURRENT_FLOOR * vp:
            return 0.0, 0.0, 0.0, s / vp
        return at_parent.real / (s * vp), at_parent.imag / (s * vp), -s / vp, s / vp
    a00, a01, a10, a11, b0, b1, t1, qr, qi = coefficients
    if k == 7:
        return a00, a01, b0, own.real
    if k == 8:
        return a10, a11, b1, own.imag
    s = modulus(own)
    magnitude = s / vm
    if magnitude <= CURRENT_FLOOR:
        return 0.0, 0.0, 0.0, magnitude
    e0, e1 = own.real / (s * vm), own.imag / (s * vm)
    k0, k1 = e0 * a00 + e1 * a10 - magnitude * qr, e0 * a01 + e1 * a11 + magnitude * qi
    return k0, k1, e0 * b0 + e1 * b1 - magnitude * t1, magnitude


@compiled
def coefficients_of(i, factor, more):
    """Coefficients for ``row_of_branch`` of a bus that ``eliminate`` has passed."""
    alpha_and_beta = more[i, 0], more[i, 1], more[i, 2], more[i, 3], more[i, 4], more[i, 5]
    return *alpha_and_beta, factor[i, 21], factor[i, 22], factor[i, 23]


@compiled
def descend(first, end, parent, place, factor, v, va, step, length, v_to, va_to):
    """Substitution from ``first`` to ``end`` - 1, parents first, and the state ``v_to``, ``va_to`` that it leads to.

    Fills the rows ``place`` of ``step``: lam (2) and x of each bus; those of the parents above ``first``, or of the
    root, are given. Rows by level stay in the processor's cache, where rows of all buses would take longer than the
    computation. The state is that by ``length`` of the step from ``v`` and ``va``, which may be overwritten; it counts
    where no angle turns by SMALL_ANGLE, see ``stretch``. Returns max |dva|, max |dvm|, and True where all are finite.
    """
    at = place[parent[first]]
    d0, d1 = step[at, 2], step[at, 3]
    dva, largest, total = abs(d0), square_of(v[parent[first]]) * d1 * d1, d0 + d1
    if first == 0:
        va_to[0], v_to[0] = va[0] + length * d0, turned(v[0], length * d0, 1.0 + length * d1)
    for i in range(max(first, 1), end):
        here, p = place[i], place[parent[i]]
        l0, l1, x0, x1 = step[p, 0], step[p, 1], step[p, 2], step[p, 3]
        f0 = factor[i, 18] - (factor[i, 8] * l0 + factor[i, 9] * l1 + factor[i, 10] * x0 + factor[i, 11] * x1)
        f1 = factor[i, 19] - (factor[i, 12] * l0 + factor[i, 13] * l1 + factor[i, 14] * x0 + factor[i, 15] * x1)
        m0 = factor[i, 16] - (factor[i, 0] * l0 + factor[i, 1] * l1 + factor[i, 2] * x0 + factor[i, 3] * x1)
        m1 = factor[i, 17] - (factor[i, 4] * l0 + factor[i, 5] * l1 + factor[i, 6] * x0 + factor[i, 7] * x1)
        d0 = x0 + factor[i, 20] * x1 - factor[i, 23] * f0 - factor[i, 22] * f1
        d1 = factor[i, 21] * x1 + factor[i, 22] * f0 - factor[i, 23] * f1
        step[here, 0], step[here, 1], step[here, 2], step[here, 3] = m0, m1, d0, d1
        dva = max(dva, abs(d0))
        largest = max(largest, square_of(v[i]) * d1 * d1)
        total += d0 + d1
        va_to[i] = va[i] + length * d0
        v_to[i] = turned(v[i], length * d0, 1.0 + length * d1)
    return dva, math.sqrt(largest), math.isfinite(total)


@compiled
def turned(v, angle, growth):
    """``v`` turned by ``angle``, which is below SMALL_ANGLE, and lengthened."""
    square = angle * angle
    c = 1.0 + square * (-1 / 2 + square * (1 / 24 - square * (1 / 720 - square * (1 / 40320))))
    s = angle + angle * square * (-1 / 6 + square * (1 / 120 - square * (1 / 5040 - square * (1 / 362880))))
    return scaled(v * complex(c, s), growth)


@compiled
def count_halves(angle):
    """The power of 2 by which ``angle`` is divided to be below SMALL_ANGLE."""
    halves = 1.0
    while angle >= halves * SMALL_ANGLE:
        halves *= 2.0
    return halves


@compiled
def stretch(v, va, v_to, va_to, times):
    """Moves ``v_to``, ``va_to``, to which a step has led from ``v`` and ``va``, to where ``times`` that step leads."""
    for i in range(len(v)):
        angle = times * (va_to[i] - va[i])
        growth = 1.0 + times * (modulus(v_to[i]) / modulus(v[i]) - 1.0)
        va_to[i], v_to[i] = va[i] + angle, scaled(v[i] * complex(math.cos(angle), math.sin(angle)), growth)
