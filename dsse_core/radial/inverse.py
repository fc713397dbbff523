"""Variances of the voltages and of all residuals from the factors of ``kernel``: the selected inverse."""

from __future__ import annotations

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.radial.block import modulus
from dsse_core.radial.iteration import branch_powers
from dsse_core.radial.kernel import coefficients_of, row_of_branch


@compiled
def find_variances(parent, Y, w, v, factor, more, block, angle_given):
    """diag of the covariance of (va, vm), (n, 2); diag(Omega) of all slots with a meter, (n, 10); blocks, (n, 4, 4).

    A block is the part of the inverse at the ``(lam, x)`` of a bus; ``block`` has the root's, from ``solve_root``. With
    D, U and X = D^-1 U of a bus and S the block at its parent, ``-X S`` is the block between the two buses, and
    ``D^-1 + X S X'`` that of ``(lam, f)``. Injections have ``Omega = -R^2 (K^-1)_lamlam``, other meters
    ``sigma^2 - h Cov h'``.
    """
    n = len(parent)
    state, omega = np.empty((n, 2)), np.zeros((n, 10))
    S, branch = np.empty((n, 4, 4)), np.empty((n, 5))
    for k in range(4):
        for c in range(4):
            S[0, k, c] = block[k, 4 + c]
    for k in range(3):
        if (k == 2 and angle_given) or (k < 2 and w[0, 2 + k] < 0.0):  # known; no meter, no multiplier
            for c in range(4):
                S[0, k, c] = S[0, c, k] = 0.0
    _descend(parent, w, factor, more, S, branch)
    for i in range(n):
        state[i, 0], state[i, 1] = S[i, 2, 2], (v[i].real ** 2 + v[i].imag ** 2) * S[i, 3, 3]
        for k in range(2):
            if w[i, k] > 0.0:
                omega[i, k] = 1.0 / w[i, k] - state[i, k]
            if w[i, 2 + k] > 0.0:
                omega[i, 2 + k] = -(w[i, 2 + k] ** 2) * S[i, k, k]
            if i > 0 and w[i, 4 + k] > 0.0:
                omega[i, 4 + k] = 1.0 / w[i, 4 + k] - branch[i, 2 * k]
    _of_other_rows(parent, Y, w, v, factor, more, S, branch, omega)
    return state, omega, S


@compiled
def find_last_angle(parent, w, factor, more, of_lam):
    """Variance of va of the last bus of a path; x of the first is given, and ``of_lam`` (2, 2) is its block of lam."""
    S, branch = np.zeros((len(parent), 4, 4)), np.empty((len(parent), 5))
    S[0, :2, :2] = of_lam
    _descend(parent, w, factor, more, S, branch)
    return S[-1, 2, 2]


@compiled
def find_variances_of_sums(parent, w, factor, more, S0, indptr, indices, data):
    """Variances of linear functions of the state, (n_sum,), by eliminating their right-hand sides as those of a step.

    ``indptr``, ``indices``, ``data``: sparse rows (n_sum, 3 n) of each function's derivatives by ``f`` (2) and
    dvm / vm of each bus. ``S0``: the block of the inverse at the root's ``(lam, x)``.
    """
    n, found = len(parent), np.zeros(len(indptr) - 1)
    above, of_f, reached = np.zeros((n, 4)), np.zeros((n, 2)), np.zeros(n, dtype=np.bool_)
    for k in range(len(found)):
        last = 0
        for e in range(indptr[k], indptr[k + 1]):
            i, which = indices[e] // 3, indices[e] % 3
            if which == 2:
                above[i, 3] += data[e]
            else:
                of_f[i, which] += data[e]
            reached[i], last = True, max(i, last)
        for i in range(last, 0, -1):
            if reached[i]:
                found[k] += _eliminate_sum(i, parent[i], w, factor, more, above, of_f)
                reached[i], reached[parent[i]] = False, True
        for r in range(4):
            for c in range(4):
                found[k] += above[0, r] * S0[r, c] * above[0, c]
        above[0], reached[0] = 0.0, False
    return found


@compiled
def _eliminate_sum(i, p, w, factor, more, above, of_f):
    """b' D^-1 b of the right-hand side b of a bus; passes b on to the parent ``p`` and sets it to 0."""
    X0, X1, X2, X3 = _row(factor, i, 0), _row(factor, i, 1), _row(factor, i, 2), _row(factor, i, 3)
    t0, t1, qr, qi = factor[i, 20], factor[i, 21], factor[i, 22], factor[i, 23]
    l0 = above[i, 0] if w[i, 2] >= 0.0 else 0.0  # no meter, no multiplier
    l1 = above[i, 1] if w[i, 3] >= 0.0 else 0.0
    s0, s1 = above[i, 2], above[i, 3]
    f0, f1 = of_f[i, 0] - qi * s0 + qr * s1, of_f[i, 1] - qr * s0 - qi * s1
    y0 = more[i, 6] * l0 + more[i, 7] * l1 + X0[0] * f0 + X0[1] * f1
    y1 = more[i, 7] * l0 + more[i, 8] * l1 + X1[0] * f0 + X1[1] * f1
    y2 = X0[0] * l0 + X1[0] * l1 + X2[0] * f0 + X2[1] * f1
    y3 = X0[1] * l0 + X1[1] * l1 + X3[0] * f0 + X3[1] * f1
    above[p, 0] -= y2
    above[p, 1] -= y3
    above[p, 2] += s0 - (X0[2] * l0 + X1[2] * l1 + X2[2] * f0 + X3[2] * f1)
    above[p, 3] += t0 * s0 + t1 * s1 - (X0[3] * l0 + X1[3] * l1 + X2[3] * f0 + X3[3] * f1)
    for c in range(4):
        above[i, c] = 0.0
    of_f[i, 0] = of_f[i, 1] = 0.0
    return l0 * y0 + l1 * y1 + f0 * y2 + f1 * y3


