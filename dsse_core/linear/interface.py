"""Interface of an area's linear solver and of its rows. Callers never depend on the back end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from typing import Self, TypeAlias

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import BoundaryInformation

Matrix: TypeAlias = sp.csr_array | np.ndarray
Received: TypeAlias = Mapping[str, BoundaryInformation]
NOT_YET = 1e-6  # information given to eliminated voltages that nothing determines yet
NOT_YET_OF_POWER = 1e-11  # the same of powers, which may be large


class LinearArea(ABC):
    """The linearised area at a state x, shape (size,), with the information ``received`` of its neighbours.

    ``name``: name of the back end. ``declined``: number of calls that another back end had to take, by reason.
    """

    name: str
    declined: Counter[str]

    def prepare(self, x: np.ndarray) -> None:  # noqa: B027  nothing, where all needs messages
        """Computes, while a message is awaited, the part at ``x`` that needs none."""

    @abstractmethod
    def step(self, x: np.ndarray, received: Received, damping: float = 0.0) -> np.ndarray:
        """The Gauss-Newton step, shape (size,), ``(G + damping) dx = b``: of the grid, if ``received`` is complete."""

    @abstractmethod
    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        """Information for ``neighbour``: every variable but y eliminated, the neighbour's own message left out."""

    @abstractmethod
    def variances(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, np.ndarray]:
        """diag(G^-1), shape (size,), and diag(Omega) of the area's own measurements, shape (n_meas,) (eq. 3.22), 0 for
        virtual ones.
        """

    @abstractmethod
    def covariance(self, x: np.ndarray, received: Received, B: np.ndarray) -> np.ndarray:
        """``B G^-1 B'``, (k, k): covariance of k linear functions of the state, the rows of ``B``, (k, size)."""

    @abstractmethod
    def with_readings(self, model: AreaMeasurements) -> Self:
        """Solver for ``model``, which has new readings of the same meters; keeps the parts that rest on meters only."""


class Rows(ABC):
    """h(x) and H(x) of an area's meters and boundaries, and operations on matrices of their kind."""

    @abstractmethod
    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), shape (n_meas,)."""

    @abstractmethod
    def jacobian(self, x: np.ndarray) -> Matrix:
        """H(x), shape (n_meas, size)."""

    @abstractmethod
    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, Matrix]:
        """y, shape (d,), and T = dy/dx, shape (d, size), at the boundary to ``neighbour``."""

    @abstractmethod
    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        """y of ``boundary`` alone."""

    @abstractmethod
    def messages(self, x: np.ndarray, received: Received) -> tuple[list[Matrix], list[np.ndarray]]:
        """Rows R T and residuals z - R y of the messages ``received``, of variance 1, in the order of neighbours."""

    @abstractmethod
    def take(self, H: sp.csr_array) -> Matrix:
        """Further rows, as a matrix of this kind."""

    @abstractmethod
    def join(self, parts: list[Matrix]) -> Matrix:
        """The rows of ``parts`` below each other."""
