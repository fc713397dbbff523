"""The root of a tree, after all its branches are added up: information about it, and its step. Compiled."""

from __future__ import annotations

import math

from dsse_core.code_cache import compiled
from dsse_core.radial.block import NOTHING_KNOWN, scaled, solve_blocks, wrap

N_KNOWN = 16  # numbers of the information about a root or an addressee: see describe_root


@compiled
def describe_root(Y, z, w, v, va, M, angle_given, power_too, K):
    """Fills ``K`` (16,) with the information about the root, in the order of ``above``.

    That is ``M``, from its branches, its own meters and, with ``power_too``, its balance of power. With ``angle_given``
    the entries of the angle are 0.
    """
    u2 = v.real**2 + v.imag**2
    vm = math.sqrt(u2)
    for k in range(N_KNOWN):  # a slice would compile the text of an error that cannot occur
        K[k] = M[k]
    if power_too:
        ysh = scaled(Y[7], u2)
        K[0] -= w[2]
        K[2] -= w[3]
        K[4] += 2.0 * ysh.real
        K[6] += 2.0 * ysh.imag
        K[10] += z[2] - (ysh.real + M[14])
        K[11] += z[3] - (ysh.imag + M[15])
    if w[0] > 0.0:
        K[7] += w[0]
        K[12] += w[0] * wrap(z[0] - va)
    if w[1] > 0.0:
        K[9] += w[1] * u2
        K[13] += w[1] * vm * (z[1] - vm)
    if angle_given:
        K[3] = K[5] = K[7] = K[8] = K[12] = 0.0


@compiled
def solve_root(Y, z, w, v, va, M, angle_given, check, block, K):
    """Fills ``block``: the root's block of the inverse in columns 4 to 7, its step in 8. Returns as ``solve_block``.

    ``K`` (16,), which may be ``M``, is overwritten.
    """
    describe_root(Y, z, w, v, va, M, angle_given, True, K)
    if check and angle_given and K[9] < NOTHING_KNOWN:
        return 0.0
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
    for k in range(4):
        block[k, 4 + k] = 1.0
    return solve_blocks(block, 9, check)
