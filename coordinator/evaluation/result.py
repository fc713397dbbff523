"""The result of a run, and its files: ``result.json`` (docs/reference/run-folder.md) and the tables."""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from agents.protocol.quality import GOOD
from coordinator.evaluation.comparison import Comparison
from coordinator.evaluation.run_tables import make_run_tables
from coordinator.evaluation.scan_estimates import ScanEstimates
from coordinator.evaluation.table_files import write_json, write_tables
from coordinator.evaluation.verdict import Verdict
from coordinator.observe.duplicates import Duplicate
from coordinator.observe.observer import Observer, Sample, count_exchanges
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.results.results import Results, WithTables
from scenarios.scenario import Scenario

VERSION = 2
DISTRIBUTIONS = ("consensus-dsse", "numpy", "scipy", "eclipse-zenoh", "msgspec")


@dataclass(frozen=True, slots=True)
class AreaResult:
    """One area at the verdict; gaps and errors over every bus that it sees.

    ``quality``: what its last state is worth at the verdict (docs/explanation/quality.md).
    ``notes``: why, the worst first; of a state that is good, remarks.
    """

    name: str
    buses: int
    gap_vm_pu: float | None
    gap_va_deg: float | None
    error_vm_pu: float | None
    error_va_deg: float | None
    exchanges: int
    messages: int
    bytes: int
    lost: int
    rejected: dict[str, int]
    objective: float | None
    degrees_of_freedom: int | None
    removed: tuple[str, ...]
    critical: tuple[str, ...]
    notes: tuple[str, ...]
    quality: str

    @property
    def degraded(self) -> bool:
        """Whether the state is worth less than it should be."""
        return self.quality != GOOD


@dataclass(frozen=True, repr=False)
class RunOutcome(WithTables):
    """Everything about one run. ``timing_s``: moments in seconds since the call, on the simulator in virtual time.

    ``faults``: kind -> how often it has happened, to messages and to processes. ``duplicates``: areas and plants that
    ran twice at once.

    ``centralised`` is None where that estimate failed; ``centralised_failure`` says why. ``readings``: of all areas.
    """

    scenario: Scenario
    run: str
    verdict: Verdict
    area_results: tuple[AreaResult, ...]
    comparison: Comparison
    centralised: BadDataReport | None
    centralised_failure: str | None
    history: tuple[Sample, ...]
    timing_s: Mapping[str, float]
    faults: Mapping[str, int]
    duplicates: tuple[Duplicate, ...]
    readings: tuple[Measurement, ...] = ()

    def in_folder(self, folder: Path) -> RunResult:
        return RunResult(**{each.name: getattr(self, each.name) for each in fields(self)}, folder=folder)

    def __repr__(self) -> str:
        verdict, scenario = self.verdict, self.scenario
        gap = "" if verdict.gap_vm_pu is None else f", largest gap {verdict.gap_vm_pu:.1e} p.u."
        return (
            f"<{type(self).__name__} of {scenario.name!r}: {'consensus' if verdict.consensus else 'no consensus'} of "
            f"{len(self.area_results)} areas, {len(scenario.network.buses)} buses, strategy {scenario.strategy!r}{gap}>"
        )

    @cached_property
    def tables(self) -> Results:
        """Buses, branches, meters and areas, computed when first asked for."""
        figures = [asdict(area) for area in self.area_results]
        return make_run_tables(self.comparison, self.scenario.meters, self.readings, self.centralised, figures)


@dataclass(frozen=True, repr=False)
class RunResult(RunOutcome):
    """A run whose files lie in ``folder``; ``unwritten`` says why some of them do not, None if all do."""

    folder: Path = field(kw_only=True)
    unwritten: str | None = None

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, files in {str(self.folder)!r}>"


def make_area_results(observer: Observer, comparison: Comparison, now: float) -> tuple[AreaResult, ...]:
    """One row per area, in the scenario's order; ``now``: the time of the verdict on the observer's clock, s."""
    return tuple(_make_area_result(area.name, observer, comparison, now) for area in observer.partition.areas)


def _make_area_result(name: str, observer: Observer, comparison: Comparison, now: float) -> AreaResult:
    state = observer.states.get(name)
    gap, error = comparison.gap_of(name), comparison.error_of(name)
    estimated = state is not None and bool(state.buses)
    worth = observer.worth_of(name, now)
    return AreaResult(
        name=name,
        buses=len(observer.partition.area(name).network.buses),
        gap_vm_pu=gap.vm_pu,
        gap_va_deg=gap.va_deg,
        error_vm_pu=error.vm_pu,
        error_va_deg=error.va_deg,
        exchanges=count_exchanges(state) if state else 0,
        messages=state.messages if state else 0,
        bytes=state.bytes if state else 0,
        lost=state.lost if state else 0,
        rejected=dict(state.rejected) if state else {},
        objective=state.objective if state and estimated else None,
        degrees_of_freedom=state.degrees_of_freedom if state and estimated else None,
        removed=state.removed if state else (),
        critical=state.critical if state else (),
        notes=worth.notes,
        quality=worth.quality,
    )