@compiled
def _descend(parent, w, factor, more, S, branch):
    """Fills the blocks ``S`` from the root downwards, and ``branch`` (n, 5).

    ``branch`` has the block of f (3), and minus the block of f and dvm_p / vm_p (2).

    The code has single numbers in place of loops over small arrays, which memory traffic would slow down.
    """
    for i in range(1, len(parent)):
        s = _upper(S, parent[i])
        X0, X1, X2, X3 = _row(factor, i, 0), _row(factor, i, 1), _row(factor, i, 2), _row(factor, i, 3)
        A0, A1, A2, A3 = _times(X0, s), _times(X1, s), _times(X2, s), _times(X3, s)  # X S
        t0, t1, qr, qi = factor[i, 20], factor[i, 21], factor[i, 22], factor[i, 23]
        # of (lam, f)
        B02, B03, B12, B13 = _dot(A0, X2) + X0[0], _dot(A0, X3) + X0[1], _dot(A1, X2) + X1[0], _dot(A1, X3) + X1[1]
        B22, B23, B33 = _dot(A2, X2) + X2[0], _dot(A2, X3) + X2[1], _dot(A3, X3) + X3[1]
        # lam with x = T x_p + Z f
        S[i, 0, 0], S[i, 1, 1] = _dot(A0, X0) + more[i, 6], _dot(A1, X1) + more[i, 8]
        S[i, 0, 1] = _dot(A0, X1) + more[i, 7]
        S[i, 0, 2], S[i, 0, 3] = -A0[2] - t0 * A0[3] - qi * B02 - qr * B03, -t1 * A0[3] + qr * B02 - qi * B03
        S[i, 1, 2], S[i, 1, 3] = -A1[2] - t0 * A1[3] - qi * B12 - qr * B13, -t1 * A1[3] + qr * B12 - qi * B13
        # x_p and f with x
        p00, p10 = s[7] + t0 * s[8] + qi * A2[2] + qr * A3[2], s[8] + t0 * s[9] + qi * A2[3] + qr * A3[3]
        p11 = t1 * s[9] - qr * A2[3] + qi * A3[3]
        f00, f10 = -A2[2] - t0 * A2[3] - qi * B22 - qr * B23, -A3[2] - t0 * A3[3] - qi * B23 - qr * B33
        f01, f11 = -t1 * A2[3] + qr * B22 - qi * B23, -t1 * A3[3] + qr * B23 - qi * B33
        S[i, 2, 2], S[i, 3, 3] = p00 + t0 * p10 - qi * f00 - qr * f10, t1 * p11 + qr * f01 - qi * f11
        S[i, 2, 3] = t1 * p10 + qr * f00 - qi * f10
        for k in range(2):
            if w[i, 2 + k] < 0.0:  # no meter, no multiplier
                S[i, 0, 1] = S[i, k, k] = S[i, k, 2] = S[i, k, 3] = 0.0
        S[i, 1, 0], S[i, 2, 0], S[i, 3, 0] = S[i, 0, 1], S[i, 0, 2], S[i, 0, 3]
        S[i, 2, 1], S[i, 3, 1], S[i, 3, 2] = S[i, 1, 2], S[i, 1, 3], S[i, 2, 3]
        branch[i, 0], branch[i, 1], branch[i, 2], branch[i, 3], branch[i, 4] = B22, B23, B33, A2[3], A3[3]


@compiled
def _of_other_rows(parent, Y, w, v, factor, more, S, branch, omega):
    """Omega of the flows at the child's end of each branch and of the currents."""
    for i in range(1, len(parent)):
        if w[i, 6] + w[i, 7] + w[i, 8] + w[i, 9] > 0.0:
            p = parent[i]
            own, at_parent = branch_powers(i, p, Y, v)
            vm, p2 = modulus(v[i]), v[p].real ** 2 + v[p].imag ** 2
            for k in range(6, 10):
                if w[i, k] > 0.0:
                    k0, k1, kx, _ = row_of_branch(k, own, at_parent, vm, p2, coefficients_of(i, factor, more))
                    variance = k0 * k0 * branch[i, 0] + 2 * k0 * k1 * branch[i, 1] + k1 * k1 * branch[i, 2]
                    variance += kx * kx * S[p, 3, 3] - 2 * kx * (k0 * branch[i, 3] + k1 * branch[i, 4])
                    omega[i, k] = 1.0 / w[i, k] - variance


@compiled
def _upper(S, p):
    at_lam = S[p, 0, 0], S[p, 0, 1], S[p, 0, 2], S[p, 0, 3], S[p, 1, 1], S[p, 1, 2], S[p, 1, 3]
    return *at_lam, S[p, 2, 2], S[p, 2, 3], S[p, 3, 3]


@compiled
def _row(factor, i, r):
    return factor[i, 4 * r], factor[i, 4 * r + 1], factor[i, 4 * r + 2], factor[i, 4 * r + 3]


@compiled
def _times(a, s):
    """Row ``a`` times the symmetric matrix with the upper triangle ``s``."""
    return (
        a[0] * s[0] + a[1] * s[1] + a[2] * s[2] + a[3] * s[3],
        a[0] * s[1] + a[1] * s[4] + a[2] * s[5] + a[3] * s[6],
        a[0] * s[2] + a[1] * s[5] + a[2] * s[7] + a[3] * s[8],
        a[0] * s[3] + a[1] * s[6] + a[2] * s[8] + a[3] * s[9],
    )


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
