"""Estimates in one place, with bad data removed, of one scan or of many scans of a grid: ``dsse estimate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from agents.protocol.quality import DEGRADED, GOOD, NONE
from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data_with_plan
from dsse_core.estimation.batch import BatchResult, RowFailure, describe_failure, estimate_batch
from dsse_core.estimation.plan import EstimationPlan, build_estimation_plan
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit, find_dead
from dsse_core.files.bounded_file import read_text
from dsse_core.files.wording import suggest
from dsse_core.grid.columns import Records, take_items
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.meter_table import find_places, find_virtual, join_meters
from dsse_core.grid.network import Network
from dsse_core.grid.partition import MOST_SHOWN, Partition
from dsse_core.grid.switches import find_dead_meters, find_meters_in_service
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.printable import listed
from dsse_core.results.results import MeterReadings, Results, results_of_estimate, results_without_estimate
from dsse_core.results.scans import ScanTables, make_scan_table
from dsse_core.results.table import ScanLabel
from scenarios.check import plan_whole_grid
from scenarios.files.readings.file import Scans, read_scans
from scenarios.scenario import Scenario, TelemetrySettings, find_virtual_problems
from scenarios.telemetry import read_meters


def estimate_whole_grid(scenario: Scenario) -> tuple[BadDataReport, PowerFlowResult | None]:
    """The estimate of the first scan with its bad data removed, and the truth where it is known.

    Raises:
        InvalidInputError: every problem in what the meters observe.
        NotObservableError: the readings of the scan do not determine the state.
        PowerFlowDivergedError, EstimationDivergedError: the power flow or the estimate does not converge.
    """
    plan = plan_whole_grid(scenario)
    scan, lives = read_meters(scenario), np.flatnonzero(~find_dead_meters(scenario.network, scenario.meters))
    is_missing = np.isin(lives, scan.missing)
    values, sigmas = scan.values[lives[~is_missing]], scan.sigmas[lives[~is_missing]]
    plan = plan.without(np.flatnonzero(is_missing).tolist()) if is_missing.any() else plan
    return process_bad_data_with_plan(plan, values, sigmas, tolerance=scenario.tolerances.estimator), scan.truth


@dataclass(frozen=True)
class ScanEstimates:
    """``batch``: the estimate of each scan, its bad data removed. ``removed``: row -> ids of the removed meters;
    ``undecided``: row -> ids of meters that the readings cannot distinguish from these; ``switched``: row -> ids of
    switches that count the other way.

    ``bad_data_left`` (n_scan,): True where J exceeds the chi-square limit after the removal. ``rows``: the readings.
    """

    partition: Partition
    scans: Scans
    rows: ScanRows
    batch: BatchResult
    removed: Mapping[int, tuple[str, ...]]
    undecided: Mapping[int, tuple[str, ...]]
    switched: Mapping[int, tuple[str, ...]]
    bad_data_left: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scans."""
        return self.scans.names

    @cached_property
    def limits(self) -> np.ndarray:
        """Chi-square limit of J in each scan, (n_scan,)."""
        return np.array([chi_square_limit(n, CONFIDENCE) for n in self.batch.degrees_of_freedom.tolist()])

    @cached_property
    def tables(self) -> ScanTables:
        """A row for each scan, and the tables of all scans, which are those of each scan alone."""
        readings = (~np.isnan(self.scans.values)).sum(axis=1)
        bad_data = self.removed, self.undecided, self.switched, self.bad_data_left
        scans = make_scan_table(self.names, self.scans.times, self.batch, self.limits, readings, *bad_data)
        return ScanTables(scans, lambda: map(self._results_of, range(len(self.names))))

    def _results_of(self, row: int) -> Results:
        label = ScanLabel(self.names[row], self.scans.times[row])
        meters, network = self.rows.shown, self.batch.plan.network
        if row in self.batch.failures:
            values, sigmas, unknown = np.full((3, len(meters)), np.nan)
            at = find_places(network, meters, self.rows.plan.meters)
            values[at], sigmas[at] = self.rows.values[row], self.rows.sigmas[row]
            readings = MeterReadings(meters, values, sigmas, unknown, {}, ())
            return results_without_estimate(network, self.partition, readings, label, NONE)
        quality = DEGRADED if self.bad_data_left[row] else GOOD
        report = self.rows.estimate(row)
        return results_of_estimate(report, partition=self.partition, meters=meters, label=label, quality=quality)

    def describe_failures(self) -> list[str]:
        """Name and reason of every scan without an estimate."""
        return [f"scan {self.names[row]}: {failure.text}" for row, failure in self.batch.failures.items()]


