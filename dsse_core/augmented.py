"""The weighted least-squares step in augmented form (Hachtel's tableau), sparse.

The normal equations ``H'WH dx = H'W r`` square the condition number: with sigmas over four decades or an
impedance of 1e-5 p.u. they lose every digit of Omega. The same step follows from

``[a R  H ] [ s]   [r]``
``[ H'  0 ] [dx] = [0]``  with ``R = diag(sigma^2)``,

where a virtual measurement is a row with sigma = 0, that is, an equality constraint. The factor ``a`` only
scales ``s``; it makes the factorisation choose good pivots (Bjorck, Numerical Methods for Least Squares
Problems, 2.7).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

PIVOT_SCALE = 1e-3  # median of the scaled a R; anything from 1 to 1e-6 works, with fewer digits at the ends
LARGEST_DAMPING = 1e-6  # of the scaled tableau
BLOCK = 256  # right-hand sides solved at once; bounds memory at (n_meas + n_state, BLOCK)


class AugmentedFactor:
    """The factorised system for ``H`` (n_meas, n_state) and ``sigma`` (n_meas,), 0 where a row must hold exactly.

    ``damping``, a number or one per state variable, is added to the diagonal of the information about the state:
    the lower right block becomes ``-diag(damping)``.

    Raises:
        RuntimeError: the matrix is exactly singular, and no damping mends that.
    """

    def __init__(self, H: sp.csr_array, sigma: np.ndarray, damping: float | np.ndarray = 0.0) -> None:
        self._n_meas, self._n_state = H.shape
        self._variance = sigma**2
        row_scale = reciprocal_row_lengths(H)
        scaled = scale_rows(H, row_scale)
        scaled_variance = self._variance * row_scale**2
        positive = scaled_variance[scaled_variance > 0]
        self._a = PIVOT_SCALE / float(np.median(positive)) if positive.size else 1.0
        square = np.bincount(H.indices, scaled.data**2, self._n_state)
        column_scale = _reciprocal(square + damping / self._a)
        scaled.data *= column_scale[H.indices]
        self._scale = np.concatenate([row_scale, column_scale])
        below = damping / self._a * column_scale**2
        while True:
            self._tableau = build_tableau(self._a * scaled_variance, scaled, -below)
            try:
                self._lu = spla.splu(self._tableau)
                break
            except RuntimeError:  # exactly singular: a damping that rounding has swallowed must be larger
                if not below.any() or below.max() > LARGEST_DAMPING:
                    raise
                below = below * 1e3

    def solve(self, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(s, dx) of ``R s + H dx = above``, ``H's - damping dx = below``; vectors or columns."""
        solution = self._solve(np.concatenate([above, below / self._a]))
        return self._a * solution[: self._n_meas], solution[self._n_meas :]

    def solve_step(self, residual: np.ndarray) -> np.ndarray:
        """The step dx, shape (n_state,), for the residuals z - h(x), shape (n_meas,)."""
        return self.solve(residual, np.zeros(self._n_state))[1]

    def covariance_times(self, B: np.ndarray) -> np.ndarray:
        """``G^-1 B`` (n_state, k), ``G = H'WH`` under the constraints: columns of the state's covariance."""
        return -self.solve(np.zeros((self._n_meas, B.shape[1])), B)[1]

    def state_variance(self) -> np.ndarray:
        """diag(G^-1), shape (n_state,)."""
        return self._diagonal(self._n_meas, self._n_state) / -self._a

    def residual_variance(self) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); found without that cancellation."""
        variance: np.ndarray = self._a * self._variance**2 * self._diagonal(0, self._n_meas)
        return variance

    def _diagonal(self, first: int, count: int) -> np.ndarray:
        """Entries first ... first + count - 1 of the diagonal of the inverse."""
        diagonal = np.zeros(count)
        for k in range(0, count, BLOCK):
            block = np.arange(k, min(k + BLOCK, count))
            unit = np.zeros((len(self._scale), len(block)))
            unit[first + block, block - k] = 1.0
            diagonal[block] = self._solve(unit)[first + block, block - k]
        return diagonal

    def _solve(self, b: np.ndarray) -> np.ndarray:
        scale = self._scale.reshape(-1, *(1,) * (b.ndim - 1))
        b = scale * b
        scaled = self._lu.solve(b)
        scaled = scaled + self._lu.solve(b - self._tableau @ scaled)  # one refinement: information is a difference
        solution: np.ndarray = scale * scaled
        return solution


def build_tableau(above: np.ndarray, H: sp.csr_array, below: np.ndarray) -> sp.csc_array:
    """``[[diag(above), H], [H', diag(below)]]``."""
    n_meas, n_state = H.shape
    diagonal = np.arange(n_meas + n_state)
    row, column = _row_of_entries(H), n_meas + H.indices
    return sp.coo_array(
        (
            np.concatenate([above, below, H.data, H.data]),
            (np.concatenate([diagonal, row, column]), np.concatenate([diagonal, column, row])),
        ),
        shape=(len(diagonal), len(diagonal)),
    ).tocsc()


def reciprocal_row_lengths(H: sp.csr_array) -> np.ndarray:
    """1 / Euclidean length of each row; 1 for an empty one."""
    return _reciprocal(np.bincount(_row_of_entries(H), H.data**2, H.shape[0]))


def scale_rows(H: sp.csr_array, scale: np.ndarray) -> sp.csr_array:
    """``diag(scale) H``."""
    return sp.csr_array((H.data * scale[_row_of_entries(H)], H.indices, H.indptr), shape=H.shape)


def _row_of_entries(H: sp.csr_array) -> np.ndarray:
    return np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))


def _reciprocal(square: np.ndarray) -> np.ndarray:
    length = np.sqrt(square)
    return 1 / np.where(length > 0, length, 1.0)
