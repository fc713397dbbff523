"""The measurements of one area as functions of its state, the power into neighbouring areas included."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import scipy.sparse as sp

from dsse_core.admittance import build_admittance
from dsse_core.area_tree import AreaTree, find_no_tree
from dsse_core.boundary_information import EXACT_SIGMA
from dsse_core.dense_rows import DenseRows
from dsse_core.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.partition import Area, Neighbour

Backend = Literal["auto", "tree", "sparse", "dense"]
Matrix: TypeAlias = sp.csr_array | np.ndarray
TREE_FROM = 60  # buses of an area, from which the tree repays the loading of numba
PRIOR_SIGMA = 0.3  # p.u. and rad: a voltage lies that near to what it was, whatever happens
DENSE_BELOW = 40  # buses of an area, below which dense matrices cost less than sparse ones
_POWER = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)


@dataclass(frozen=True)
class AreaModel:
    """The measurements of one area as functions of ``x = [va; vm; p_1, q_1, p_2, q_2, ...]``, one pair per child.

    ``free``: the variables that are unknown, all but a reference angle. ``no_load``: the weights say nothing of how
    well powers and voltages are known. ``backend``: "tree" takes the tree wherever there is one, "auto" from
    TREE_FROM buses on, and dense matrices below DENSE_BELOW.
    ``prior``: a state, shape (size,), whose voltages count as measured with PRIOR_SIGMA, where neighbours or readings
    are missing; the tree cannot serve then.
    """

    area: Area
    model: MeasurementModel
    into_children: sp.csr_array  # (n_meas, 2 n_child): 1 where an injection meter counts a child's power
    into_area: MeasurementModel | None  # P and Q from the parent's bus into the area's own branches
    z: np.ndarray
    sigma: np.ndarray
    free: np.ndarray
    meters: tuple[Meter, ...]
    reference: int | None
    no_load: bool = False
    backend: Backend = "auto"
    prior: np.ndarray | None = None

    @cached_property
    def virtual(self) -> np.ndarray:
        """Which measurements are virtual, shape (n_meas,)."""
        return np.array([meter.source is Source.VIRTUAL for meter in self.meters], dtype=bool)

    @property
    def size(self) -> int:
        return 2 * self._n + int(self.into_children.shape[1])

    @property
    def _n(self) -> int:
        return len(self.area.network.buses)

    @cached_property
    def tree(self) -> AreaTree | None:
        """Its measurements on the tree of its buses, if that is the back end; without it the exchange is sparse."""
        if self.no_load or self.prior is not None or choose_backend(self.area, self.backend) != "tree":
            return None
        return AreaTree(self.area, self.meters, self.z, self.sigma, self.reference)

    @cached_property
    def dense(self) -> DenseRows | None:
        """Its rows in dense arrays, if that is the back end."""
        if choose_backend(self.area, self.backend) != "dense":
            return None
        columns = [column for n in self._boundaries for column in self.boundary_columns(n)]
        return DenseRows(self.model, self.into_children, self.into_area, columns)

    @cached_property
    def _boundaries(self) -> list[Neighbour]:
        """As dense rows have them, the parent's first."""
        return sorted(self.area.neighbours, key=lambda n: not n.is_parent)

    @cached_property
    def _place(self) -> dict[str, int]:
        """Of each neighbour among the boundaries."""
        return {n.area: k for k, n in enumerate(self._boundaries)}

    def with_readings(self, measurements: Sequence[Measurement]) -> AreaModel:
        """The same meters, read anew: what rests on topology and meters is kept."""
        other = copy.copy(self)  # with all that is cached
        sigma = _sigmas_of(measurements)
        other.__dict__.update(z=_values_of(measurements), sigma=self.sigma if (sigma == self.sigma).all() else sigma)
        if (tree := self.__dict__.get("tree")) is not None:
            other.__dict__.update(tree=tree.with_readings(other.z, other.sigma))
        return other

    @property
    def kinds(self) -> np.ndarray:
        return self.model.kinds

    @cached_property
    def angles(self) -> np.ndarray:
        """Rows of angle meters."""
        return np.flatnonzero(self.kinds == MeasurementKind.VA)

    @cached_property
    def degrees(self) -> np.ndarray:
        """The power k for which h grows as c^k when all voltages grow by c, shape (n_meas,)."""
        once = np.isin(self.kinds, (MeasurementKind.VM, MeasurementKind.CURRENT))
        return np.where(once, 1.0, np.where(self.kinds == MeasurementKind.VA, 0.0, 2.0))

    @cached_property
    def eliminated(self) -> dict[str, np.ndarray]:
        """Neighbour -> the ``free`` variables but the voltage at the boundary to it."""
        return {n.area: self.free[~np.isin(self.free, self.voltage_columns(n))] for n in self.area.neighbours}

    @cached_property
    def fixed(self) -> np.ndarray:
        """The variables that are not ``free``."""
        return np.setdiff1d(np.arange(self.size), self.free)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), shape (n_meas,)."""
        if self.dense:
            return self.dense.linearize(x)[0]
        return np.asarray(self.model.predict(x[: 2 * self._n]) + self.into_children @ x[2 * self._n :])

    def residual(self, x: np.ndarray) -> np.ndarray:
        """z - h(x), shape (n_meas,); angles wrapped to (-pi, pi]."""
        return self.model.subtract(self.z, self.predict(x))

    def jacobian(self, x: np.ndarray) -> Matrix:
        """H(x), shape (n_meas, size)."""
        if self.dense:
            return self.dense.linearize(x)[1]
        return sp.csr_array(sp.hstack([self.model.jacobian(x[: 2 * self._n]), self.into_children], format="csr"))

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, Matrix]:
        """y, shape (4,), and T = dy/dx, shape (4, size), at the boundary to ``neighbour``."""
        if self.dense:
            return self.dense.linearize_boundary(x, self._place[neighbour.area])
        columns = self.boundary_columns(neighbour)
        if not neighbour.is_parent:
            return x[columns], self._select(columns)
        assert self.into_area is not None  # there is a parent
        flows = self.into_area.predict(x[: 2 * self._n])
        C = sp.csr_array(self.into_area.jacobian(x[: 2 * self._n]))
        C = sp.csr_array((C.data, C.indices, C.indptr), shape=(2, self.size))
        T = sp.vstack([C, self._select(columns)], format="csr")
        return np.concatenate([flows, x[columns]]), sp.csr_array(T)

    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        """y of ``boundary`` alone."""
        if self.dense:
            return self.dense.linearize_boundary(x, self._place[neighbour.area])[0]
        if not neighbour.is_parent:
            return np.asarray(x[self.boundary_columns(neighbour)])
        bus, there, own, mutual = self._branches_at_parent
        va, vm = x[there], x[self._n + there]
        v = float(x[self._n + bus])
        s = (own * v * v).sum() + (mutual * (v * vm * np.exp(1j * (x[bus] - va)))).sum()
        return np.array([s.real, s.imag, v, x[bus]])

    @cached_property
    def _branches_at_parent(self) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        """Row of the parent's bus; of the branches there: row of the other end, conj of own and mutual admittance."""
        assert self.area.parent is not None
        assert self.into_area is not None
        bus = self.area.network.row[self.area.parent.bus]
        y = self.into_area.y[[0], :].tocoo()
        columns, values = y.coords[1], y.data.conj()
        at_bus = columns == bus
        return bus, columns[~at_bus], values[at_bus], values[~at_bus]

    def voltage_columns(self, neighbour: Neighbour) -> list[int]:
        row = self.area.network.row[neighbour.bus]
        return [self._n + row, row]

    def boundary_columns(self, neighbour: Neighbour) -> list[int]:
        """Where x has y of the boundary to a child; to the parent its voltage alone, as the power is none of x."""
        if neighbour.is_parent:
            return self.voltage_columns(neighbour)
        first = self._first_power[neighbour.area]
        return [first, first + 1, *self.voltage_columns(neighbour)]

    @cached_property
    def _first_power(self) -> dict[str, int]:
        children = [n.area for n in self.area.neighbours if not n.is_parent]
        return {area: 2 * (self._n + k) for k, area in enumerate(children)}

    def _select(self, columns: Sequence[int]) -> sp.csr_array:
        shape = (len(columns), self.size)
        return sp.csr_array((np.ones(len(columns)), np.array(columns), np.arange(len(columns) + 1)), shape=shape)


