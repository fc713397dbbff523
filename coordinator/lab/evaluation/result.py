"""The result of a run, and its files: ``result.json`` (docs/reference/run-folder.md) and the tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from agents.messages.packing import StateMessage
from agents.protocol.quality import GOOD
from coordinator.lab.evaluation.answers import head_json, report_as_json, versions_json
from coordinator.lab.evaluation.comparison import Comparison
from coordinator.lab.evaluation.run_tables import make_run_tables
from coordinator.lab.evaluation.verdict import Verdict
from coordinator.watch.observe.causes import Cause
from coordinator.watch.observe.duplicates import Duplicate
from coordinator.watch.observe.freshness import find_freshness
from coordinator.watch.observe.grid_tables import GridTables, Tables
from coordinator.watch.observe.observer import Observer, Sample
from coordinator.watch.observe.summary import Summary, summarise
from coordinator.watch.observe.view_json import describe_causes, describe_summary
from coordinator.watch.observe.watcher import count_exchanges
from coordinator.watch.tables import write_json, write_tables
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.partition import Area
from dsse_core.results.results import Results, WithTables
from scenarios.scenario import Scenario


@dataclass(frozen=True, slots=True)
class AreaResult:
    """One area at the verdict; gaps and errors are over every bus that it sees.

    ``quality``: of its last state at the verdict (docs/explanation/quality.md). ``value_age_s``: time since it has
    received the telemetry of its numbers, s. ``fresh``: they are of the present.
    ``notes``: reasons for the quality, the worst first; for a good state, remarks.
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
    value_age_s: float | None
    fresh: bool

    @property
    def degraded(self) -> bool:
        """True where the quality of the state is not good."""
        return self.quality != GOOD


@dataclass(frozen=True, repr=False)
class RunOutcome(WithTables):
    """Everything about one run. ``timing_s``: moments in seconds since the call, on the simulator in virtual time.

    ``faults``: kind -> number of faults, of messages and of processes. ``duplicates``: areas, plants and gateways that
    ran twice at once.

    ``centralised``: None where that estimate failed; ``centralised_failure``: the reason. ``readings``: of all areas.
    ``causes``: of what was wrong at the verdict, the first one first.
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
    readings: Sequence[Measurement] = ()
    causes: tuple[Cause, ...] = ()

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

    @cached_property
    def summary(self) -> Summary:
        """The numbers of the areas at the verdict beside the limits of the scenario."""
        meters = {name: self.meters[name] for name in ("meter", "status", "normalised_residual")}
        fresh = np.zeros(len(self.meters), dtype=bool)
        for area, rows in self.scenario.partition.split_meters(self.scenario.meters).items():
            fresh[rows] = self.areas.fresh[self.areas.area.index(area)]
        return summarise(Tables(self.buses, self.branches, meters | {"fresh": fresh}), GridTables(self.scenario))


@dataclass(frozen=True, repr=False)
class RunResult(RunOutcome):
    """A run with its files in ``folder``; ``unwritten``: the reason that some are missing, None if all are written."""

    folder: Path = field(kw_only=True)
    unwritten: str | None = None

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, files in {str(self.folder)!r}>"


def make_area_results(observer: Observer, comparison: Comparison, now: float) -> tuple[AreaResult, ...]:
    """One row per area, in the scenario's order; ``now``: the time of the verdict on the observer's clock, s."""
    found = []
    for area in observer.partition.areas:
        assessment = observer.assess_area(area.name, now)
        state = observer.watcher.state_of(area.name)
        silent_s = observer.watcher.age_of(area.name, now)
        found.append(make_area_result(area, state, comparison, assessment.quality, assessment.notes, silent_s))
    return tuple(found)


def make_area_result(
    area: Area,
    state: StateMessage | None,
    comparison: Comparison,
    quality: str,
    notes: tuple[str, ...],
    silent_s: float = 0.0,
) -> AreaResult:
    """The row of ``area`` by its last ``state``, received ``silent_s`` ago; None without one."""
    gap, error = comparison.gap_of(area.name), comparison.error_of(area.name)
    estimated = state is not None and bool(state.buses)
    freshness = find_freshness(quality, state.telemetry_age + silent_s if state else math.nan, has_estimate=estimated)
    return AreaResult(
        name=area.name,
        buses=len(area.network.buses),
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
        notes=notes,
        quality=quality,
        value_age_s=freshness.value_age_s if estimated else None,
        fresh=freshness.fresh,
    )


def write_files(result: RunResult, events_failure: str | None) -> RunResult:
    """Write the result's files; the result, with the reason in ``unwritten`` where a file is missing."""
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
        **head_json(result.scenario),
        "run": result.run,
        "verdict": asdict(result.verdict),
        "causes": describe_causes(result.causes),
        "summary": describe_summary(result.summary),
        "areas": {area.name: _area_json(area) for area in result.area_results},
        "centralised": _centralised_json(result),
        "timing_s": dict(result.timing_s),
        "faults": dict(result.faults),
        "duplicates": [asdict(duplicate) for duplicate in result.duplicates],
        **versions_json(),
    }


def _area_json(area: AreaResult) -> dict[str, Any]:
    fields = asdict(area)
    del fields["name"]
    return fields | {"degraded": area.degraded}


def _centralised_json(result: RunOutcome) -> dict[str, Any]:
    report, error = result.centralised, result.comparison.centralised_error
    if report is None:
        return {"failure": result.centralised_failure}
    return {"failure": None, "error_vm_pu": error.vm_pu, "error_va_deg": error.va_deg, **report_as_json(report)}
