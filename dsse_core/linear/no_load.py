"""The numbers of an area at no load, where weights say nothing of how well powers and voltages are known."""

from __future__ import annotations

import numpy as np

from dsse_core.linear.interface import Factor, Heard, Matrix
from dsse_core.linear.rows import RowSolver

NO_LOAD_NOT_YET = 1e-18  # information given to what nothing determines, relative to what rows tell where less than 1
DRAWS = 32  # of which the mean square is a fifth of its expectation with a probability of 1e-7
NOTHING = 1e-30  # for variables that no row speaks of


class NoLoadSolver(RowSolver):
    """Undetermined variables are damped next to nothing, so that they stand out."""

    nothing_of_voltage = 0.0

    def factor(self, H: Matrix, sigma: np.ndarray, columns: np.ndarray) -> Factor:
        """An angle meter must not seem to tell a magnitude: undetermined variables would be damped by 1e22 times less
        than others, and beside such an uncertainty whatever else is known of (p, q) drowns.
        """
        H = self.rows.without_rounding(H[:, columns])
        told = np.asarray((H * H).T @ sigma**-2.0)
        return self.rows.factor(H, sigma, np.where(told > 0, NO_LOAD_NOT_YET * np.minimum(told, 1.0), NOTHING))

    def sample_redundancy(self, x: np.ndarray, heard: Heard, rng: np.random.Generator) -> np.ndarray:
        """diag(Omega) / sigma^2 of the area's own measurements, shape (n_meas,), from residuals of random readings.

        With S = Omega / (sigma sigma') a projection, readings of variance 1 leave residuals of variance S_ii: as the
        mean square of DRAWS of them it is found to a factor of two or so, and 0 to the square of round-off.
        """
        H, _, sigma = self.stack(x, heard)
        free, model = self.model.free, self.model
        readings = sigma[:, None] * rng.standard_normal((len(sigma), DRAWS))
        s = self.factor(H, sigma, free).solve(readings, np.zeros((len(free), DRAWS)))[0][: len(model.z)]
        return np.asarray(((model.sigma[:, None] * s) ** 2).mean(axis=1))
