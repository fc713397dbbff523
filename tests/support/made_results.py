"""Results of runs that were never run: every area says what the centralised estimate does, or a little less."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.messages.packing import Incarnation, StateMessage
from coordinator.lab.evaluation.comparison import compare
from coordinator.lab.evaluation.result import RunResult, make_area_results
from coordinator.lab.evaluation.verdict import make_verdict
from coordinator.watch.observe.observer import Observer
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.partition import Area
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry
from tests.support.shown_states import published_by

GAPS = (1e-3, 1e-6, 1e-9)  # p.u., of the states that each area publishes
AT_S = (0.5, 1.0, 3.0)
SCAN_AT_S = 0.25


def make_result(scenario: Scenario, folder: Path) -> RunResult:
    """Areas publish at ``AT_S``, off by ``GAPS``; their standard deviations are the centralised ones."""
    telemetry = make_telemetry(scenario)
    central = process_bad_data(scenario.network, telemetry.union)
    buses = results_of_estimate(central).buses
    sigma = np.array([buses.sigma_vm_pu, np.radians(buses.sigma_va_deg)])
    observer = Observer("run", scenario.partition, 1e-6, 1e-6, 0.2, False)
    for number, (at, gap) in enumerate(zip(AT_S, GAPS, strict=True), start=1):
        for area in scenario.partition.areas:
            rows = [scenario.network.row[bus.id] for bus in area.network.buses]
            state = _publish(area, central.result.vm[rows] + gap, central.result.va[rows], sigma[:, rows], number)
            observer.take_presence(area.name, True, 0.0)
            observer.take_state(state, at)
    comparison = compare(scenario.partition, observer.states, telemetry.truth, central)
    return RunResult(
        scenario=scenario,
        run="run",
        folder=folder,
        verdict=make_verdict(observer, comparison, None, 4.0),
        area_results=make_area_results(observer, comparison, now=0.0),
        comparison=comparison,
        centralised=central,
        centralised_failure=None,
        history=tuple(observer.history),
        timing_s={"verdict": 4.0, "plant_started": SCAN_AT_S},
        faults={},
        duplicates=(),
        readings=telemetry.union,
    )


def _publish(area: Area, vm: np.ndarray, va: np.ndarray, sigma: np.ndarray, number: int) -> StateMessage:
    state = published_by(
        area.name,
        Incarnation(1, 1),
        buses=tuple(bus.id for bus in area.network.buses),
        vm=tuple(vm.tolist()),
        va=tuple(va.tolist()),
        sigma_vm=tuple(sigma[0].tolist()),
        sigma_va=tuple(sigma[1].tolist()),
        ages={},
    )
    return replace(state, header=replace(state.header, sequence=number))
