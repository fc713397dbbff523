"""The tables of a run: the joint state of the areas, and the quantities that follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from coordinator.lab.evaluation.comparison import Comparison
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.meter_table import find_places, read_meters_of
from dsse_core.grid.network import Network
from dsse_core.results.deviations.choose import Deviations, find_deviations
from dsse_core.results.results import MeterReadings, Results, assemble_results, no_deviations, readings_of_estimate
from dsse_core.results.state import GridState, join_states
from dsse_core.results.table import Freshness
from dsse_core.results.totals import Division, division_of, find_totals

AreaFigures = Mapping[str, Any]
SAME_SIGMA = 1e-6
"""Relative difference up to which an area's standard deviation of a magnitude counts as equal to the centralised one.
Only then does the centralised covariance hold for the area's estimate."""


def make_run_tables(
    comparison: Comparison,
    meters: Sequence[Meter],
    readings: Sequence[Measurement],
    centralised: BadDataReport | None,
    areas: Sequence[AreaFigures],
) -> Results:
    """Tables with the voltages of the owners, and flows from the voltages of the area that holds the branch.

    ``areas``: the figures of each area in ``result.json``, in order.

    Areas publish standard deviations of voltages only. Those of other quantities, and of residuals, come from the
    covariance of the centralised estimate, at buses where both agree on those of all magnitudes (SAME_SIGMA); elsewhere
    they are nan, as everywhere while the statuses of switches differ.
    """
    state = join_states(comparison.partition, comparison.published)
    if centralised is not None and centralised.result.network.switches != state.network.switches:
        centralised = None
    compared = {
        "true": (comparison.truth.vm, comparison.truth.va),
        "centralised": (comparison.centralised.vm, comparison.centralised.va),
        "decentralised": (comparison.decentralised.vm, comparison.decentralised.va),
    }
    division = division_of(comparison.partition)
    deviations, agreed = _find_deviations(comparison, centralised, state, division)
    rows = state.network.table.rows.find(read_column(meters, "bus", np.int64))
    beside = _find_readings(state.network, meters, readings, centralised, areas, agreed[rows])
    return assemble_results(
        state,
        deviations,
        compared,
        beside,
        division,
        _figures_of(areas),
        [_freshness_of(area) for area in areas],
        comparison.label,
    )


def _freshness_of(area: Mapping[str, Any]) -> Freshness:
    age_s = area["value_age_s"]
    return Freshness(area["quality"], np.nan if age_s is None else age_s, area["fresh"])


def _find_deviations(
    comparison: Comparison, centralised: BadDataReport | None, state: GridState, division: Division
) -> tuple[Deviations, np.ndarray]:
    """Standard deviations; True for buses where those of all magnitudes equal the centralised ones, (n_bus,)."""
    own, table = comparison.sigma, state.network.table
    published = replace(no_deviations(state, division), vm=own.vm, va=own.va)
    if centralised is None:
        return published, np.zeros(len(table.bus_id), dtype=bool)
    central = find_deviations(centralised.result, division, state.branches)
    same = abs(own.vm - central.vm) <= SAME_SIGMA * central.vm  # not where it is nan
    agreed = np.bincount(table.nodes.item, ~same, len(table.bus_id)) == 0
    both = agreed[table.end_rows[:, state.branches.branch]].all(axis=0)
    branches = np.where(both & ~np.isnan(state.flows.s_from.real), central.branches, np.nan)
    injections = np.where(agreed[table.nodes.item] & ~np.isnan(state.injection.real), central.injections, np.nan)
    totals = np.where(_find_agreed_areas(state, division, both, agreed), central.totals, np.nan)
    # computed now, as their inputs take more memory than the tables
    return replace(published, branches=branches, injections=injections, find_totals=lambda: totals), agreed


def _find_agreed_areas(state: GridState, division: Division, branches: np.ndarray, buses: np.ndarray) -> np.ndarray:
    """True for areas of which all owned ``buses`` (n_bus,), and all ``branches`` (n_row,) held or ending there, agree,
    (n_area,).
    """
    agreed = np.ones(len(division.names), dtype=bool)
    agreed[division.of_bus[~buses]] = False
    of_branch, ends = state.branches.branch, state.network.table.end_rows
    for area in (division.of_branch, *division.of_bus[ends]):
        agreed[area[of_branch][~branches & state.branches.in_service]] = False
    return np.asarray(agreed & ~np.isnan(find_totals(state, division)).any(axis=(0, 1)))


def _find_readings(
    network: Network,
    meters: Sequence[Meter],
    readings: Sequence[Measurement],
    centralised: BadDataReport | None,
    areas: Sequence[AreaFigures],
    agreed: np.ndarray,
) -> MeterReadings:
    """Readings, with the meters that areas removed or found critical; a removed meter has the centralised normalised
    residual.

    ``agreed`` (n_meas,): True where the standard deviations at the meter's bus agree.
    """
    removed = {meter for area in areas for meter in area["removed"]}
    critical = {meter for area in areas for meter in area["critical"]}
    at = find_places(network, read_meters_of(readings), meters)
    values, sigmas = (np.append(read_column(readings, key, float), np.nan)[at] for key in ("value", "sigma"))
    variance, taken_out = np.full(len(meters), np.nan), dict.fromkeys(removed, np.nan)
    if centralised is not None:
        central = readings_of_estimate(centralised, meters)
        variance = np.where(agreed, central.residual_variance, np.nan)
        taken_out |= {meter: value for meter, value in central.removed.items() if meter in removed}
    return MeterReadings(meters, values, sigmas, variance, taken_out, critical)


def _figures_of(areas: Sequence[AreaFigures]) -> dict[str, np.ndarray]:
    """The columns OF_A_RUN, as in ``result.json``; lists become their sizes, tables of counts their sums."""
    plain = ("gap_vm_pu", "gap_va_deg", "error_vm_pu", "error_va_deg", "objective", "degrees_of_freedom")
    counts = {key: np.array([a[key] for a in areas]) for key in ("exchanges", "messages", "bytes", "lost")}
    counts["rejected"] = np.array([sum(a["rejected"].values()) for a in areas])
    counts |= {key: np.array([len(a[key]) for a in areas]) for key in ("removed", "critical")}
    unknown = {key: [a[key] for a in areas] for key in plain}
    return counts | {
        key: np.array([np.nan if value is None else value for value in values], dtype=float)
        for key, values in unknown.items()
    }
