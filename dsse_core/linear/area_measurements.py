"""Measurements and variables of one area: the input of its back ends."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Self

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.boundary import Boundary, Kind, Variable
from dsse_core.grid.measurement import Meter, Source
from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.meter_table import DEGREE, IS_OF_PHASOR, QUANTITY, find_virtual
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.grid.quantities import Quantity
from dsse_core.linear.contributions import Contribution, FurtherRows, Method, least_squares

NO_ROWS = np.zeros(0, dtype=np.int64)
Backend = Literal["auto", "radial", "sparse", "dense", "pieces"]


@dataclass(frozen=True)
class AreaMeasurements:
    """The measurements of one area as functions of x, ``Area.join_state``.

    ``free``: the variables that are unknown, all but the angles of a reference bus. ``backend``: see
    ``linear.choose_backend``. ``method``: the weights that follow from residuals and sigmas. ``further``: rows beside
    those of the meters, such as voltages that count as read where neighbours or readings are missing. ``held_back``:
    rows of measurements that do not count yet.
    """

    area: Area
    model: MeasurementModel
    into_children: sp.csr_array  # (n_meas, size - 2 n_nodes): the share of powers into children in injections to ground
    into_area: MeasurementModel | None  # P and Q from buses of others into the area's own branches, by boundary
    z: np.ndarray
    sigma: np.ndarray
    free: np.ndarray
    meters: Sequence[Meter]
    reference: int | None
    backend: Backend = "auto"
    method: Method = least_squares
    further: tuple[FurtherRows, ...] = ()
    held_back: np.ndarray = field(default_factory=lambda: NO_ROWS)

    def with_values(self, z: np.ndarray, sigma: np.ndarray, **changed: object) -> Self:
        """Other readings of the same meters; keeps all that is found already."""
        other = copy.copy(self)
        other.__dict__.update(virtual=self.virtual, currents=self.currents, z=z, sigma=sigma, **changed)
        return other

    @cached_property
    def virtual(self) -> np.ndarray:
        """True for virtual measurements, shape (n_meas,)."""
        return find_virtual(self.meters)

    @cached_property
    def exact(self) -> np.ndarray:
        """Rows of virtual measurements."""
        return np.flatnonzero(self.virtual)

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Ids of the meters."""
        return tuple(meter.id for meter in self.meters)

    @cached_property
    def real_ids(self) -> frozenset[str]:
        """Ids of the meters that are not virtual."""
        return frozenset(meter.id for meter in self.meters if meter.source is not Source.VIRTUAL)

    @property
    def size(self) -> int:
        return self.area.size

    @cached_property
    def are_powers(self) -> np.ndarray:
        """True for the powers into children, shape (size,)."""
        found = np.zeros(self.size, dtype=bool)
        found[2 * self.n_nodes : self.area.first_tap] = True
        return found

    @property
    def couples_many(self) -> bool:
        """True where one of the further rows reads many buses."""
        return any(rows.couples_many for rows in self.further)

    @property
    def moves_with_powers(self) -> bool:
        """True where further variables change no weight and no derivative."""
        return self.method is least_squares and not self.model.further

    @cached_property
    def n_nodes(self) -> int:
        """The number of nodes, of which x has va and vm."""
        return self.area.network.n_nodes

    @property
    def kinds(self) -> np.ndarray:
        return self.model.kinds

    @cached_property
    def currents(self) -> np.ndarray:
        """Rows of current magnitudes."""
        return np.flatnonzero(QUANTITY[self.kinds] == Quantity.CURRENT)

    @cached_property
    def angles(self) -> np.ndarray:
        """Rows of angle meters."""
        return np.flatnonzero(QUANTITY[self.kinds] == Quantity.VA)

    @cached_property
    def reads_reference(self) -> bool:
        """True where a meter's readings count from the angle reference of the grid."""
        return any(meter.kind.needs_reference for meter in self.meters)

    @cached_property
    def current_parts(self) -> np.ndarray:
        """Rows of Re i and Im i."""
        return np.flatnonzero(IS_OF_PHASOR[self.kinds])

    @cached_property
    def degrees(self) -> np.ndarray:
        """The power k for which h grows as c^k when all voltages grow by c, shape (n_meas,)."""
        degrees: np.ndarray = DEGREE[self.kinds].astype(float)
        return degrees

    @cached_property
    def eliminated(self) -> dict[str, np.ndarray]:
        """Neighbour -> the ``free`` variables but the voltage at the boundary to it."""
        return {n.area: self.free[~np.isin(self.free, self.voltage_columns(n))] for n in self.area.neighbours}

    @cached_property
    def fixed(self) -> np.ndarray:
        """The variables that are not ``free``."""
        return np.setdiff1d(np.arange(self.size), self.free)

    def residual_of(self, h: np.ndarray) -> np.ndarray:
        """z - h, shape (n_meas,); angles wrapped to (-pi, pi], and 0 where a measurement does not count yet."""
        r = self.model.subtract(self.z, h)
        if self.held_back.size:
            r[self.held_back] = 0.0
        return r

    def rows_where(self, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Right-hand side and sigma of the measurements' rows where h(x) is ``h``, (n_meas,) each."""
        if self.method is least_squares:
            return self.residual_of(h), self.sigma
        own = self.contribution(h)
        return own.residual + own.shift, own.weight**-0.5

    def contribution(self, h: np.ndarray) -> Contribution:
        """Contribution of the measurements where h(x) is ``h``, (n_meas,)."""
        return self.method(self.residual_of(h), self.sigma)

    def boundary_of(self, neighbour: Neighbour) -> Boundary:
        """The variables y that ``neighbour`` and the area share."""
        return self.area.boundaries[neighbour.area]

    def real_part(self, of_measurements: np.ndarray) -> np.ndarray:
        """``of_measurements`` (n_meas,) with 0 for virtual ones."""
        return np.where(self.virtual, 0.0, of_measurements)

    def voltage_columns(self, neighbour: Neighbour) -> list[int]:
        """Positions in x of the voltages of y, (vm, va) each."""
        boundary = self.boundary_of(neighbour)
        return [self._column[variable] for variable in boundary.variables[boundary.n_powers :]]

    def boundary_columns(self, neighbour: Neighbour) -> list[int]:
        """Positions in x of the variables y of a boundary, without the powers of ``own_powers``, which x lacks."""
        return [self._column[v] for v in self.boundary_of(neighbour).variables if v in self._column]

    @cached_property
    def own_powers(self) -> dict[str, tuple[np.ndarray, slice]]:
        """Neighbour -> positions in y of the powers into the area's own branches, and their rows of ``into_area``."""
        found, end = {}, 0
        for name, boundary in self.area.boundaries.items():
            own = np.array([k for k, v in enumerate(boundary.variables) if v.area == self.area.name], dtype=np.int64)
            found[name] = own, slice(end, end + len(own))
            end += len(own)
        return found

    @cached_property
    def other_powers(self) -> dict[str, tuple[list[int], list[int]]]:
        """Neighbour -> the positions in y, and in x, of the powers into other areas."""
        found = {}
        for name, boundary in self.area.boundaries.items():
            others = {k: self._column[power] for k, power in enumerate(boundary.powers) if power in self._column}
            found[name] = list(others), list(others.values())
        return found

    @cached_property
    def _column(self) -> dict[Variable, int]:
        """Variable of a boundary -> its position in x, for all that x has."""
        node, n = self.area.network.node, self.n_nodes
        first = {Kind.VA: 0, Kind.VM: n}
        shared = (variable for boundary in self.area.boundaries.values() for variable in boundary.variables)
        of_voltages = {v: first[v.kind] + node(v.bus, v.phase) for v in shared if v.kind in first}
        return of_voltages | {power: 2 * n + k for k, power in enumerate(self.area.powers_into_children)}
