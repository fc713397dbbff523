"""Common parts of the compiled passes over a tree: the 4 x 4 block of a bus, small formulas."""

from __future__ import annotations

import math

import numpy as np
from numba.extending import overload

from dsse_core.code_cache import compiled
from dsse_core.radial.lanes import LANES, as_floats, lanes

LEAST_SCALE = 1e-8  # of the rows of lam, in units of 1 / variance: round-off in place of information sets no scale
NO_INFORMATION = 1e-20  # with all sigmas 1: a pivot that only round-off can have made
NOTHING_KNOWN = 1e-10  # with all sigmas 1: information from below about a voltage is of the order of 1, or round-off
N_INVERSE = 11  # columns of a block with right-hand sides: D (4), U (4), r (1), and two of the unit matrix


@compiled
def wrap(angle):
    return math.pi - (math.pi - angle) % (2 * math.pi)


@compiled
def modulus(s):
    """|s| of voltages and powers in p.u., whose squares do not overflow."""
    return math.sqrt(s.real * s.real + s.imag * s.imag)


@compiled
def square_of(s):
    """|s|^2."""
    return s.real**2 + s.imag**2


@compiled
def scaled(c, a):
    """``a c`` of a complex ``c`` and a real ``a``: a product of two complex numbers would be twice the work."""
    return complex(a * c.real, a * c.imag)


@compiled
def cut_round_off(known):
    """Information ``known`` about a voltage with all sigmas 1; 0 where it is only round-off."""
    return known if abs(known) > NOTHING_KNOWN else 0.0


@compiled
def solve_block(A, width, check):
    """A[:, 4:width] = A[:, :4]^-1 A[:, 4:width] with row pivoting; the least pivot ratio if ``check``, else 1."""
    for k in range(2):  # rows of lam in the units of those of f, so that their entries can be compared
        variance = abs(A[k, k])
        scale = max(abs(A[2 + k, 2 + k]), LEAST_SCALE / variance if variance > 0.0 else 0.0)
        if scale == 0.0:
            scale = 1.0
        for c in range(width):
            A[k, c] *= scale
    ratio = 1.0
    largest = np.empty(4) if check else A[0]
    if check:
        for c in range(4):
            largest[c] = max(max(abs(A[0, c]), abs(A[1, c])), max(abs(A[2, c]), abs(A[3, c])))
    for k in range(4):
        best, at = abs(A[k, k]), k
        for r in range(k + 1, 4):
            if abs(A[r, k]) > best:
                best, at = abs(A[r, k]), r
        if check:
            ratio = min(ratio, best / largest[k]) if best > NO_INFORMATION else 0.0
        if at != k:
            for c in range(k, width):
                A[k, c], A[at, c] = A[at, c], A[k, c]
        inverse = 1.0 / A[k, k]
        for c in range(k + 1, width):
            A[k, c] *= inverse
        for r in range(k + 1, 4):
            m = A[r, k]
            if m != 0.0:
                for c in range(k + 1, width):
                    A[r, c] -= m * A[k, c]
    for k in range(3, 0, -1):
        for r in range(k):
            m = A[r, k]
            for c in range(4, width):
                A[r, c] -= m * A[k, c]
    return ratio


def solve_blocks(A, width, check):
    """``solve_block`` for A (4, N_INVERSE) of floats or of lanes; every lane has pivots of its own."""
    return solve_block(A, width, check)


@overload(solve_blocks)
def _solve_blocks(A, width, check):
    if A.dtype is not lanes:
        return lambda A, width, check: solve_block(A, width, check)

    def solve_each(A, width, check):
        floats, one, least = as_floats(A), np.empty((4, N_INVERSE)), 1.0
        for k in range(LANES):
            one[:] = floats[:, :, k]
            least = min(least, solve_block(one, width, check))
            floats[:, :, k] = one
        return least

    return solve_each
