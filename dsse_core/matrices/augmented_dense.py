"""The augmented system of ``augmented`` for areas so small that a dense factor costs less than a sparse matrix."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from dsse_core.matrices.augmented import PIVOT_SCALE, raise_damping, reciprocal_root

REFINED = 1e-6  # of 1 - K X, whose square is what one more refinement leaves
MOST_REFINED = 3


class DenseFactor:
    """The factorised system for a dense ``H`` (n_meas, n_state); see ``AugmentedFactor`` for it and its answers.

    ``variance`` (n_meas,): sigma squared.

    Raises:
        RuntimeError: the matrix is exactly singular, and damping does not help.
    """

    def __init__(self, H: np.ndarray, sigma: np.ndarray, damping: np.ndarray) -> None:
        m, n = H.shape
        self._n_meas = m
        self.variance = sigma * sigma
        row_scale = reciprocal_root(np.vecdot(H, H))
        scaled_variance = self.variance * row_scale * row_scale
        positive = scaled_variance[scaled_variance > 0]
        positive.sort()
        self._a = PIVOT_SCALE / float(positive[len(positive) // 2]) if len(positive) else 1.0
        scaled = H * row_scale[:, None]
        below = damping / self._a
        column_scale = reciprocal_root(np.vecdot(scaled.T, scaled.T) + below)
        scaled *= column_scale
        self._scale = np.concatenate([row_scale, column_scale])
        below = below * column_scale * column_scale
        self._tableau = np.zeros((m + n, m + n), order="F")
        self._tableau[:m, m:], self._tableau[m:, :m] = scaled, scaled.T
        diagonal = self._tableau.reshape(-1, order="F")[:: m + n + 1]
        diagonal[:m] = self._a * scaled_variance
        while True:
            diagonal[m:] = -below
            self._lu, self._pivots, zero_pivot = lapack.dgetrf(self._tableau)
            if not zero_pivot:
                break
            below = raise_damping(below)

    def solve(self, above: np.ndarray, below: np.ndarray, *, refined: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """(s, dx) of ``R s + H dx = above``, ``H's - damping dx = below``; vectors or columns."""
        solution = self._solve(np.concatenate([above, below / self._a]), refined)
        return self._a * solution[: self._n_meas], solution[self._n_meas :]

    def state_variance(self) -> np.ndarray:
        """diag(G^-1), shape (n_state,)."""
        return self._inverse_diagonal[self._n_meas :] / -self._a

    def residual_variance(self) -> np.ndarray:
        """diag(Omega), shape (n_meas,)."""
        variance: np.ndarray = self._a * self.variance**2 * self._inverse_diagonal[: self._n_meas]
        return variance

    @cached_property
    def _inverse_diagonal(self) -> np.ndarray:
        """Of the tableau's inverse X, refined: X + X (1 - K X), again where that is still more than rounding."""
        inverse = lapack.dgetri(self._lu, self._pivots)[0]
        unit = np.eye(len(self._scale))
        rest = unit - self._tableau @ inverse
        for _ in range(MOST_REFINED):
            if abs(rest).max() <= REFINED:
                break
            inverse = inverse + inverse @ rest
            rest = unit - self._tableau @ inverse
        diagonal = inverse.diagonal() + np.vecdot(inverse, rest.T)
        return np.asarray(self._scale * diagonal * self._scale)

    def _solve(self, b: np.ndarray, refined: bool) -> np.ndarray:
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        b = scale * b
        solution = lapack.dgetrs(self._lu, self._pivots, b)[0]
        if refined:
            solution += lapack.dgetrs(self._lu, self._pivots, b - self._tableau @ solution)[0]
        return np.asarray(scale * solution)
