"""Numerics of an area at no load, where weights say nothing about the accuracy of powers and voltages."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.boundary import Boundary
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import ROUNDING, BoundaryInformation, invert_root
from dsse_core.linear.choose import make_rows
from dsse_core.linear.interface import Received
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.rows import RowSolver, TableauSolver
from dsse_core.linear.sparse import SparseRows
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern

NO_LOAD_NOT_YET = 1e-18  # information given to undetermined variables, in units of the meters'


class _AtNoLoad(RowSolver):
    """Solver that damps undetermined variables next to nothing, so that they stand out.

    ``sigma_of_power``: that of all power meters without load.
    """

    sigma_of_power: float

    def least_information(self, columns: np.ndarray) -> np.ndarray:
        """NO_LOAD_NOT_YET; of powers times their weight in a power meter."""
        return NO_LOAD_NOT_YET * np.where(self.model.are_powers[columns], self.sigma_of_power**-2, 1.0)


class NoLoadSolver(_AtNoLoad, TableauSolver):
    """Solver on sparse matrices, where 0 stays 0.

    In a dense factor rounding fills in more than the damping at a busbar of 1e-6 p.u., as it does where large pivots
    are taken from the leaves of a tree to its root.
    """

    nothing_of_voltage = 0.0

    def __init__(self, model: AreaMeasurements, sigma_of_power: float) -> None:
        super().__init__(model, SparseRows(model), "no load")
        self.sigma_of_power = sigma_of_power
        self._by_reflections: NoLoadReflections | None = None

    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        """See ``LinearArea``; for a boundary at several buses found by reflections, powers given the voltages first."""
        if self.model.boundary_of(neighbour).is_single:
            return super().information(x, neighbour, received)
        if self._by_reflections is None:
            self._by_reflections = NoLoadReflections(self.model, self.sigma_of_power)
        return self._by_reflections.information(x, neighbour, received)

    def factor(self, H: sp.csr_array, sigma: np.ndarray, columns: np.ndarray) -> AugmentedFactor:
        """Factor without rounding in H, by which an angle meter would seem to measure a magnitude."""
        exact = _without_rounding(H[:, columns])
        pattern = AugmentedPattern(exact, careful=True)
        return AugmentedFactor(exact, sigma, self.least_information(columns), pattern, no_rounding=True)

    def weigh_power(
        self, factor: AugmentedFactor, combinations: np.ndarray, A: np.ndarray, du: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See ``TableauSolver``; by a root F of ``S = F'F``, a sum of squares in which what is known does not drown.

        With readings exact rows have a variance of next to 0, and the columns of F differ by less than its rounding.
        """
        F = factor.root_of_covariance(A, du)
        return F.T @ F, np.linalg.svd(F, full_matrices=False)[2].T, invert_root(F)


class NoLoadReflections(_AtNoLoad, ReducedSolver):
    """Information without load about the variables of a boundary at several buses."""

    def __init__(self, model: AreaMeasurements, sigma_of_power: float) -> None:
        self.sigma_of_power = sigma_of_power
        super().__init__(model, make_rows(model), "no load")

    def tied_sigma(self, boundary: Boundary) -> float:
        """Sigma of rows that tie powers to voltages: EXACT_SIGMA in units of the sigma of power meters."""
        return self.sigma_of_power


def _without_rounding(H: sp.csr_array) -> sp.csr_array:
    """H with entries of 0 where a derivative is only rounding."""
    row = np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))
    size, largest = abs(H.data), np.zeros(H.shape[0])
    np.maximum.at(largest, row, size)
    return sp.csr_array((np.where(size > ROUNDING * largest[row], H.data, 0.0), H.indices, H.indptr), shape=H.shape)
