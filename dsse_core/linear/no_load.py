"""Numerics of an area at no load, where weights say nothing about the accuracy of powers and voltages."""

from __future__ import annotations

import numpy as np

from dsse_core.grid.boundary import Boundary
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import EXACT_SIGMA, BoundaryInformation
from dsse_core.linear.dense import DenseRows
from dsse_core.linear.interface import Matrix, Received
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows
from dsse_core.matrices.augmented import AugmentedFactor

NO_LOAD_NOT_YET = 1e-18  # damping of undetermined variables, relative to the information of rows where less than 1
DRAWS = 32  # the mean square of so many is below a fifth of its expectation with a probability of 1e-7
# Size of a block of draws. One block is enough for variances of states: with a probability of 1e-7 their mean square is
# below a hundredth of its expectation, or above six times that. Known and unknown states are six powers of ten apart.
DRAWS_AT_ONCE = 8
NOTHING = 1e-30  # damping of variables without an entry in any row


class NoLoadSolver(TableauSolver):
    """Solver that damps undetermined variables next to nothing, so that they stand out.

    The solver works on sparse matrices, where 0 stays 0. In a dense factor rounding fills in more than the damping at a
    busbar of 1e-6 p.u., as it does where large pivots are taken from the leaves of a tree to its root.
    """

    nothing_of_voltage = 0.0

    def __init__(self, model: AreaMeasurements, rows: SparseRows, name: str) -> None:
        super().__init__(model, rows, name)
        self._by_reflections: NoLoadReflections | None = None

    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        """See ``LinearArea``; for a boundary at several buses found by reflections, powers given the voltages first."""
        if self.model.boundary_of(neighbour).is_single:
            return super().information(x, neighbour, received)
        if self._by_reflections is None:
            self._by_reflections = NoLoadReflections(self.model, DenseRows(self.model), self.name)
        return self._by_reflections.information(x, neighbour, received)

    def factor(self, H: Matrix, sigma: np.ndarray, columns: np.ndarray) -> AugmentedFactor:
        H, damping = self._damp(H, sigma, columns)
        return self.rows.factor(H, sigma, damping)

    def _damp(self, H: Matrix, sigma: np.ndarray, columns: np.ndarray) -> tuple[Matrix, np.ndarray]:
        """The ``columns`` of H without rounding, and their damping.

        Rounding would make an angle meter seem to measure a magnitude. Undetermined variables would then be damped by
        1e22 times less than others, and beside such an uncertainty all other information about (p, q) drowns.
        """
        H = self.rows.without_rounding(H[:, columns])
        weight = np.asarray((H * H).T @ sigma**-2.0)
        return H, np.where(weight > 0, NO_LOAD_NOT_YET * np.minimum(weight, 1.0), NOTHING)

    def sample(
        self, x: np.ndarray, received: Received, rng: np.random.Generator, enough: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """diag(G^-1), shape (size,), to a power of ten, and diag(Omega) / sigma^2 of the area's own measurements,
        shape (n_meas,), to a factor of two or so. Both follow from random readings on one factor, without its inverse.

        With S = Omega / (sigma sigma') a projection, readings of variance 1 leave residuals of variance S_ii, here the
        mean square of DRAWS of them, and 0 to the square of round-off. With random readings of the damping, too, the
        states that follow have the covariance G^-1.

        ``enough``: drawing ends where the draws so far leave every measurement at least that, even if all others left
        nothing. So the measurements below ``enough`` are the same as with all draws.
        """
        H, _, sigma = self.stack(x, received)
        free, model = self.model.free, self.model
        H, damping = self._damp(H, sigma, free)
        factor = self.rows.factor(H, sigma, damping)
        nothing, squares = np.zeros((len(free), DRAWS_AT_ONCE)), np.zeros(len(model.z))
        variance = np.zeros(model.size)
        for drawn in range(0, DRAWS, DRAWS_AT_ONCE):
            above = sigma[:, None] * rng.standard_normal((len(sigma), DRAWS_AT_ONCE))
            s, _ = factor.solve(above, nothing)
            squares += ((model.sigma[:, None] * s[: len(model.z)]) ** 2).sum(axis=1)
            if not drawn:
                _, dx = factor.solve(above, np.sqrt(damping)[:, None] * rng.standard_normal(nothing.shape))
                variance[free] = (dx**2).mean(axis=1)
            if (squares >= DRAWS * enough).all():
                break
        return variance, squares / DRAWS


class NoLoadReflections(ReducedSolver):
    """Information without load about the variables of a boundary at several buses."""

    def least_information(self, columns: np.ndarray) -> np.ndarray:
        """The damping of ``NoLoadSolver``; of powers times their weight in a power meter, 1 at most."""
        of_power = min(1.0, self._sigma_of_power**-2)
        of_voltage = columns < 2 * len(self.model.area.network.buses)
        return NO_LOAD_NOT_YET * np.where(of_voltage, 1.0, of_power)

    def tied_sigma(self, boundary: Boundary) -> float:
        """Sigma of rows that tie powers to voltages: EXACT_SIGMA in units of the sigma of power meters."""
        return EXACT_SIGMA * self._sigma_of_power

    @property
    def _sigma_of_power(self) -> float:
        """Sigma that all power meters have without load, 1 at least."""
        return float(self.model.sigma.max(initial=1.0))
