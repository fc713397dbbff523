"""Elimination of variables from weighted rows by reflections.

Rows with weights over many decades keep their digits each, as heavy rows come first and columns are pivoted (Higham,
Accuracy and Stability of Numerical Algorithms, 20.3). The last column of all rows is that of the residuals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

NOISE = 1e-13  # of the largest pivot of exact rows: smaller entries are rounding
LIGHT = 1e-5  # of the largest pivot of exact rows: it keeps few digits


class Eliminated(NamedTuple):
    """Variables eliminated from rows: ``triangle dx[order] = known - rest dy``, with ``turned = [rest | known]``.

    ``rows``: the rows that are left, without the eliminated variables. ``Q``: the reflections, as LAPACK stores them,
    of the rows in the order ``taken``. The first ``n_exact`` rows of the triangle are exact ones, without part in Q.
    """

    triangle: np.ndarray
    order: np.ndarray
    turned: np.ndarray
    rows: np.ndarray
    Q: tuple[np.ndarray, np.ndarray]
    taken: np.ndarray
    n_exact: int = 0

    @property
    def heads(self) -> np.ndarray:
        """The rows that eliminate the variables, (k, n + rest), with all columns in the order given."""
        n = len(self.order)
        rows = np.zeros((len(self.turned), n + self.turned.shape[1]))
        rows[:, self.order], rows[:, n:] = np.triu(self.triangle), self.turned
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
        """F, (n, :), with ``F F'`` the covariance of dx, for ``dy`` (:, k) with ``dy dy'`` that of the others.

        Exact rows of the triangle have no variance.
        """
        return self._solve(np.hstack([np.eye(len(self.order))[:, self.n_exact :], -self.turned[:, :-1] @ dy]))

    def reflect(self, dx: np.ndarray) -> np.ndarray:
        """``B F`` without the part of the others, (n, k): ``triangle'^-1 dx`` for columns ``dx`` = B', (n, k)."""
        return np.asarray(lapack.dtrtrs(self.triangle, dx[self.order], trans=1)[0]) if len(dx) else dx

    def _solve(self, b: np.ndarray) -> np.ndarray:
        dx = np.zeros_like(b)
        if len(dx):
            dx[self.order] = lapack.dtrtrs(self.triangle, b)[0]
        return dx

    def turn_back(self, left: np.ndarray, heads: np.ndarray | None = None) -> np.ndarray:
        """Columns ``left`` (len(rows), k) of the rows that are left, in terms of the rows given, (len(taken), k).

        ``heads``: columns of the rows that eliminate, before those of ``left``.
        """
        n, first = len(self.order) - self.n_exact, 0 if heads is None else heads.shape[1]
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
    turned = lapack.dormqr("L", "T", *Q, rows[:, n:], rows.size, overwrite_c=1)[0]
    return Eliminated(reflectors[:n], order - 1, turned[:n], turned[n:], Q, taken)


class Exact(NamedTuple):
    """Variables that exact rows eliminate by themselves: the first k of ``order``, (n,).

    ``heads`` (k, :): the rows that do, triangular. ``light``: the other ones, without these k variables; of the n they
    have the last ``n_late`` only. The columns of both are the n variables in this order, then the others and residuals.
    """

    order: np.ndarray
    heads: np.ndarray
    light: np.ndarray
    n_late: int


def eliminate_exact(rows: np.ndarray, n: int) -> Exact:
    """Elimination of the first ``n`` variables from exact ``rows`` by pivots that are not LIGHT.

    In lighter rows an entry of these variables below NOISE of the largest pivot is the rounding of a row that has none
    of them, and becomes 0: it would be multiplied by the weight of exact rows.
    """
    alone, turned = eliminate(rows, n), np.zeros(rows.shape)
    m = len(alone.turned)
    turned[:m, :n], turned[:m, n:], turned[m:, n:] = np.triu(alone.triangle), alone.turned, alone.rows
    pivots, order, n_late = abs(alone.triangle.diagonal()), alone.order, 0  # pivots do not increase
    k = int(np.count_nonzero(pivots > LIGHT * pivots[0])) if m else 0
    if k < m:
        of_light = turned[k:m, :n]
        of_light[abs(of_light) <= NOISE * pivots[0]] = 0.0
        is_late = of_light.any(axis=0)
        late_last, n_late = np.argsort(is_late, kind="stable"), int(is_late.sum())
        order, turned[:, :n] = order[late_last], turned[:, late_last]
    return Exact(order, turned[:k], turned[k:], n_late)


def eliminate_beside(exact: Exact, rows: np.ndarray, n: int) -> Eliminated:
    """Elimination of the first ``n`` variables in the order of ``exact`` from its heads and from ``rows``, which have
    the columns of ``exact``.

    Heads are obeyed before rows have a say. By reflections of all of them a row that is heavier than the pivot of a
    head would take its place, and spread its rounding to all other rows.
    """
    k, heads = len(exact.heads), exact.heads
    if k:
        rows = rows[:, k:] - rows[:, :k] @ lapack.dtrtrs(heads[:, :k], heads[:, k:])[0]
    found = eliminate(rows, n - k)
    if not k:
        return found
    triangle = np.zeros((k + len(found.turned), n))
    triangle[:k, :k], triangle[:k, k:] = heads[:, :k], heads[:, k + found.order]
    triangle[k:, k:] = found.triangle
    order, turned = np.append(np.arange(k), k + found.order), np.concatenate([heads[:, n:], found.turned])
    return Eliminated(triangle, order, turned, found.rows, found.Q, found.taken, k)


def turn_alone(rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
    """Rows with the same information as ``rows``, as few as possible of them with any of the first ``n`` variables.

    Exact rows are so heavy that one more of them than variables to eliminate would spoil the other rows.

    Returns also the number of rows, the first ones, whose pivots are above NOISE of the largest. In the others entries
    of the n variables that are below it are rounding, and become 0.
    """
    alone, turned = eliminate(rows, n), np.zeros_like(rows)
    k, T = len(alone.turned), alone.triangle
    turned[:k, alone.order] = np.triu(T)
    turned[:k, n:], turned[k:, n:] = alone.turned, alone.rows
    above = int(np.count_nonzero(abs(T.diagonal()) > NOISE * abs(T[0, 0]))) if k else 0  # pivots do not increase
    light = turned[above:k, :n]
    light[abs(light) <= NOISE * abs(T[:1, :1].sum())] = 0.0
    return turned, above


def triangulate(rows: np.ndarray) -> np.ndarray:
    """Upper triangular rows with the same information as ``rows``, as many as columns."""
    m, n = rows.shape
    if m < n:
        rows = np.pad(rows, ((0, n - m), (0, 0)))
    return np.asarray(np.triu(lapack.dgeqrf(rows[_heavy_first(rows, n - 1)])[0][:n]))


def _heavy_first(rows: np.ndarray, n: int) -> np.ndarray:
    """The order of ``rows`` by their largest entry in the first ``n`` columns."""
    return np.argsort(-abs(rows[:, :n]).max(axis=1), kind="stable")
