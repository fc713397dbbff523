"""Elimination of variables from weighted rows by reflections.

Rows with weights over many decades keep their digits each, as heavy rows come first and columns are pivoted (Higham,
Accuracy and Stability of Numerical Algorithms, 20.3). The last column of all rows is that of the residuals.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

NOISE = 1e-13  # of the largest pivot of exact rows: smaller entries are rounding


class Eliminated(NamedTuple):
    """Variables eliminated from rows: ``triangle dx[order] = known - rest dy``, with ``turned = [rest | known]``.

    ``rows``: the rows that are left, without the eliminated variables. ``Q``: the reflections, as LAPACK stores them,
    of the rows in the order ``taken``.
    """

    triangle: np.ndarray
    order: np.ndarray
    turned: np.ndarray
    rows: np.ndarray
    Q: tuple[np.ndarray, np.ndarray]
    taken: np.ndarray

    @property
    def heads(self) -> np.ndarray:
        """The rows that eliminate the variables, (k, n + rest), with all columns in the order given."""
        n = len(self.order)
        rows = np.zeros((len(self.turned), n + self.turned.shape[1]))
        rows[:, self.order], rows[:, n:] = _upper(self.triangle), self.turned
        return rows

    @property
    def least_pivot(self) -> float:
        """The smallest pivot; 0 where there are fewer rows than variables, infinite without variables."""
        pivots = abs(self.triangle.diagonal())
        return float(pivots.min(initial=np.inf)) if len(pivots) == len(self.order) else 0.0

    def substitute(self, dy: np.ndarray) -> np.ndarray:
        """dx, the eliminated variables, for ``dy``, the others."""
        return self._solve(self.turned[:, -1] - self.turned[:, :-1] @ dy)

    def spread(self, dy: np.ndarray) -> np.ndarray:
        """F, (n, n + k), with ``F F'`` the covariance of dx, for ``dy`` (:, k) with ``dy dy'`` that of the others."""
        return self._solve(np.hstack([np.eye(len(self.order)), -self.turned[:, :-1] @ dy]))

    def reflect(self, dx: np.ndarray) -> np.ndarray:
        """``B F`` without the part of the others, (n, k): ``triangle'^-1 dx`` for columns ``dx`` = B', (n, k)."""
        return np.asarray(lapack.dtrtrs(self.triangle, dx[self.order], trans=1)[0]) if len(dx) else dx

    def _solve(self, b: np.ndarray) -> np.ndarray:
        dx = np.empty(b.shape)
        if len(dx):
            dx[self.order] = lapack.dtrtrs(self.triangle, b)[0]
        return dx

    def turn_back(self, left: np.ndarray, heads: np.ndarray | None = None) -> np.ndarray:
        """Columns ``left`` (len(rows), k) of the rows that are left, in terms of the rows given, (len(taken), k).

        ``heads``: columns of the rows that eliminate, before those of ``left``.
        """
        n, first = len(self.order), 0 if heads is None else heads.shape[1]
        whole = np.zeros((len(self.taken), first + left.shape[1]))
        whole[n:, first:] = left
        if heads is not None:
            whole[:n, :first] = heads
        if whole.size and n:
            whole = lapack.dormqr("L", "N", *self.Q, whole, whole.size)[0]
        found = np.empty_like(whole)
        found[self.taken] = whole
        return found


def eliminate(rows: np.ndarray, n: int) -> Eliminated:
    """Elimination of the first ``n`` variables from ``rows``.

    Rows without these variables come last and stay as they are; at the top a heavy one would spread to all others.
    """
    if not n:
        nothing, none = np.zeros((0, 0)), np.zeros(0, dtype=int)
        return Eliminated(nothing, none, rows[:0], rows, (nothing, none), np.arange(len(rows)))
    taken = _heavy_first(rows, n)
    rows = rows.T[:, taken].T  # in the order of LAPACK
    reflectors, order, tau, _, _ = lapack.dgeqp3(rows[:, :n], overwrite_a=1)
    Q = reflectors[:, : len(tau)], tau
    least_work = rows.shape[1] - n  # reflections one by one; a block of them takes longer at these sizes
    turned = lapack.dormqr("L", "T", *Q, rows[:, n:], least_work, overwrite_c=1)[0]
    return Eliminated(reflectors[:n], order - 1, turned[:n], turned[n:], Q, taken)


def turn_alone(rows: np.ndarray, n: int, least: float = NOISE) -> tuple[np.ndarray, int]:
    """Rows with the same information as ``rows``, as few as possible of them with any of the first ``n`` variables.

    Exact rows are so heavy that one more of them than variables to eliminate would spoil the other rows.

    Returns also the number of rows, the first ones, whose pivots are above ``least`` of the largest. In the others an
    entry of the n variables below NOISE of the largest pivot is the rounding of a row that has none of them, and
    becomes 0: it would be multiplied by the weight of exact rows.
    """
    alone, turned = eliminate(rows, n), np.zeros_like(rows)
    k, T = len(alone.turned), alone.triangle
    turned[:k, alone.order] = _upper(T)
    turned[:k, n:], turned[k:, n:] = alone.turned, alone.rows
    if not k or abs(T[k - 1, k - 1]) > least * abs(T[0, 0]):  # pivots do not increase
        return turned, k
    above = int(np.count_nonzero(abs(T.diagonal()) > least * abs(T[0, 0])))
    light = turned[above:k, :n]
    light[abs(light) <= NOISE * abs(T[0, 0])] = 0.0
    return turned, above


def triangulate(rows: np.ndarray) -> np.ndarray:
    """Upper triangular rows with the same information as ``rows``, as many as columns."""
    m, n = rows.shape
    if m < n:
        rows = np.pad(rows, ((0, n - m), (0, 0)))
    return _upper(lapack.dgeqrf(rows[_heavy_first(rows, n - 1)])[0][:n])


def _heavy_first(rows: np.ndarray, n: int) -> np.ndarray:
    """The order of ``rows`` by their largest entry in the first ``n`` columns."""
    lightness: np.ndarray = -np.abs(rows[:, :n]).max(axis=1)
    return lightness.argsort(kind="stable")


def _upper(rows: np.ndarray) -> np.ndarray:
    """``rows`` with 0 below the diagonal; np.triu makes a mask each time, which takes as long as small reflections."""
    m, n = rows.shape
    return np.where(_find_upper(1 << max(m, n).bit_length())[:m, :n], rows, 0.0)


@lru_cache
def _find_upper(n: int) -> np.ndarray:
    return np.tri(n, dtype=bool).T