@dataclass(frozen=True)
class ScanRows:
    """Readings of each scan, those of virtual meters included: ``values``, ``sigmas`` (n_scan, n_meas), of the meters
    of ``plan``. ``shown``: these, and those without supply.
    """

    plan: EstimationPlan
    shown: Sequence[Meter]
    values: np.ndarray
    sigmas: np.ndarray
    tolerance: float

    def estimate(self, row: int) -> BadDataReport:
        """The estimate of a scan by itself, its bad data removed; raises as ``process_bad_data_with_plan``."""
        missing = np.isnan(self.values[row])
        plan = self.plan.without(np.flatnonzero(missing).tolist()) if missing.any() else self.plan
        values, sigmas = self.values[row][~missing], self.sigmas[row][~missing]
        return process_bad_data_with_plan(plan, values, sigmas, tolerance=self.tolerance)


def operate(scenario: Scenario, opened: Sequence[str], closed: Sequence[str]) -> Scenario:
    """``scenario`` with switches ``opened`` and ``closed``, by id or name; readings that it makes are of that grid.

    Raises:
        InvalidInputError: naming each that is no switch, and each that is both.
    """
    network, switches = scenario.network, scenario.network.switches
    opened, closed = (list(map(network.id_of, given)) for given in (opened, closed))
    near = [*switches, *filter(None, (network.branch(switch).name for switch in switches))]
    known = f"switches are {listed(sorted(switches), MOST_SHOWN)}" if switches else "there is none"
    cure = "a branch becomes one by `switch = true` in the network file"
    given = dict.fromkeys([*opened, *closed])
    unknown = [switch for switch in given if switch not in switches]
    problems = [f"there is no switch {switch!r}{suggest(switch, near)}; {known}; {cure}" for switch in unknown]
    problems += [f"switch {switch} is to be open and closed" for switch in sorted({*opened} & {*closed})]
    if problems:
        raise InvalidInputError("--open, --close", problems)
    return scenario.operated({switch: switch in closed for switch in given})


def operate_scans(scans: Scans, network: Network) -> Scans:
    """``scans`` without the meters at branches that are open in ``network``."""
    rows = find_meters_in_service(network, scans.meters)
    meters = take_items(scans.meters, rows)
    return replace(scans, meters=meters, values=scans.values[:, rows], sigmas=scans.sigmas[:, rows])


def load_scans_of(scenario: Scenario, path: Path) -> Scans:
    """The readings in ``path`` of one or many scans, in place of those of ``scenario``. Raises as ``read_scans_of``."""
    return read_scans_of(scenario, read_text(path), str(path))


def read_scans_of(scenario: Scenario, text: str, source: str) -> Scans:
    """The readings in ``text``, that of a readings file, in place of those of ``scenario``; ``source``: its name.

    Raises:
        InvalidInputError: every problem of the text; or the scenario has readings by area, not of one grid.
    """
    if scenario.telemetry.source == "area-power-flow":
        problem = "a scenario with telemetry.source 'area-power-flow' has no readings of one grid; choose another one"
        raise InvalidInputError("--readings", [problem])
    scans = read_scans(text, source, scenario.network)
    if problems := list(find_virtual_problems(source, scenario.network, scans.meters, _virtual_of(scenario))):
        raise InvalidInputError("--readings", problems)
    return scans


