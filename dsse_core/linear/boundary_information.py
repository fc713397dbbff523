"""Message from one side of a boundary to the other, and its assembly from information about voltage and power."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

EXACT_SIGMA = 1e-9  # p.u.; of exact injections, which may outnumber the variables once the boundary's voltage is given
TIED_SIGMA = 1e-13  # p.u.; of powers that follow from the state, and the least of all, as exact injections add up
ROUNDING = 1e-14  # relative size of a difference of equal numbers
NOTHING_OF_VOLTAGE = 1e-10  # information about a voltage, below which it is rounding
BEYOND_REASON = 1e18  # largest size of the numbers of a message


def are_within_reason(numbers: Sequence[float]) -> bool:
    """True where no number of a message is above BEYOND_REASON in size or nan; ``numbers`` has one at least."""
    return math.isfinite(sum(numbers)) and min(numbers) >= -BEYOND_REASON and max(numbers) <= BEYOND_REASON


@dataclass(frozen=True)
class BoundaryInformation:
    """Cost-to-go ``1/2 |R y - z|^2`` of one side of a boundary: ``R`` (d, d) upper triangular, ``z`` (d,).

    The boundary has d variables y. A row of zeros holds no information. ``L = R'R`` is its information matrix.
    """

    R: np.ndarray
    z: np.ndarray

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of R and z that hold information."""
        is_known = self.R.any(axis=1)
        return self.R[is_known], self.z[is_known]

    def with_row(self, row: np.ndarray, z: float) -> BoundaryInformation:
        """Information with one more ``row`` (d,) about y, of variance 1 and right-hand side ``z``."""
        rows = np.vstack([np.column_stack([self.R, self.z]), [*row, z]])
        heavy_first = rows[np.argsort(-abs(rows[:, :-1]).max(axis=1), kind="stable")]
        turned = np.asarray(np.linalg.qr(heavy_first, mode="r"))
        return BoundaryInformation(turned[:-1, :-1], turned[:-1, -1])


def put_together(
    y: np.ndarray, power: np.ndarray, response: np.ndarray, shift: np.ndarray, voltage: tuple[np.ndarray, np.ndarray]
) -> BoundaryInformation:
    """Message of ``|power dpq + response dv - shift|^2`` and ``voltage`` = (N, n), ``|N dv - n|^2``, around ``y``.

    dpq and dv, (2,) each, are the changes of (p, q) and (vm, va); ``power`` and ``response`` (2, 2).
    """
    N, z_of_voltage = voltage
    a, b = float(power[0, 0]), float(power[1, 0])
    length = math.hypot(a, b)
    turn = np.array([[a, b], [-b, a]]) / length if length else np.eye(2)
    R = np.zeros((len(y), len(y)))
    R[:2, :2], R[:2, 2:], R[2:, 2:] = turn @ power, turn @ response, N
    R[1, 0] = 0.0
    return BoundaryInformation(R, R @ y + np.concatenate([turn @ shift, z_of_voltage]))


def factor_information(M: np.ndarray, g: np.ndarray, nothing: float) -> tuple[np.ndarray, np.ndarray]:
    """N upper triangular and n with ``N'N = M``, ``N'n = g``; information in M, (2, 2), up to ``nothing`` becomes 0."""
    m00, m01, m11 = float(M[0, 0]), float(M[0, 1]), float(M[1, 1])
    n00 = n01 = n11 = n0 = n1 = 0.0
    if m00 > nothing:
        n00 = math.sqrt(m00)
        n01 = m01 / n00 if m11 > nothing else 0.0
        n0 = float(g[0]) / n00
    rest = m11 - n01 * n01
    if rest > max(nothing, ROUNDING * m11):
        n11 = math.sqrt(rest)
        n1 = (float(g[1]) - n01 * n0) / n11
    return np.array([[n00, n01], [0.0, n11]]), np.array([n0, n1])


def factor_inverse(S: np.ndarray) -> np.ndarray:
    """P with ``P'P = S^-1`` for the (2, 2) covariance S.

    The less certain of p and q comes first, then the other one given the first: p may be as good as unknown and still
    determine q, by the losses that it causes. A variance below zero is rounding of a number too large to be known, and
    gives a row of 0.
    """
    least = TIED_SIGMA**2
    s00, s01, s11 = float(S[0, 0]), float(S[0, 1]), float(S[1, 1])
    p_first = abs(s00) >= abs(s11)
    unknown, known = (s00, s11) if p_first else (s11, s00)
    root = slope = 0.0
    if unknown > 0:
        variance = max(unknown, least)
        slope, root = s01 / variance, 1 / math.sqrt(variance)
    other = 1 / math.sqrt(max(known - slope * s01, least, ROUNDING * known))
    if p_first:
        return np.array([[root, 0.0], [-slope * other, other]])
    return np.array([[0.0, root], [other, -slope * other]])


def invert_root(F: np.ndarray) -> np.ndarray:
    """P with ``P'P = (F'F)^-1`` for F (:, n), a root of the covariance of n combinations of powers.

    The least certain comes first, then the others given those before.
    """
    turned, order, _, _, _ = lapack.dgeqp3(F)
    T, each = np.triu(turned[: F.shape[1]]), np.arange(F.shape[1])
    least = np.maximum(TIED_SIGMA, ROUNDING * np.linalg.norm(T, axis=0))
    T[each, each] = np.copysign(np.maximum(abs(T[each, each]), least), T[each, each])
    P = np.empty(T.shape)
    P[:, order - 1] = lapack.dtrtri(T)[0].T
    return P
