"""The measurements of one area as functions of its state, the power into neighbouring areas included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import Admittance, build_admittance, flat_start
from dsse_core.grid.boundary import Kind
from dsse_core.grid.columns import take_items
from dsse_core.grid.further_currents import CurrentsBeyond
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.meter_table import IS_OF_PHASOR, OF_INJECTION
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.grid.switches import find_meters_in_service
from dsse_core.linear import Backend, LinearArea, Matrix, Rows, make_linear, make_rows
from dsse_core.linear.area_measurements import NO_ROWS, AreaMeasurements
from dsse_core.linear.boundary_information import EXACT_SIGMA
from dsse_core.linear.contributions import FurtherRows
from dsse_core.linear.whole_grid import GridSolver

INJECTION = {Kind.P: MeasurementKind.P_INJECTION, Kind.Q: MeasurementKind.Q_INJECTION}


class AreaModel(AreaMeasurements):
    """The measurements of one area with the numerics of its back end."""

    @cached_property
    def rows(self) -> Rows:
        """h and H of the meters, y and dy/dx of the boundaries."""
        return make_rows(self)

    @cached_property
    def linear(self) -> LinearArea:
        """Back end that computes steps, variances and information of boundaries."""
        return make_linear(self, self.rows)

    def with_readings(self, measurements: Sequence[Measurement], further: tuple[FurtherRows, ...] = ()) -> AreaModel:
        """Model of new readings of the same meters, with ``further`` rows; keeps the parts that rest on meters only."""
        sigma = _sigmas_of(measurements)
        sigma = self.sigma if (sigma == self.sigma).all() else sigma
        other = self.with_values(_values_of(measurements), sigma, further=further)
        if other.couples_many != self.couples_many:
            other.end()
        if (linear := other.__dict__.get("linear")) is not None:
            other.__dict__.update(linear=linear.with_readings(other))
        return other

    def end(self) -> None:
        """Drops the back end and the rows, which refer to this model in turn.

        Otherwise the model of every scan stays in memory until Python's collector of cycles runs, which is rare.
        """
        for known in ("linear", "rows"):
            self.__dict__.pop(known, None)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), shape (n_meas,)."""
        return self.rows.predict(x)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """z - h(x), shape (n_meas,); angles wrapped to (-pi, pi]."""
        return self.residual_of(self.predict(x))

    def jacobian(self, x: np.ndarray) -> Matrix:
        """H(x), shape (n_meas, size)."""
        return self.rows.jacobian(x)

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, Matrix]:
        """y, shape (d,), and T = dy/dx, shape (d, size), at the boundary to ``neighbour``."""
        return self.rows.boundary(x, neighbour)

    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        """y of ``boundary`` alone."""
        return self.rows.boundary_values(x, neighbour)


def build_area_model(
    area: Area,
    measurements: Sequence[Measurement],
    reference: int | None,
    *,
    with_shunts: bool = True,
    backend: Backend = "auto",
) -> AreaModel:
    """Model of ``area``'s own ``measurements``.

    Args:
        reference: bus of the grid's angle reference, if the area sees it.
        with_shunts: the model has shunts and line charging; without them no power flows at the flat start.
    """
    network = area.network
    admittance = build_admittance(network, with_shunts=with_shunts)
    meters = [m.meter for m in measurements]
    fixed = NO_ROWS if reference is None else network.nodes_at(reference)
    return AreaModel(
        area=area,
        model=_build_of_meters(area, admittance, meters),
        into_children=_count_powers(area, meters),
        into_area=_build_into_area(area, admittance),
        z=_values_of(measurements),
        sigma=_sigmas_of(measurements),
        free=np.delete(np.arange(area.size), fixed),
        meters=tuple(meters),
        reference=reference,
        backend=backend,
    )


def with_network(model: AreaMeasurements, network: Network) -> AreaMeasurements:
    """``model`` on another ``network`` of the same buses, without meters at branches that are open there."""
    area, admittance = replace(model.area, network=network), build_admittance(network)
    rows = find_meters_in_service(network, model.meters)
    meters = take_items(model.meters, rows)
    return replace(
        model,
        area=area,
        model=_build_of_meters(area, admittance, meters),
        into_children=model.into_children[rows],
        into_area=_build_into_area(area, admittance),
        z=model.z[rows],
        sigma=model.sigma[rows],
        meters=meters,
    )


