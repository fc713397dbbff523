"""All tables of an estimate or of a power flow."""

from __future__ import annotations

import html
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from dsse_core.estimation.bad_data import BadDataReport, find_critical
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import find_places
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.results.areas import make_area_table
from dsse_core.results.branches import make_branch_table
from dsse_core.results.buses import make_bus_table
from dsse_core.results.deviations.choose import Deviations, find_deviations
from dsse_core.results.meters import make_meter_table
from dsse_core.results.state import GridState, find_state
from dsse_core.results.table import IN_ONE_PLACE, NO_SCAN, Freshness, ScanLabel, Table, mark_rows
from dsse_core.results.totals import TOTALS, Division, division_of, whole_network

Compared = Mapping[str, tuple[np.ndarray, np.ndarray]]


TABLES = ("buses", "branches", "meters", "areas")


@dataclass(frozen=True, repr=False)
class Results:
    """Tables of one state: ``TABLES``. Their layout is the same for estimates, runs and power flows.

    The tables of meters and areas are made at their first use.
    """

    names: ClassVar = TABLES
    buses: Table
    branches: Table
    make_meters: Callable[[], Table]
    make_areas: Callable[[], Table]

    @cached_property
    def meters(self) -> Table:
        return self.make_meters()

    @cached_property
    def areas(self) -> Table:
        return self.make_areas()

    def __repr__(self) -> str:
        return f"<Results: {', '.join(f'{len(getattr(self, name))} {name}' for name in TABLES)}>"


class WithTables(ABC):
    """A result with ``tables``, and each table as an attribute."""

    @property
    @abstractmethod
    def tables(self) -> Results:
        """All four tables."""

    def _repr_html_(self) -> str:
        """The HTML for notebooks: the line of ``repr`` and a table."""
        return f"<p>{html.escape(repr(self))}</p>{self._shown()._repr_html_()}"

    def _shown(self) -> Table:
        return self.areas

    @property
    def buses(self) -> Table:
        """One row per bus, or per phase of it, in the order of the network."""
        return self.tables.buses

    @property
    def branches(self) -> Table:
        """One row per branch, or per phase of it, in the order of the network."""
        return self.tables.branches

    @property
    def meters(self) -> Table:
        """One row per meter, in the order of the scenario."""
        return self.tables.meters

    @property
    def areas(self) -> Table:
        """One row per area, in the order of the scenario."""
        return self.tables.areas


@dataclass(frozen=True)
class MeterReadings:
    """The arguments of ``make_meter_table`` beside the state; arrays (n_meas,), nan where there is no number."""

    meters: Sequence[Meter]
    values: np.ndarray
    sigmas: np.ndarray
    residual_variance: np.ndarray
    removed: Mapping[str, float]
    critical: Collection[str]


def results_of_estimate(
    found: EstimationResult | BadDataReport,
    *,
    partition: Partition | None = None,
    meters: Sequence[Meter] | None = None,
    truth: PowerFlowResult | None = None,
    label: ScanLabel = NO_SCAN,
    quality: str = "",
) -> Results:
    """The tables of a centralised estimate, with standard deviations of all quantities.

    Args:
        partition: the areas to add up; without it the whole network is one area, called "".
        meters: the meters to show, in this order, silent ones included; by default those of the estimate and the
            removed ones.
        truth: a power flow to show beside the estimate.
        label: of the scan.
        quality: of all areas.
    """
    result = found.result if isinstance(found, BadDataReport) else found
    state = find_state(result.plan.network, result.vm, result.va, taps=result.estimated_taps)
    compared = {"centralised": (result.vm, result.va)} | ({"true": (truth.vm, truth.va)} if truth else {})
    division = find_division(result.network, partition)
    deviations = find_deviations(result, division, state.branches)
    return assemble_results(
        state,
        deviations,
        compared,
        partial(readings_of_estimate, found, meters),
        division,
        None,
        [Freshness(quality)] * len(division.names),
        label,
    )


def results_without_estimate(
    network: Network, partition: Partition | None, readings: MeterReadings, label: ScanLabel, quality: str
) -> Results:
    """The tables of a scan whose ``readings`` have no estimate: all that follows from one is nan."""
    division = find_division(network, partition)
    state = find_state(network, *np.full((2, network.n_nodes), np.nan))
    marks = [Freshness(quality, fresh=False)] * len(division.names)
    return assemble_results(state, no_deviations(state, division), {}, readings, division, None, marks, label)


