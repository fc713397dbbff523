"""Variances of the voltages and of all residuals from the factors of ``tree_kernel``: the selected inverse."""

from __future__ import annotations

import numpy as np

from dsse_core.tree_iteration import branch_powers
from dsse_core.tree_kernel import compiled, row_of_branch


@compiled
def find_variances(parent, Y, z, w, v, factor, more, root):
    """diag of the covariance of (va, vm), (n, 2); diag(Omega) of all slots with a meter, (n, 10); blocks, (n, 4, 4).

    A block is that of the inverse at the ``(lam, x)`` of a bus; ``root`` is the root's. With D, U and X = D^-1 U of a
    bus and S the block at its parent: ``-X S`` is the block between the two and ``D^-1 + X S X'`` that of ``(lam, f)``.
    Of an injection ``Omega = -R^2 (K^-1)_lamlam``, of other meters ``sigma^2 - h Cov h'``.
    """
    n = len(parent)
    state, omega = np.zeros((n, 2)), np.zeros((n, 10))
    S = np.zeros((n, 4, 4))  # of (lam, x)
    S[0] = root
    XS, B = np.empty((4, 4)), np.empty((4, 4))
    for i in range(n):
        square = v[i].real ** 2 + v[i].imag ** 2
        if i > 0:
            p = parent[i]
            _descend(factor[i], more[i], S[p], S[i], XS, B)
            _of_branch(i, p, Y, z, w, v, factor, more, S[p], XS, B, omega)
        state[i, 0], state[i, 1] = S[i, 2, 2], square * S[i, 3, 3]
        for k in range(2):
            if w[i, k] > 0.0:
                omega[i, k] = 1.0 / w[i, k] - state[i, k]
            if w[i, 2 + k] > 0.0:
                omega[i, 2 + k] = -(w[i, 2 + k] ** 2) * S[i, k, k]
            elif w[i, 2 + k] < 0.0:  # no meter, no multiplier
                S[i, k, :] = 0.0
                S[i, :, k] = 0.0
    return state, omega, S


@compiled
def root_of_reference(block):
    """The block of the inverse at a root whose angle is given, from what ``eliminate`` leaves of it."""
    root = np.zeros((4, 4))
    for k, a in ((0, 0), (1, 1), (2, 3)):
        for c, b in ((0, 0), (1, 1), (2, 3)):
            root[a, b] = block[k, 4 + c]
    return root


@compiled
def _descend(F, more, S, own, XS, B):
    """``XS`` = X S, ``B`` the block of (lam, f), ``own`` that of (lam, x), from the parent's ``S``."""
    for r in range(4):
        for c in range(4):
            XS[r, c] = F[4 * r] * S[0, c] + F[4 * r + 1] * S[1, c] + F[4 * r + 2] * S[2, c] + F[4 * r + 3] * S[3, c]
    for r in range(4):
        for c in range(r, 4):
            B[r, c] = XS[r, 0] * F[4 * c] + XS[r, 1] * F[4 * c + 1] + XS[r, 2] * F[4 * c + 2] + XS[r, 3] * F[4 * c + 3]
    B[0, 0] += more[6]
    B[0, 1] += more[7]
    B[1, 1] += more[8]
    B[0, 2] += F[0]
    B[0, 3] += F[1]
    B[1, 2] += F[4]
    B[1, 3] += F[5]
    B[2, 2] += F[8]
    B[2, 3] += F[9]
    B[3, 3] += F[13]
    t0, t1, qr, qi = F[20], F[21], F[22], F[23]
    own[0, 0], own[0, 1], own[1, 0], own[1, 1] = B[0, 0], B[0, 1], B[0, 1], B[1, 1]
    for k in range(2):  # lam with x = T x_p + Z f
        own[k, 2] = -XS[k, 2] - t0 * XS[k, 3] - qi * B[k, 2] - qr * B[k, 3]
        own[k, 3] = -t1 * XS[k, 3] + qr * B[k, 2] - qi * B[k, 3]
        own[2, k], own[3, k] = own[k, 2], own[k, 3]
    # x_p and f with x
    p00, p10 = S[2, 2] + t0 * S[2, 3] + qi * XS[2, 2] + qr * XS[3, 2], 0.0
    p10 = S[2, 3] + t0 * S[3, 3] + qi * XS[2, 3] + qr * XS[3, 3]
    p11 = t1 * S[3, 3] - qr * XS[2, 3] + qi * XS[3, 3]
    f00, f10 = _with_va(XS, B, 2, t0, qr, qi), _with_va(XS, B, 3, t0, qr, qi)
    f01, f11 = -t1 * XS[2, 3] + qr * B[2, 2] - qi * B[2, 3], -t1 * XS[3, 3] + qr * B[2, 3] - qi * B[3, 3]
    own[2, 2] = p00 + t0 * p10 - qi * f00 - qr * f10
    own[3, 3] = t1 * p11 + qr * f01 - qi * f11
    own[2, 3] = t1 * p10 + qr * f00 - qi * f10
    own[3, 2] = own[2, 3]


@compiled
def _with_va(XS, B, k, t0, qr, qi):
    """Covariance of f (row ``k`` of the block) with va of the same bus."""
    to_0, to_1 = (B[2, 2], B[2, 3]) if k == 2 else (B[2, 3], B[3, 3])
    return -XS[k, 2] - t0 * XS[k, 3] - qi * to_0 - qr * to_1


@compiled
def _of_branch(i, p, Y, z, w, v, factor, more, S, XS, B, omega):
    """Omega of the flows and currents of the branch above bus ``i``."""
    if w[i, 4] > 0.0:
        omega[i, 4] = 1.0 / w[i, 4] - B[2, 2]
    if w[i, 5] > 0.0:
        omega[i, 5] = 1.0 / w[i, 5] - B[3, 3]
    if w[i, 6] + w[i, 7] + w[i, 8] + w[i, 9] == 0.0:
        return
    own, at_parent = branch_powers(i, p, Y, v)
    vm, p2 = abs(v[i]), v[p].real ** 2 + v[p].imag ** 2
    for k in range(6, 10):
        if w[i, k] > 0.0:
            k0, k1, kx, _ = row_of_branch(k, z, i, own, at_parent, vm, p2, factor, more)
            variance = k0 * k0 * B[2, 2] + 2 * k0 * k1 * B[2, 3] + k1 * k1 * B[3, 3] + kx * kx * S[3, 3]
            omega[i, k] = 1.0 / w[i, k] - (variance - 2 * kx * (k0 * XS[2, 3] + k1 * XS[3, 3]))