def write_files(result: RunResult, events_failure: str | None) -> RunResult:
    """Write the result's files; a full disk is no reason to lose the result, which says then what is missing."""
    try:
        write_result(result)
    except OSError as error:
        return replace(result, unwritten=f"{error.filename or result.folder}: {error.strerror}")
    return replace(result, unwritten=events_failure)


def write_result(result: RunResult) -> None:
    """Write ``result.json``, which has the verdict, and then the tables into the run folder."""
    write_json(result.folder / "result.json", as_json(result))
    write_tables(result.folder, result.tables)


def as_json(result: RunOutcome) -> dict[str, Any]:
    """The content of ``result.json``; docs/reference/run-folder.md explains every key."""
    return {
        **_head_json(result.scenario),
        "run": result.run,
        "verdict": asdict(result.verdict),
        "areas": {area.name: _area_json(area) for area in result.area_results},
        "centralised": _centralised_json(result),
        "timing_s": dict(result.timing_s),
        "faults": dict(result.faults),
        "duplicates": [asdict(duplicate) for duplicate in result.duplicates],
        **_versions_json(),
    }


def estimate_as_json(scenario: Scenario, report: BadDataReport) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse estimate``."""
    how = {"iterations": report.result.iterations, "back_end": report.result.backend}
    return {**_head_json(scenario), "estimate": report_as_json(report) | how, **_versions_json()}


def scans_as_json(scenario: Scenario, found: ScanEstimates) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse estimate --readings`` with many scans."""
    failed = {found.names[row]: str(failure.code) for row, failure in found.batch.failures.items()}
    estimated = len(found.names) - len(failed)
    of_all = {"scans": len(found.names), "estimated": estimated, "failed": failed}
    return {**_head_json(scenario), "estimates": of_all | {"back_end": found.batch.plan.backend}, **_versions_json()}


def power_flow_as_json(solved: Scenario | Network, result: PowerFlowResult) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse powerflow``."""
    network = result.network
    loss = result.losses * 1000 * network.base_mva
    how = {"iterations": result.iterations, "method": result.method}
    found = {"loss_kw": loss.real, "loss_kvar": loss.imag} | how
    of_network = {"version": VERSION, "network": {"name": network.name, "buses": len(network.buses)}}
    head = of_network if isinstance(solved, Network) else _head_json(solved)
    return {**head, "power_flow": found, **_versions_json()}


def _head_json(scenario: Scenario) -> dict[str, Any]:
    of_scenario = {
        "name": scenario.name,
        "path": str(scenario.path),
        "description": scenario.description,
        "network": scenario.network.name,
        "buses": len(scenario.network.buses),
        "strategy": scenario.strategy,
        "seed": scenario.seed,
        "telemetry": scenario.telemetry.source,
        "changes": dict(scenario.changes),
    }
    return {"version": VERSION, "scenario": of_scenario}


def _versions_json() -> dict[str, Any]:
    return {"versions": {"python": platform.python_version()} | {name: version_of(name) for name in DISTRIBUTIONS}}


def _area_json(area: AreaResult) -> dict[str, Any]:
    fields = asdict(area)
    del fields["name"]
    return fields | {"degraded": area.degraded}


def _centralised_json(result: RunOutcome) -> dict[str, Any]:
    report, error = result.centralised, result.comparison.centralised_error
    if report is None:
        return {"failure": result.centralised_failure}
    return {"failure": None, "error_vm_pu": error.vm_pu, "error_va_deg": error.va_deg, **report_as_json(report)}


def report_as_json(report: BadDataReport) -> dict[str, Any]:
    """What the chi-square test and the removal of bad data have found."""
    return {
        "objective": report.objective,
        "degrees_of_freedom": report.degrees_of_freedom,
        "chi_square_limit": report.chi_square_limit if math.isfinite(report.chi_square_limit) else None,
        "bad_data_left": report.detected,
        "removed": [
            {
                "meter": removed.measurement.meter.id,
                "normalized_residual": removed.normalized_residual,
                "indistinguishable_from": list(removed.indistinguishable_from),
            }
            for removed in report.removed
        ],
        "critical": list(report.critical),
    }


def version_of(distribution: str) -> str | None:
    """The version of an installed package, None if it is not."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