def results_of_power_flow(
    result: PowerFlowResult, *, partition: Partition | None = None, meters: Sequence[Meter] = ()
) -> Results:
    """The tables of a power flow: nothing has a standard deviation, and no meter has read anything.

    ``meters``: the meters to show, with their error-free readings as estimate. ``partition``: see
    ``results_of_estimate``.
    """
    state, nothing = find_state(result.network, result.vm, result.va), np.full(len(meters), np.nan)
    readings = MeterReadings(meters, nothing, nothing, nothing, {}, ())
    compared, division = {"true": (result.vm, result.va)}, find_division(result.network, partition)
    return assemble_results(state, no_deviations(state, division), compared, readings, division)


def assemble_results(
    state: GridState,
    deviations: Deviations,
    compared: Compared,
    readings: MeterReadings | Callable[[], MeterReadings],
    division: Division,
    of_run: Mapping[str, np.ndarray] | None = None,
    marks: Sequence[Freshness] | None = None,
    label: ScanLabel = NO_SCAN,
) -> Results:
    """All tables of ``state``; see the functions that make each."""
    of_areas = marks or [IN_ONE_PLACE] * len(division.names)
    bus, branch = state.network.table.nodes.item, state.branches.branch
    of_buses, of_branches = mark_rows(of_areas, division.of_bus[bus]), mark_rows(of_areas, division.of_branch[branch])
    voltages = deviations.vm, deviations.va, deviations.injections
    return Results(
        buses=make_bus_table(state, division.owners(bus), compared, *voltages, label, of_buses),
        branches=make_branch_table(state, deviations.branches, label, of_branches),
        make_meters=partial(_make_meters, state, readings, label),
        make_areas=partial(_make_areas, state, division, deviations, of_run, marks, label),
    )


def _make_meters(state: GridState, readings: MeterReadings | Callable[[], MeterReadings], label: ScanLabel) -> Table:
    return make_meter_table(state, **vars(readings() if callable(readings) else readings), label=label)


def _make_areas(
    state: GridState,
    division: Division,
    deviations: Deviations,
    of_run: Mapping[str, np.ndarray] | None,
    marks: Sequence[Freshness] | None,
    label: ScanLabel,
) -> Table:
    return make_area_table(state, division, deviations.totals, of_run, marks, label)


def find_division(network: Network, partition: Partition | None) -> Division:
    """The areas of ``partition``; without it the whole network as one area, called ""."""
    return division_of(partition) if partition else whole_network(network)


def no_deviations(state: GridState, division: Division) -> Deviations:
    """The deviations of a state without known ones: all nan."""
    n, m, totals = len(state.vm), len(state.branches.branch), (2, len(TOTALS), len(division.names))
    vm, va, branches, injections = (np.full(shape, np.nan) for shape in (n, n, (8, m), (2, n)))
    return Deviations(vm, va, branches, injections, partial(np.full, totals, np.nan))


def readings_of_estimate(
    found: EstimationResult | BadDataReport, meters: Sequence[Meter] | None = None
) -> MeterReadings:
    """The readings of an estimate with their residuals' variances; ``meters``: see ``results_of_estimate``."""
    result, removed = (found.result, found.removed) if isinstance(found, BadDataReport) else (found, ())
    critical = found.critical if isinstance(found, BadDataReport) else find_critical(result)
    if meters is None:
        meters = (*result.plan.meters, *(r.measurement.meter for r in removed)) if removed else result.plan.meters
    values, sigmas, variance = np.full((3, len(meters)), np.nan)
    at = find_places(result.network, meters, result.plan.meters)
    shown = at >= 0
    values[at[shown]], sigmas[at[shown]] = result.values[shown], result.sigmas[shown]
    variance[at[shown]] = result.residual_variance[shown]
    if removed:
        at = find_places(result.network, meters, [r.measurement.meter for r in removed])
        for row, r in zip(at.tolist(), removed, strict=True):
            if row >= 0:
                values[row], sigmas[row] = r.measurement.value, r.measurement.sigma
    taken_out = {r.measurement.meter.id: r.normalized_residual for r in removed}
    return MeterReadings(meters, values, sigmas, variance, taken_out, critical)
