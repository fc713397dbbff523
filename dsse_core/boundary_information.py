"""What one side of a boundary tells the other, and how it is put together from what is known of voltage and power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

EXACT_SIGMA = 1e-9  # p.u.; of exact injections: with the boundary's voltage given, there may be more than variables
ROUNDING = 1e-14  # relative; what is left of a difference of equal numbers
NOTHING_OF_VOLTAGE = 1e-10  # information about it, below which it is rounding
BEYOND_REASON = 1e18  # numbers of a message
VA = 3  # place of the angle in y


@dataclass(frozen=True)
class BoundaryInformation:
    """Cost-to-go ``1/2 |R y - z|^2`` of one side of a boundary: ``R`` (4, 4) upper triangular, ``z`` (4,).

    A row of zeros tells nothing. ``L = R'R`` is its information matrix.
    """

    R: np.ndarray
    z: np.ndarray

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of R and z that tell something."""
        told = self.R.any(axis=1)
        return self.R[told], self.z[told]

    @property
    def is_reasonable(self) -> bool:
        return bool(max(abs(self.R).max(), abs(self.z).max()) < BEYOND_REASON)


def put_together(
    y: np.ndarray, power: np.ndarray, response: np.ndarray, shift: np.ndarray, voltage: tuple[np.ndarray, np.ndarray]
) -> BoundaryInformation:
    """The message of ``|power dpq + response dv - shift|^2`` and ``voltage`` = (N, n), ``|N dv - n|^2``, around ``y``.

    dpq and dv, (2,) each, are the changes of (p, q) and (vm, va); ``power`` and ``response`` (2, 2).
    """
    N, told_v = voltage
    a, b = float(power[0, 0]), float(power[1, 0])
    turn = np.array([[a, b], [-b, a]]) / math.hypot(a, b) if a or b else np.eye(2)
    R = np.zeros((4, 4))
    R[:2, :2], R[:2, 2:], R[2:, 2:] = turn @ power, turn @ response, N
    R[1, 0] = 0.0
    return BoundaryInformation(R, R @ y + np.concatenate([turn @ shift, told_v]))


def factor_information(M: np.ndarray, g: np.ndarray, nothing: float) -> tuple[np.ndarray, np.ndarray]:
    """N upper triangular and n with ``N'N = M``, ``N'n = g``; what of the (2, 2) information M is ``nothing`` is 0."""
    N, n = np.zeros((2, 2)), np.zeros(2)
    M = np.where(np.diag(M) > nothing, M, 0.0)
    if M[0, 0] > nothing:
        N[0] = M[0] / np.sqrt(M[0, 0])
        n[0] = g[0] / N[0, 0]
    rest = M[1, 1] - N[0, 1] ** 2
    if rest > max(nothing, ROUNDING * M[1, 1]):
        N[1, 1] = np.sqrt(rest)
        n[1] = (g[1] - N[0, 1] * n[0]) / N[1, 1]
    return N, n


def factor_inverse(S: np.ndarray) -> np.ndarray:
    """P with ``P'P = S^-1`` for the (2, 2) covariance S.

    What is less certain comes first, then the other given it: p may be as good as unknown and still tell q, by the
    losses that it causes. A variance below zero is rounding of a number too large to be known: a row of 0.
    """
    least = EXACT_SIGMA**2
    first, other = (0, 1) if abs(S[0, 0]) >= abs(S[1, 1]) else (1, 0)
    P = np.zeros((2, 2))
    slope = 0.0
    if (unknown := S[first, first]) > 0:
        variance = max(unknown, least)
        slope = S[0, 1] / variance
        P[0, first] = 1 / np.sqrt(variance)
    rest = max(S[other, other] - slope * S[0, 1], least, ROUNDING * S[other, other])
    P[1, other], P[1, first] = np.array([1.0, -slope]) / np.sqrt(rest)
    return P
