"""Contributions of measurements and further rows to an area at a state x_k, the same for all back ends."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.sparse as sp

PRIOR_SIGMA = 0.3  # p.u. and rad: standard deviation of a voltage from its last value, whatever happens


class Contribution(NamedTuple):
    """Contribution of each measurement, (n_meas,): the step minimises ``sum weight (residual + shift - H dx)^2``."""

    residual: np.ndarray
    weight: np.ndarray
    shift: np.ndarray


Method: TypeAlias = Callable[[np.ndarray, np.ndarray], Contribution]
"""The contribution that follows from residuals z - h(x_k) and sigmas, (n_meas,) each."""


def least_squares(residual: np.ndarray, sigma: np.ndarray) -> Contribution:
    """Weights 1 / sigma^2, whatever the residual."""
    return Contribution(residual, sigma**-2.0, np.zeros(len(sigma)))


class RowsAt(NamedTuple):
    """Rows at a state: ``H`` (k, size), ``residual`` (k,), ``sigma`` (k,).

    ``response`` (k, 2): derivatives of the rows' readings where all voltages of the area grow by a share, and where all
    angles turn, the reference included.
    """

    H: sp.csr_array
    residual: np.ndarray
    sigma: np.ndarray
    response: np.ndarray


class FurtherRows(ABC):
    """Rows of an area beside those of its meters; they have no part in J, degrees of freedom or bad data.

    ``couples_many``: a row reads many buses. Elimination on a tree cannot take such rows, and sparse matrices would
    fill in; they need dense rows.
    """

    couples_many = False

    @abstractmethod
    def at(self, x: np.ndarray) -> RowsAt:
        """The rows at the state ``x``, (size,)."""


@dataclass(frozen=True, eq=False)
class VoltageReadings(FurtherRows):
    """Readings ``z`` of voltages: angles, then magnitudes, (2 n_nodes,), such as the state before.

    ``there``: True for the voltages that are read, (2 n_nodes,); None for all.
    """

    z: np.ndarray
    sigma: float = PRIOR_SIGMA
    there: np.ndarray | None = None

    def at(self, x: np.ndarray) -> RowsAt:
        k, n = len(self.z), len(self.z) // 2
        response = np.zeros((k, 2))
        response[:n, 1], response[n:, 0] = 1.0, x[n:k]
        H = sp.csr_array(sp.eye_array(k, len(x), format="csr"))
        rows = np.arange(k) if self.there is None else np.flatnonzero(self.there)
        return RowsAt(H[rows], (self.z - x[:k])[rows], np.full(len(rows), self.sigma), response[rows])

    @property
    def weight(self) -> np.ndarray:
        """1 / sigma^2 of each voltage, (2 n_nodes,), 0 where it is not read."""
        there = np.ones(len(self.z), dtype=bool) if self.there is None else self.there
        return there / self.sigma**2


@dataclass(frozen=True, eq=False)
class CoupledRows(FurtherRows):
    """Rows that couple many buses, such as a prior on injections with all covariances."""

    find: Callable[[np.ndarray], RowsAt]
    couples_many = True

    def at(self, x: np.ndarray) -> RowsAt:
        return self.find(x)
