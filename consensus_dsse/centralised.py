"""The true state and that of a control centre: power flow and centralised estimate of the whole grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from consensus_dsse.readings import write_readings
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.evaluation.scan_estimates import estimate_scans, load_scans_of, read_scans_of, with_one_scan
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.state_limits import DEFAULT_OPERATING_LIMITS
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow
from dsse_core.results.results import Results, WithTables, results_of_estimate, results_of_power_flow
from dsse_core.results.units import base_kw
from scenarios.check import check_scenario
from scenarios.named_grid import load_grid
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry, make_telemetry

if TYPE_CHECKING:
    from collections.abc import Mapping

    from coordinator.show.figures.style import Drawing
    from dsse_core.estimation.result import EstimationResult
    from dsse_core.results.scans import ScanTables
    from scenarios.files.readings.file import Scans


@dataclass(frozen=True, repr=False)
class Estimate(WithTables):
    """A centralised estimate: ``report`` of the bad-data processing, with ``report.result`` in p.u. and rad."""

    scenario: Scenario
    telemetry: Telemetry
    report: BadDataReport

    @cached_property
    def tables(self) -> Results:
        """Buses, branches, meters and areas, with standard deviations; computed when first asked for."""
        partition, meters = self.scenario.partition, self.scenario.meters
        return results_of_estimate(self.report, partition=partition, meters=meters, truth=self.telemetry.truth)

    def plot(self, figure: str = "magnitudes") -> Drawing:
        """The profile of ``magnitudes`` or ``angles`` over the distance from the substation, beside the truth.

        A notebook shows it, ``save(PATH)`` writes it, and its ``figure`` is matplotlib's.

        Raises:
            InvalidInputError: there is no such figure.
        """
        truth, found = self.telemetry.truth, self.report.result
        return _draw_profile(figure, self.scenario, self.scenario.network, truth, found)

    def __repr__(self) -> str:
        report, buses = self.report, len(self.scenario.network.buses)
        return (
            f"<Estimate of {self.scenario.name!r}: {buses} buses, J = {report.objective:.4g} "
            f"with {report.degrees_of_freedom} degrees of freedom, {len(report.removed)} meters removed>"
        )


@dataclass(frozen=True, repr=False)
class PowerFlow(WithTables):
    """The solved network: ``result`` in p.u. and rad. ``scenario``: None where a network was given."""

    scenario: Scenario | None
    result: PowerFlowResult

    @cached_property
    def tables(self) -> Results:
        """Buses, branches, meters and areas; computed when first asked for."""
        if self.scenario is None:
            return results_of_power_flow(self.result)
        return results_of_power_flow(self.result, partition=self.scenario.partition, meters=self.scenario.meters)

    def plot(self, figure: str = "magnitudes") -> Drawing:
        """The profile of ``magnitudes`` or ``angles``, as of ``Estimate.plot``."""
        return _draw_profile(figure, self.scenario, self.result.network, self.result, None)

    @property
    def loss_kw(self) -> float:
        """Active losses of the whole network, kW."""
        return base_kw(self.result.network) * self.result.losses.real

    def __repr__(self) -> str:
        name = self.scenario.name if self.scenario else self.result.network.name
        return f"<PowerFlow of {name!r}: {len(self.result.network.buses)} buses, losses {self.loss_kw:.6g} kW>"


@overload
def estimate(
    scenario: str | Path | Scenario,
    *,
    seed: int | None = None,
    changes: Mapping[str, object] | None = None,
    readings: None = None,
) -> Estimate: ...


@overload
def estimate(
    scenario: str | Path | Scenario,
    *,
    seed: int | None = None,
    changes: Mapping[str, object] | None = None,
    readings: Any,
) -> Estimate | ScanTables: ...


def estimate(
    scenario: str | Path | Scenario,
    *,
    seed: int | None = None,
    changes: Mapping[str, object] | None = None,
    readings: Any = None,
) -> Estimate | ScanTables:
    """Estimate the whole grid of ``scenario`` in one place, with bad-data processing, as ``dsse estimate`` does.

    Args:
        scenario: name of a shipped scenario, path of a scenario file, or a loaded one.
        seed: replaces the scenario's.
        changes: see ``load_scenario``; for a scenario that is not loaded yet.
        readings: these in place of the scenario's: the path of a readings file; a frame, table or mapping with its
            columns ``meter``, ``value_UNIT``, ``sigma_UNIT`` and, for many scans, ``scan``, such as ``meters`` of a
            result; or one with meters as names and their readings in kW, kvar, A, p.u. or degrees: a number for each,
            or an array with one for each scan, nan or masked where it is missing. Their standard deviations are those
            of the scenario's own scan.

    Returns:
        The estimate; of many scans their tables ``scans``, ``buses``, ``branches``, ``meters`` and ``areas``.

    >>> import consensus_dsse as dsse
    >>> found = dsse.estimate("ieee33", seed=7)
    >>> found.buses.vm_pu.shape, found.branches.i_from_a.shape
    ((33,), (37,))
    >>> bool(abs(found.buses.vm_pu - found.buses.true_vm_pu).max() < 0.005)
    True
    >>> same = dsse.estimate("ieee33", readings=found.meters)
    >>> bool(abs(same.buses.vm_pu - found.buses.vm_pu).max() < 1e-9)
    True

    Raises:
        InvalidInputError: the scenario or a reading cannot be used, or the meters do not determine the state.
        EstimationDivergedError: the iteration does not converge.
    """
    chosen = choose_scenario(scenario, seed, changes=changes or {})
    if readings is not None:
        scans = _read(chosen, readings)
        if scans.are_named:
            return estimate_scans(chosen, scans).tables
        chosen = with_one_scan(chosen, scans)
    prepared = check_scenario(chosen)
    telemetry = make_telemetry(prepared)
    report = process_bad_data(prepared.network, telemetry.union, tolerance=prepared.tolerances.estimator)
    return Estimate(prepared, telemetry, report)


def _read(scenario: Scenario, readings: Any) -> Scans:
    if isinstance(readings, str | Path):
        return load_scans_of(scenario, Path(readings))
    return read_scans_of(scenario, write_readings(scenario, readings), "readings")


def power_flow(scenario: str | Path | Scenario | Network, *, changes: Mapping[str, object] | None = None) -> PowerFlow:
    """Solve the power flow of a network, or of the whole network of ``scenario``: the truth that its meters read.

    Args:
        scenario: name of a shipped scenario, path of a scenario or network file, or a loaded one.
        changes: see ``load_scenario``; for a scenario that is not loaded yet.

    >>> import consensus_dsse as dsse
    >>> solved = dsse.power_flow("case33bw")
    >>> solved
    <PowerFlow of 'case33bw': 33 buses, losses 202.677 kW>
    >>> round(float(solved.branches.loss_kw[0]), 2), round(float(solved.buses.vm_kv[17]), 3)
    (12.24, 11.56)
    >>> dsse.power_flow(dsse.load_network("case33bw")).loss_kw == solved.loss_kw
    True

    Raises:
        InvalidInputError: the scenario or network cannot be used.
        PowerFlowDivergedError: the iteration does not converge.
    """
    grid = scenario if isinstance(scenario, Scenario | Network) else load_grid(scenario, changes=changes)
    if changes and grid is scenario:
        problem = f"{', '.join(changes)}: it is loaded already; give the changes to load_scenario"
        raise InvalidInputError(f"power flow of {grid.name!r}", [problem])
    if isinstance(grid, Network):
        return PowerFlow(None, solve_power_flow(grid))
    return PowerFlow(grid, solve_power_flow(grid.network))


def _draw_profile(
    figure: str,
    scenario: Scenario | None,
    network: Network,
    truth: PowerFlowResult | None,
    found: EstimationResult | None,
) -> Drawing:
    from coordinator.lab.evaluation.comparison import Voltages
    from coordinator.show.figures.profile_figures import Profile
    from coordinator.show.figures.run_figures import PROFILES, draw_one
    from coordinator.show.figures.style import CENTRALISED, TRUE

    shown = {}
    if truth is not None:
        shown["true (power flow)"] = Voltages(truth.vm, truth.va), TRUE
    if found is not None:
        shown["centralised estimate"] = Voltages(found.vm, found.va), CENTRALISED
    limits = scenario.operating_limits if scenario else DEFAULT_OPERATING_LIMITS
    return draw_one(PROFILES, figure, Profile(network, shown, limits))
