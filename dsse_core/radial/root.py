"""The root of a tree, after all its branches are added up: information about it, and its step. Compiled."""

from __future__ import annotations

import math

from dsse_core.code_cache import compiled
from dsse_core.radial.block import NOTHING_KNOWN, scaled, solve_blocks, square_of, wrap

N_KNOWN = 16  # numbers of the information about a bus: see ``kernel.eliminate``


@compiled
def describe_root(Y, z, w, v, va, known, angle_given, power_too):
    """Adds to ``known`` (16,), the information about the root from its branches, that of its own meters.

    With ``power_too`` also that of its balance of power. With ``angle_given`` the entries of the angle become 0.
    """
    u2 = square_of(v)
    vm = math.sqrt(u2)
    if power_too:
        ysh = scaled(Y[7], u2)
        known[0] -= w[2]
        known[2] -= w[3]
        known[4] += 2.0 * ysh.real
        known[6] += 2.0 * ysh.imag
        known[10] += z[2] - (ysh.real + known[14])
        known[11] += z[3] - (ysh.imag + known[15])
    if w[0] > 0.0:
        known[7] += w[0]
        known[12] += w[0] * wrap(z[0] - va)
    if w[1] > 0.0:
        known[9] += w[1] * u2
        known[13] += w[1] * vm * (z[1] - vm)
    if angle_given:
        known[3] = known[5] = known[7] = known[8] = known[12] = 0.0


@compiled
def find_root_objective(Y, z, w, v, va, known):
    """J of the root's own meters; ``known`` has the powers into the branches below."""
    u2 = square_of(v)
    r0, r1 = z[2] - (Y[7].real * u2 + known[14]), z[3] - (Y[7].imag * u2 + known[15])
    J = 0.0
    if w[0] > 0.0:
        J += w[0] * wrap(z[0] - va) ** 2
    if w[1] > 0.0:
        J += w[1] * (z[1] - math.sqrt(u2)) ** 2
    if w[2] > 0.0:
        J += r0 * r0 / w[2]
    if w[3] > 0.0:
        J += r1 * r1 / w[3]
    return J


@compiled
def solve_root(Y, z, w, v, va, K, angle_given, check, block, step):
    """Fills ``block``, the root's block of the inverse in columns 4 to 7, and the root's row of ``step`` (:, 4).

    ``K`` (16,): the information about the root from its branches, which becomes 0. Returns as ``solve_block``.
    """
    describe_root(Y, z, w, v, va, K, angle_given, True)
    nothing_known = check and angle_given and K[9] < NOTHING_KNOWN
    if w[2] < 0.0:
        K[0], K[1], K[3], K[4], K[10] = -1.0, 0.0, 0.0, 0.0, 0.0
    if w[3] < 0.0:
        K[2], K[1], K[5], K[6], K[11] = -1.0, 0.0, 0.0, 0.0, 0.0
    if angle_given:
        K[7] = K[9] if K[9] > 0.0 else 1.0  # there is nothing to find
    block[:] = 0.0
    block[0, 0], block[0, 1], block[0, 2], block[0, 3], block[0, 8] = K[0], K[1], K[3], K[4], K[10]
    block[1, 0], block[1, 1], block[1, 2], block[1, 3], block[1, 8] = K[1], K[2], K[5], K[6], K[11]
    block[2, 0], block[2, 1], block[2, 2], block[2, 3], block[2, 8] = K[3], K[5], K[7], K[8], K[12]
    block[3, 0], block[3, 1], block[3, 2], block[3, 3], block[3, 8] = K[4], K[6], K[8], K[9], K[13]
    for k in range(N_KNOWN):
        K[k] = 0.0
    for k in range(4):
        block[k, 4 + k] = 1.0
    ratio = solve_blocks(block, 9, check)
    for k in range(4):
        step[0, k] = block[k, 8]
    return 0.0 if nothing_known else ratio
