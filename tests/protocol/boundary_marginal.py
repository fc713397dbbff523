"""What both sides of a boundary together say of ``y = (p, q, vm, va)``: mean and spread."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgeqp3, dormqr, dtrtri, dtrtrs

from dsse_core.linear.boundary_information import BoundaryInformation

SINGULAR = 1e-14  # scaled pivots below it leave a direction of y open
UPPER = np.triu(np.ones((4, 4)))


def marginal_of(y: np.ndarray, *sides: BoundaryInformation) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of y, shape (4,), found as a step from ``y``, and its standard deviations.

    None for the latter where the sides together leave some of y open. A quantity that nobody speaks of (the angle
    of a reference at the boundary bus) stays, with a standard deviation of 1.
    """
    t = _triangulate(y, *sides)
    mean, known = y.copy(), t.order[: t.rank]
    if t.rank > 0:
        mean[known] += dtrtrs(t.upper, t.turned[: t.rank])[0] / t.length[known]
    if t.rank < np.count_nonzero(t.length):
        return mean, None
    sigma = np.ones(4)
    if t.rank > 0:
        inverse = dtrtri(t.upper)[0] * UPPER[: t.rank, : t.rank]
        sigma[known] = np.sqrt(np.einsum("ij,ij->i", inverse, inverse)) / t.length[known]
    return mean, sigma


class _Triangle(NamedTuple):
    """``A[:, order] = Q [upper *; 0 0]``, ``turned = Q'r``: the rows of the sides, their columns divided by ``length``.

    What ``upper`` (rank, rank) has below its diagonal means nothing. ``n_known``: rows that tell something.
    """

    upper: np.ndarray
    turned: np.ndarray
    order: np.ndarray
    rank: int
    length: np.ndarray
    n_known: int


def _triangulate(y: np.ndarray, *sides: BoundaryInformation) -> _Triangle:
    """By LAPACK's own calls: an area asks before every message, and ``scipy.linalg.qr`` takes several times as long."""
    R = np.concatenate([side.R for side in sides])
    weight = abs(R).max(axis=1)
    r = np.where(weight > 0, np.concatenate([side.z for side in sides]) - R @ y, 0.0)
    length = np.sqrt(np.einsum("ij,ij->j", R, R))
    heavy_first = np.argsort(-weight, kind="stable")
    A = (R / np.where(length > 0, length, 1.0))[heavy_first]
    reflectors, order, tau, _, _ = dgeqp3(A)
    turned = dormqr("L", "T", reflectors, tau, r[heavy_first, None], len(R))[0][:, 0]
    rank = int(np.count_nonzero(abs(reflectors.diagonal()) > SINGULAR))
    return _Triangle(reflectors[:rank, :rank], turned, order - 1, rank, length, int(np.count_nonzero(weight)))
