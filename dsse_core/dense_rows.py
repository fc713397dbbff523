"""h(x) and H(x) of a small area in dense arrays, the power into neighbouring areas included."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.measurement_model import MeasurementModel, stack_models


class DenseRows:
    """The rows of ``model``, then those of ``into_area`` (P and Q into the area's own branches), if there is a parent.

    ``into_children`` (n_meas, 2 n_child) adds a child's power to the meters that count it.
    """

    def __init__(
        self, model: MeasurementModel, into_children: sp.csr_array, into_area: MeasurementModel | None
    ) -> None:
        self._n_meas, self._n = model.y.shape
        self._rows = model if into_area is None else stack_models(model, into_area)
        self._y = self._rows.y.toarray()
        self._at_bus = np.zeros(self._y.shape)
        self._at_bus[np.arange(len(self._y)), self._rows.bus_row] = 1.0
        self._into_children = into_children.toarray()
        self._x = np.full(2 * self._n + self._into_children.shape[1], np.nan)  # what h and H are of
        self._h = np.zeros(len(self._y))
        self._H = np.zeros((len(self._y), len(self._x)))

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h(x), shape (n_meas,), and H(x), shape (n_meas, size), of the meters; not to be changed."""
        self._move_to(x)
        return self._h[: self._n_meas], self._H[: self._n_meas]

    def linearize_into_area(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P and Q into the area's own branches, shape (2,), and their derivatives, shape (2, size)."""
        self._move_to(x)
        return self._h[self._n_meas :], self._H[self._n_meas :]

    def _move_to(self, x: np.ndarray) -> None:
        """Have h and H of ``x``: steps, messages and variances ask for those of one state in turn."""
        if np.array_equal(x, self._x):
            return
        n, m = self._n, self._n_meas
        vm, phase = x[n : 2 * n], np.exp(1j * x[:n])
        v = vm * phase
        u, i = v[self._rows.bus_row], self._y @ v
        of_u, of_i = self._rows.weigh(u, i)
        along = (of_u[:, None] * self._at_bus + of_i[:, None] * self._y) * phase  # see MeasurementModel.linearize
        self._h = self._rows.read(u, i)
        self._h[:m] += self._into_children @ x[2 * n :]
        self._H = np.zeros((len(self._y), len(x)))
        self._H[:, :n], self._H[:, n : 2 * n], self._H[:m, 2 * n :] = along.imag * -vm, along.real, self._into_children
        self._x = x.copy()
