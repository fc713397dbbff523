"""h(x) and H(x) of a small area in dense arrays, those of its boundaries included."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from dsse_core.measurement_model import MeasurementModel, stack_models


class DenseRows:
    """The rows of ``model``, then the four of each boundary's y.

    ``into_children`` (n_meas, 2 n_child) adds a child's power to the meters that count it. ``into_area``: P and Q into
    the area's own branches, the first two rows of the parent's boundary, if there is a parent. ``picked``: what all
    other rows of boundaries say, in their order, each the variable in this place of x.
    """

    def __init__(
        self,
        model: MeasurementModel,
        into_children: sp.csr_array,
        into_area: MeasurementModel | None,
        picked: Sequence[int],
    ) -> None:
        self._n_meas, self._n = model.y.shape
        self._rows = model if into_area is None else stack_models(model, into_area)
        self._y = self._rows.y.toarray()
        self._each = np.arange(len(self._y))
        self._into_children = into_children.toarray()
        self._picked = np.array(picked, dtype=int)
        n_computed, size = len(self._y), 2 * self._n + self._into_children.shape[1]
        self._h = np.zeros(n_computed + len(picked))
        self._H = np.zeros((len(self._h), size))
        self._H[: self._n_meas, 2 * self._n :] = self._into_children
        self._H[n_computed + np.arange(len(picked)), self._picked] = 1.0
        self._at = b""  # the x of h and H

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h(x), shape (n_meas,), and H(x), shape (n_meas, size), of the meters; not to be changed."""
        self._move_to(x)
        return self._h[: self._n_meas], self._H[: self._n_meas]

    def linearize_boundary(self, x: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """y, shape (4,), and dy/dx, shape (4, size), of boundary number ``k``; not to be changed."""
        self._move_to(x)
        first = self._n_meas + 4 * k
        return self._h[first : first + 4], self._H[first : first + 4]

    def _move_to(self, x: np.ndarray) -> None:
        """Have h and H of ``x``: steps, messages and variances ask for those of one state in turn."""
        if (at := x.tobytes()) == self._at:
            return
        n, m, computed = self._n, self._n_meas, slice(len(self._y))
        vm, phase = x[n : 2 * n], np.exp(1j * x[:n])
        v = vm * phase
        u, i = v[self._rows.bus_row], self._y @ v
        of_u, of_i = self._rows.weigh(u, i)
        along = of_i[:, None] * self._y  # see MeasurementModel.linearize
        along[self._each, self._rows.bus_row] += of_u
        along *= phase
        h, H = self._h.copy(), self._H.copy()  # what was given away stays as it is
        h[computed], h[len(self._y) :] = self._rows.read(u, i), x[self._picked]
        h[:m] += self._into_children @ x[2 * n :]
        H[computed, :n], H[computed, n : 2 * n] = along.imag * -vm, along.real
        self._h, self._H, self._at = h, H, at
