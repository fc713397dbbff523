"""Back end for small areas: h(x) and H(x) in dense arrays, those of the boundaries included."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.further_currents import add_up
from dsse_core.grid.measurement_model import stack_models
from dsse_core.grid.meter_table import average
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.interface import Matrix, Received, Rows


class DenseRows(Rows):
    """The rows of the meters, then those of P and Q into the area's own branches, then those of the other variables of
    boundaries, which read one variable of x each.
    """

    def __init__(self, area: AreaMeasurements) -> None:
        model, into_area, into_children = area.model, area.into_area, area.into_children
        self._neighbours = area.area.neighbours
        picked: list[int] = []
        self._place: dict[str, np.ndarray | slice] = {}
        first, n_into_area = len(model.kinds), 0 if into_area is None else len(into_area.kinds)
        for n in sorted(self._neighbours, key=lambda n: not n.is_parent):
            own, rows = area.own_powers[n.area]
            columns, places = area.boundary_columns(n), np.arange(area.boundary_of(n).d)
            others = np.setdiff1d(places, own)
            places[own] = first + np.arange(rows.start, rows.stop)
            places[others] = first + n_into_area + len(picked) + np.arange(len(columns))
            picked += columns
            is_run = (np.diff(places) == 1).all()
            self._place[n.area] = slice(int(places[0]), int(places[-1]) + 1) if is_run else places
        self._n_meas, self._n = len(model.kinds), model.y.shape[1]
        self._rows = model if into_area is None else stack_models(model, into_area)
        self._y = self._rows.y.toarray()
        self._each = np.arange(len(self._y))
        self._into_children = into_children.toarray()
        self._picked = np.array(picked, dtype=int)
        n_computed, size = len(self._rows.kinds), 2 * self._n + self._into_children.shape[1]
        self._h = np.zeros(n_computed + len(picked))
        self._H = np.zeros((len(self._h), size))
        self._H[: self._n_meas, 2 * self._n :] = self._into_children
        self._H[n_computed + np.arange(len(picked)), self._picked] = 1.0
        self._own = self._h[:n_computed]  # h of the model alone
        self._n_read = size if self._rows.further else 2 * self._n  # of x, by the model
        self._at = self._read_at = b""  # the x of h, and of H

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        return self._h[: self._n_meas]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        return self._H[: self._n_meas]

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, np.ndarray]:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        place = self._place[neighbour.area]
        return self._h[place], self._H[place]

    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        return self.boundary(x, neighbour)[0]

    def messages(self, x: np.ndarray, received: Received) -> tuple[list[Matrix], list[np.ndarray]]:
        found = [(*received[n.area].rows, *self.boundary(x, n)) for n in self._neighbours if n.area in received]
        return [R @ T for R, _, _, T in found], [z - R @ y for R, z, y, _ in found]

    def take(self, H: sp.csr_array) -> np.ndarray:
        return np.asarray(H.toarray())

    def join(self, parts: list[Matrix]) -> np.ndarray:
        return np.concatenate(parts)

    def _move_to(self, x: np.ndarray) -> None:
        """Computes h and H at ``x``, once for each state: steps, messages and variances ask for them in turn."""
        if (at := x.tobytes()) == self._at:
            return
        n, m = self._n, self._n_meas
        if (read_at := x[: self._n_read].tobytes()) != self._read_at:
            self._move_model_to(x)
            self._read_at = read_at
        h = np.concatenate([self._own, x[self._picked]])  # a new array, as callers keep the former one
        h[:m] += self._into_children @ x[2 * n :]
        self._h, self._at = h, at

    def _move_model_to(self, x: np.ndarray) -> None:
        n, model, computed = self._n, self._rows, slice(len(self._rows.kinds))
        vm, phase = x[n : 2 * n], np.exp(1j * x[:n])
        v = vm * phase
        u, i = model.find_voltages(v), add_up(self._y @ v, model.further, x, v)
        of_u, of_i = model.weigh(u, i)
        along = of_i[:, None] * self._y  # see MeasurementModel.linearize
        along[self._each, model.node] += of_u
        if (other := model.other) is not None:
            along[self._each[other >= 0], other[other >= 0]] -= of_u[other >= 0]
        along *= phase
        along = average(along, model.of_meter)
        self._own, self._H = average(model.read(u, i), model.of_meter), self._H.copy()
        self._H[computed, :n], self._H[computed, n : 2 * n] = along.imag * -vm, along.real
        if model.further:
            self._H[computed, 2 * n :] = 0.0
            self._H[: self._n_meas, 2 * n :] = self._into_children
        for currents in model.further:
            entries = currents.find_derivatives(x, v, of_i) * model.shares[currents.row]
            np.add.at(self._H, (model.meters[currents.row], currents.list_columns(n)), entries)
