"""What both sides of a boundary together say of ``y = (p, q, vm, va)``: mean, spread, contradiction, what is news."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgeqp3, dormqr, dtrtri, dtrtrs

from dsse_core.boundary_information import BoundaryInformation

MEAN_MOVES = 1e-10  # p.u., rad: what of a boundary's marginal is worth a message
MEAN_MOVES_SIGMA = 1e-7  # or, if that is more, this part of its standard deviation
SIGMA_MOVES = 1e-7  # of its standard deviations
SINGULAR = 1e-14  # scaled pivots below it leave a direction of y open


def marginal_of(y: np.ndarray, *sides: BoundaryInformation) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of y, shape (4,), found as a step from ``y``, and its standard deviations.

    None for the latter where the sides together leave some of y open. A quantity that nobody speaks of (the angle
    of a reference at the boundary bus) stays, with a standard deviation of 1.
    """
    R = np.concatenate([side.R for side in sides])
    r = np.concatenate([side.z - side.R @ y for side in sides])
    length = np.sqrt((R**2).sum(axis=0))
    spoken = np.flatnonzero(length)
    heavy_first = np.argsort(-abs(R).max(axis=1), kind="stable")
    upper, turned, order = _factor(R[heavy_first][:, spoken] / length[spoken], r[heavy_first])
    order = spoken[order]
    k = int((abs(np.diag(upper)) > SINGULAR).sum())
    mean = y.copy()
    if k > 0:
        mean[order[:k]] += dtrtrs(upper[:k, :k], turned[:k])[0] / length[order[:k]]
    if k < len(order):
        return mean, None
    sigma = np.ones(4)
    if k > 0:
        sigma[order] = np.sqrt((np.triu(dtrtri(upper)[0]) ** 2).sum(axis=1)) / length[order]
    return mean, sigma


def _factor(A: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangle of ``A[:, order] = Q [upper; 0]``, ``Q'r`` and ``order``, pivoted.

    By LAPACK's own calls: an area asks before every message, and around so small a matrix ``scipy.linalg.qr`` takes
    several times as long as the work itself.
    """
    n_row, n_column = A.shape
    if n_column == 0:
        return np.zeros((0, 0)), r, np.zeros(0, dtype=int)
    reflectors, order, tau, _, _ = dgeqp3(A)
    turned = dormqr("L", "T", reflectors, tau, r[:, None], max(1, n_row))[0][:, 0]
    return np.triu(reflectors[: min(n_row, n_column)]), turned, order - 1


def distance_between(y: np.ndarray, one: BoundaryInformation, other: BoundaryInformation) -> tuple[float, int]:
    """What the two sides' cost-to-go cannot both reach, chi-square distributed with the degrees of freedom given."""
    R = np.concatenate([one.R, other.R])
    told = abs(R).max(axis=1) > 0
    R, r = R[told], np.concatenate([one.z - one.R @ y, other.z - other.R @ y])[told]
    length = np.sqrt((R**2).sum(axis=0))
    spoken = length > 0
    A = R[:, spoken] / length[spoken]
    step, _, rank, _ = np.linalg.lstsq(A, r, rcond=SINGULAR)
    return float(((r - A @ step) ** 2).sum()), len(r) - int(rank)


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
