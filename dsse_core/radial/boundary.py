"""Boundary messages on the tree of one area's buses, compiled: a neighbour's is the message of one more branch.

The message of a neighbour about ``y = (p, q, vm_b, va_b)``, rows ``[P X; 0 N]``, is information about the voltage of
bus b and a power that leaves it, as a bus passes to its parent in ``kernel``: covariance ``V = (P'P)^-1``, slope ``A =
P^-1 X``, information ``N'N``. A child's power is a variable of the area. The power in the message of the parent is
the sum of the powers into the area's own branches, as an exact balance at b states. The area's own message is the
information left at the root of a tree with b on top. Without neighbours these are the passes of the centre.
"""

from __future__ import annotations

import math

from dsse_core.code_cache import compiled
from dsse_core.radial.block import scaled
from dsse_core.radial.inverse import find_variances
from dsse_core.radial.iteration import branch_powers
from dsse_core.radial.kernel import UPWARD, descend, eliminate
from dsse_core.radial.root import solve_root

SILENT, RECEIVED, ADDRESSEE = 0, 1, 2  # role of a neighbour in a pass
N_MESSAGE = 9  # numbers of a neighbour's message: V (3), A (4), mean (2)
LARGEST_LOSS = 1e-4  # least variance that is a difference, relative to the minuend: it is then accurate to 1e-9


@compiled
def pass_upward(
    order, parent, Y, z, w, mode, at, column, role, R, message_z, x, damping, least_of_flow, least_spread,
    v, va, message_of, place, above, factor, more, block, step,
):  # fmt: skip
    """Pass from leaves to root with all messages; False where too few digits are left. Fills ``above[0]``, of the root.

    ``mode``: see ``kernel``; only UPWARD tells if digits are left. ``at`` (k,): bus of each neighbour; ``column`` (k,):
    where x has the power into it, -1 for the parent. ``damping``: information about the change of voltages and powers.
    Sets ``w`` of injections to 0 at the parent's bus where the parent's message is received.
    """
    n = len(order)
    for i in range(n):
        row = order[i]
        vm = x[n + row]
        va[i] = x[row]
        v[i] = scaled(complex(math.cos(va[i]), math.sin(va[i])), vm)
        above[i, :] = 0.0
        above[i, 7], above[i, 9] = damping[0], damping[0] * vm * vm
    for k in range(len(at)):
        if role[k] == ADDRESSEE or (column[k] < 0 and role[k] == SILENT):
            continue
        i, c = at[k], column[k]
        if c < 0:
            w[i, 2] = w[i, 3] = 0.0
            p, q = _powers_from(i, parent, Y, v)
            sign, d = -1.0, least_of_flow
        else:
            p, q = x[c], x[c + 1]
            sign, d = 1.0, damping[1]
        _add_message(above[i], message_of[k], R[k], message_z[k], p, q, abs(v[i]), va[i], sign, d)
        if (w[i, 2] >= 0.0 or w[i, 3] >= 0.0) and not _is_spread(
            message_of[k, 0], message_of[k, 1], message_of[k, 2], least_spread
        ):
            return False
    eliminate(1, n, parent, Y, z, w, v, va, True, mode, place, above, factor, more, block, least_of_flow)
    if mode == UPWARD:
        for i in range(1, n):
            if not _is_spread(factor[i, 8], factor[i, 9], factor[i, 13], least_spread):
                return False
    return math.isfinite(above[0].sum())


@compiled
def _is_spread(V00, V01, V11, least):
    return V00 > 0.0 and V11 > 0.0 and least * V00 * V11 < V00 * V11 - V01 * V01


@compiled
def _powers_from(bus, parent, Y, v):
    """Power from ``bus`` into all branches there."""
    total = 0j
    for i in range(1, len(parent)):
        if i == bus:
            total += branch_powers(i, parent[i], Y, v)[0]
        elif parent[i] == bus:
            total += branch_powers(i, bus, Y, v)[1]
    return total.real, total.imag


