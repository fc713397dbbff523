"""What both sides of a boundary together say of ``y = (p, q, vm, va)``: mean, spread, contradiction, what is news."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgeqp3, dormqr, dtrtri, dtrtrs

from dsse_core.boundary_information import BoundaryInformation

MEAN_MOVES = 1e-10  # p.u., rad: what of a boundary's marginal is worth a message
MEAN_MOVES_SIGMA = 1e-7  # or, if that is more, this part of its standard deviation
SIGMA_MOVES = 1e-7  # of its standard deviations
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


def distance_between(y: np.ndarray, one: BoundaryInformation, other: BoundaryInformation) -> tuple[float, int]:
    """What the two sides' cost-to-go cannot both reach, chi-square distributed with the degrees of freedom given."""
    t = _triangulate(y, one, other)
    left = t.turned[t.rank :]
    return float(left @ left), t.n_told - t.rank


class _Triangle(NamedTuple):
    """``A[:, order] = Q [upper *; 0 0]``, ``turned = Q'r``: the rows of the sides, their columns divided by ``length``.

    What ``upper`` (rank, rank) has below its diagonal means nothing. ``n_told``: rows that tell something.
    """

    upper: np.ndarray
    turned: np.ndarray
    order: np.ndarray
    rank: int
    length: np.ndarray
    n_told: int


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


def has_moved(
    y: np.ndarray, now: BoundaryInformation, last: BoundaryInformation, other: BoundaryInformation | None
) -> bool:
    """Whether the marginal of y, together with the ``other`` side's information, differs enough to be told.

    ``y``: the present state. Where the marginal does not exist, whether the message itself does.
    """
    others = [other] if other is not None else []
    mean, sigma = marginal_of(y, now, *others)
    last_mean, last_sigma = marginal_of(y, last, *others)
    if sigma is None or last_sigma is None:
        weight = abs(now.R).max(axis=1)
        turned = abs(now.R - last.R).max(axis=1) > SIGMA_MOVES * weight
        shifted = abs((now.z - now.R @ y) - (last.z - last.R @ y)) > np.maximum(MEAN_MOVES_SIGMA, MEAN_MOVES * weight)
        return bool((turned | shifted).any())
    worth_telling = np.maximum(MEAN_MOVES, MEAN_MOVES_SIGMA * sigma)
    return bool((abs(mean - last_mean) > worth_telling).any() or (abs(sigma / last_sigma - 1) > SIGMA_MOVES).any())