def with_tap(model: AreaMeasurements, branch: str, tap: float) -> AreaMeasurements:
    """``model`` with another ``tap`` of a branch of its area."""
    return with_network(model, model.area.network.with_taps({branch: tap}))


def _build_of_meters(area: Area, admittance: Admittance, meters: Sequence[Meter]) -> MeasurementModel:
    """The model of ``meters``, with the currents of taps and those into children."""
    model = build_measurement_model(area.network, admittance, meters, first_tap=area.first_tap)
    return _count_currents(area, model)


def _build_into_area(area: Area, admittance: Admittance) -> MeasurementModel | None:
    """P and Q from buses of others into the area's own branches; None where there are none."""
    shared = (v for boundary in area.boundaries.values() for v in boundary.variables)
    into_area = [Meter(INJECTION[v.kind], v.bus, phases=v.phase) for v in shared if v.area == area.name]
    if not into_area:
        return None
    return build_measurement_model(area.network, admittance, into_area, first_tap=area.first_tap)


def _count_powers(area: Area, meters: Sequence[Meter]) -> sp.csr_array:
    """The share of each power into a child in the reading of each injection to ground, (n_meas, size - 2 n_nodes)."""
    powers: dict[tuple[MeasurementKind, int, str], list[tuple[int, float]]] = {}
    for k, power in enumerate(area.powers_into_children):
        kind = INJECTION[power.kind]
        powers.setdefault((kind, power.bus, power.phase), []).append((k, 1.0))
        if power.phase:  # of a total, the mean of all phases of the bus
            share = 1 / len(area.network.nodes_at(power.bus))
            powers.setdefault((kind, power.bus, ""), []).append((k, share))
    counted = [(row, *of) for row, m in enumerate(meters) for of in powers.get((m.kind, m.bus, m.phases), ())]
    rows, columns, shares = zip(*counted, strict=True) if counted else ((), (), ())
    shape = len(meters), area.size - 2 * area.network.n_nodes
    return sp.csr_array(sp.coo_array((shares, (rows, columns)), shape=shape))


def _count_currents(area: Area, model: MeasurementModel) -> MeasurementModel:
    """``model`` with currents into children in what is no power to ground: currents of buses, powers between phases."""
    powers = [
        (area.network.node(s.bus, s.phase), k) for k, s in enumerate(area.powers_into_children) if s.kind is Kind.P
    ]
    if model.other is None or not powers:
        return model
    kinds = model.kinds[model.meters]
    counts = OF_INJECTION[kinds] & (IS_OF_PHASOR[kinds] | (model.other >= 0))
    node, place = np.array(powers).T
    row, power = np.nonzero(counts[:, None] & (model.node[:, None] == node))
    if not len(row):
        return model
    beyond = CurrentsBeyond(row, node[power], 2 * area.network.n_nodes + place[power])
    return replace(model, further=(*model.further, beyond))


def build_whole_grid(network: Network, meters: Sequence[Meter], reference: int) -> GridSolver:
    """Numerics of a grid as one area without neighbours, whose ``meters`` fit the network and determine its state."""
    admittance = build_admittance(network)
    vm, va = flat_start(network, reference)
    given = network.slack.va if network.slack and network.slack.bus == reference else 0.0
    area, nothing = Area("", network, (), reference, None, (reference, given)), np.zeros(len(meters))
    flat = area.join_state(vm, va + given)
    model = AreaMeasurements(
        area=area,
        model=_build_of_meters(area, admittance, meters),
        into_children=sp.csr_array((len(meters), len(flat) - 2 * network.n_nodes)),
        into_area=None,
        z=nothing,
        sigma=nothing,
        free=network.find_unknown(reference),
        meters=meters,
        reference=reference,
    )
    return GridSolver(model, flat)


def _values_of(measurements: Sequence[Measurement]) -> np.ndarray:
    return np.array([m.value for m in measurements], dtype=float)


def _sigmas_of(measurements: Sequence[Measurement]) -> np.ndarray:
    sigmas = [EXACT_SIGMA if m.meter.source is Source.VIRTUAL else m.sigma for m in measurements]
    return np.array(sigmas, dtype=float)