@compiled
def _add_message(M, T, R, z, p, q, vm, va, sign, d):
    """Adds a neighbour's message to ``M``, the other information about a bus; fills ``T``, which gives its power.

    With ``G = P'P + d`` and ``K = (P P' + d)^-1``: ``V = G^-1``, ``V P' = P' K`` and ``1 - P V P' = d K``, written out
    so that nothing is a difference.
    """
    a, b, c = sign * R[0, 0], sign * R[0, 1], sign * R[1, 1]
    r0 = z[0] - (R[0, 0] * p + R[0, 1] * q + R[0, 2] * vm + R[0, 3] * va)
    r1 = z[1] - (R[1, 1] * q + R[1, 2] * vm + R[1, 3] * va)
    r2 = z[2] - (R[2, 2] * vm + R[2, 3] * va)
    r3 = z[3] - R[3, 3] * va
    x00, x01, x10, x11 = R[0, 3], R[0, 2] * vm, R[1, 3], R[1, 2] * vm
    a2, b2, c2 = a * a, b * b, c * c
    over = 1.0 / (a2 * c2 + d * (a2 + b2 + c2) + d * d)
    V00, V01, V11 = (b2 + c2 + d) * over, -a * b * over, (a2 + d) * over
    g00, g01, g10, g11 = a * (c2 + d) * over, -a * b * c * over, b * d * over, c * (a2 + d) * over
    A00, A01, A10, A11 = g00 * x00 + g01 * x10, g00 * x01 + g01 * x11, g10 * x00 + g11 * x10, g10 * x01 + g11 * x11
    y0 = g00 * r0 + g01 * r1
    y1 = g10 * r0 + g11 * r1
    k00, k01, k11 = d * (c2 + d) * over, -d * b * c * over, d * (a2 + b2 + d) * over
    h00, h01 = k00 * x00 + k01 * x10, k00 * x01 + k01 * x11
    h10, h11 = k01 * x00 + k11 * x10, k01 * x01 + k11 * x11
    n0, n1, n2 = R[2, 3], R[2, 2] * vm, R[3, 3]
    M[0] -= V00
    M[1] -= V01
    M[2] -= V11
    M[3] -= A00
    M[4] -= A01
    M[5] -= A10
    M[6] -= A11
    M[7] += n0 * n0 + n2 * n2 + x00 * h00 + x10 * h10
    M[8] += n0 * n1 + x00 * h01 + x10 * h11
    M[9] += n1 * n1 + x01 * h01 + x11 * h11
    M[10] -= y0
    M[11] -= y1
    M[12] += n0 * r2 + n2 * r3 + h00 * r0 + h10 * r1
    M[13] += n1 * r2 + h01 * r0 + h11 * r1
    M[14] += sign * p
    M[15] += sign * q
    T[0], T[1], T[2], T[3], T[4], T[5], T[6], T[7], T[8] = V00, V01, V11, A00, A01, A10, A11, y0, y1


@compiled
def step_downward(
    order, parent, Y, z, w, at, column, v, va, message_of, place, above, factor, more, block, step, angle_given, dx
):  # fmt: skip
    """Pass from root to leaves: fills the step ``dx`` of all voltages and powers into children; True if finite."""
    n = len(order)
    solve_root(Y[0], z[0], w[0], v[0], va[0], above[0], angle_given, False, block, step)
    descend(0, n, parent, place, factor, v, va, step, 0.0, v, va)
    for i in range(n):
        row = order[i]
        dx[row], dx[n + row] = step[i, 2], abs(v[i]) * step[i, 3]
    for k in range(len(at)):
        if column[k] >= 0:
            s, T = step[at[k]], message_of[k]
            dx[column[k]] = T[7] - (T[0] * s[0] + T[1] * s[1] + T[3] * s[2] + T[4] * s[3])
            dx[column[k] + 1] = T[8] - (T[1] * s[0] + T[2] * s[1] + T[5] * s[2] + T[6] * s[3])
    return math.isfinite(dx.sum())


@compiled
def variances_downward(
    order, parent, Y, z, w, at, column, v, va, message_of, place, above, factor, more, block, step, angle_given,
    variance,
):  # fmt: skip
    """Pass from root to leaves: fills ``variance`` of all variables.

    Returns diag(Omega) of every slot, (n, 10), the blocks of ``find_variances``, and True where digits enough are left.
    """
    n = len(order)
    solve_root(Y[0], z[0], w[0], v[0], va[0], above[0], angle_given, False, block, step)
    state, omega, S = find_variances(parent, Y, w, v, factor, more, block, angle_given)
    enough = True
    for i in range(n):
        variance[order[i]], variance[n + order[i]] = state[i, 0], state[i, 1]
        if i > 0:  # the voltage's own variance is a difference of that of the power through the branch, times |q|^2
            given = (factor[i, 22] ** 2 + factor[i, 23] ** 2) * (factor[i, 8] + factor[i, 13])
            enough = enough and given * LARGEST_LOSS < min(state[i, 0], state[i, 1])
    for k in range(len(at)):
        if column[k] >= 0:
            T, B = message_of[k], S[at[k]]
            for m in range(2):
                row = (T[m], T[1 + m], T[3 + 2 * m], T[4 + 2 * m])
                total = T[2 * m]
                for a in range(4):
                    for b in range(4):
                        total += row[a] * B[a, b] * row[b]
                variance[column[k] + m] = total
    return omega, S, enough and math.isfinite(variance.sum())