def choose_backend(area: Area, backend: Backend = "auto") -> Literal["tree", "sparse", "dense"]:
    """What computes the exchange of ``area`` if ``backend`` is asked for; the tree, for which numba is loaded, where
    it can serve.
    """
    n_bus = len(area.network.buses)
    if backend == "tree" or (backend == "auto" and n_bus >= TREE_FROM):
        return "sparse" if find_no_tree(area.network) else "tree"
    return "dense" if backend == "dense" or (backend == "auto" and n_bus < DENSE_BELOW) else "sparse"


def build_area_model(
    area: Area,
    measurements: Sequence[Measurement],
    reference: int | None,
    *,
    with_shunts: bool = True,
    backend: Backend = "auto",
) -> AreaModel:
    """The model of ``area``'s own ``measurements``.

    Args:
        reference: bus of the grid's angle reference, if the area sees it.
        with_shunts: whether shunts and line charging are there; without them no power flows at the flat start.
    """
    network = area.network
    admittance = build_admittance(network, with_shunts=with_shunts)
    children = [n for n in area.neighbours if not n.is_parent]
    rows, columns = [], []
    for row, m in enumerate(measurements):
        for k, child in enumerate(children):
            if m.meter.kind.of_injection and m.meter.bus == child.bus:
                rows.append(row)
                columns.append(2 * k + (m.meter.kind is MeasurementKind.Q_INJECTION))
    shape = (len(measurements), 2 * len(children))
    size = 2 * len(network.buses) + shape[1]
    fixed = [] if reference is None else [network.row[reference]]
    at_parent = [Meter(k, area.parent.bus) for k in _POWER] if area.parent else []
    return AreaModel(
        area=area,
        model=build_measurement_model(network, admittance, [m.meter for m in measurements]),
        into_children=sp.csr_array(sp.coo_array((np.ones(len(rows)), (rows, columns)), shape=shape)),
        into_area=build_measurement_model(network, admittance, at_parent) if at_parent else None,
        z=_values_of(measurements),
        sigma=_sigmas_of(measurements),
        free=np.delete(np.arange(size), fixed),
        meters=tuple(m.meter for m in measurements),
        reference=reference,
        backend=backend,
    )


def _values_of(measurements: Sequence[Measurement]) -> np.ndarray:
    return np.array([m.value for m in measurements], dtype=float)


def _sigmas_of(measurements: Sequence[Measurement]) -> np.ndarray:
    sigmas = [EXACT_SIGMA if m.meter.source is Source.VIRTUAL else m.sigma for m in measurements]
    return np.array(sigmas, dtype=float)