def with_one_scan(scenario: Scenario, scans: Scans) -> Scenario:
    """``scenario`` with the only scan of ``scans`` as its readings."""
    columns = {"meter": scans.meters, "value": scans.values[0], "sigma": scans.sigmas[0]}
    telemetry = TelemetrySettings("file", noise=False, gross_errors={}, readings=Records(Measurement, columns))
    return replace(scenario, meters=_meters_of(scenario, scans), telemetry=telemetry)


def _meters_of(scenario: Scenario, scans: Scans) -> Sequence[Meter]:
    """The meters of ``scans``, then the virtual ones of ``scenario``."""
    return join_meters(scenario.network, [scans.meters, _virtual_of(scenario)])


def _virtual_of(scenario: Scenario) -> Sequence[Meter]:
    return take_items(scenario.meters, np.flatnonzero(find_virtual(scenario.meters)))


def estimate_scans(scenario: Scenario, scans: Scans) -> ScanEstimates:
    """Estimate all scans with one plan, as a batch; then those with bad data once more, by bad-data processing.

    Bad data: J exceeds its limit, or a meter is dead.

    Raises:
        NotObservableError: not even all meters together determine the state.
    """
    shown = _meters_of(scenario, scans)
    lives = np.flatnonzero(~find_dead_meters(scenario.network, shown))
    plan = build_estimation_plan(scenario.network, take_items(shown, lives))
    of_virtual = np.zeros((len(scans.names), len(shown) - len(scans.meters)))
    values = np.concatenate([scans.values, of_virtual], axis=1)[:, lives]
    sigmas = np.concatenate([np.where(np.isnan(scans.sigmas), 1.0, scans.sigmas), of_virtual], axis=1)[:, lives]
    rows = ScanRows(plan, shown, values, sigmas, scenario.tolerances.estimator)
    batch = estimate_batch(plan, values, sigmas, tolerance=rows.tolerance)
    found = ScanEstimates(scenario.partition, scans, rows, batch, {}, {}, {}, np.zeros(len(scans.names), dtype=bool))
    suspect = batch.objective >= found.limits
    suspect |= [bool(find_dead(plan.meters, row)) for row in values]
    cleaning = _Cleaning(found)
    for row in np.flatnonzero(suspect).tolist():
        cleaning.clean(row)
    failures = {row: cleaning.failures[row] for row in sorted(cleaning.failures)}
    cleaned = replace(batch, failures=failures)
    named = replace(found, removed=cleaning.removed, undecided=cleaning.undecided, switched=cleaning.switched)
    return replace(named, batch=cleaned)


class _Cleaning:
    """Bad-data processing of single scans, which writes its results into the arrays of ``found``."""

    def __init__(self, found: ScanEstimates) -> None:
        self._found = found
        self.failures: dict[int, RowFailure] = dict(found.batch.failures)
        self.removed: dict[int, tuple[str, ...]] = {}
        self.undecided: dict[int, tuple[str, ...]] = {}
        self.switched: dict[int, tuple[str, ...]] = {}

    def clean(self, row: int) -> None:
        batch = self._found.batch
        self.failures.pop(row, None)
        try:
            report = self._found.rows.estimate(row)
        except (InvalidInputError, NotObservableError, EstimationDivergedError) as error:
            self.failures[row] = describe_failure(error)
            batch.vm[row] = batch.va[row] = batch.objective[row] = np.nan
            batch.iterations[row] = 0
            return
        result = report.result
        batch.vm[row], batch.va[row], batch.objective[row] = result.vm, result.va, report.objective
        batch.iterations[row], batch.degrees_of_freedom[row] = result.iterations, report.degrees_of_freedom
        self._found.bad_data_left[row] = report.detected
        self.removed[row] = tuple(removed.measurement.meter.id for removed in report.removed)
        self.undecided[row] = tuple(meter for _, *others in report.undecided for meter in others)
        self.switched[row] = tuple(report.switched)
