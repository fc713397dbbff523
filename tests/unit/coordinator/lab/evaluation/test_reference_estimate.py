"""The centralised estimate that a run is measured against, by the plan that the check of the scenario has made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coordinator.lab.evaluation.evaluation import estimate_centralised
from coordinator.lab.strategy_check import plan_with_strategy
from dsse_core.estimation.plan import EstimationPlan
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry


def plan_of(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> EstimationPlan:
    """As if the grid were large."""
    monkeypatch.setattr("scenarios.check.FEWEST_BUSES_OF_PLAN", 1)
    plan = plan_with_strategy(scenario)
    assert plan is not None
    return plan


def test_a_grid_that_the_check_has_planned_is_not_planned_again(monkeypatch: pytest.MonkeyPatch):
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario)
    without_plan = estimate_centralised(scenario, telemetry).report
    plan = plan_of(scenario, monkeypatch)
    monkeypatch.delattr("dsse_core.estimation.estimator.build_estimation_plan")
    found = estimate_centralised(scenario, replace(telemetry, by_area={}), plan).report
    assert found is not None
    assert without_plan is not None
    assert found.result.plan is plan
    np.testing.assert_array_equal(found.result.vm, without_plan.result.vm)


def test_a_plan_of_all_meters_does_not_stand_for_a_scan_that_lacks_some(monkeypatch: pytest.MonkeyPatch):
    scenario = load_scenario("ieee33", changes={"faults.telemetry.missing": 0.05})
    telemetry = make_telemetry(scenario)
    plan = plan_of(scenario, monkeypatch)
    report = estimate_centralised(scenario, telemetry, plan).report
    assert report is not None
    assert report.n_meters + len(report.removed) == len(telemetry.union) < len(plan.meters)


def test_a_small_grid_is_checked_without_a_plan():
    assert plan_with_strategy(load_scenario("ieee33")) is None


def test_a_grid_too_large_for_one_place_is_no_failure_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9.9 GiB")

    scenario = load_scenario("industrial13")
    telemetry = make_telemetry(scenario)
    monkeypatch.setattr("coordinator.lab.evaluation.evaluation.process_bad_data", fail)
    found = estimate_centralised(scenario, telemetry)
    assert found.report is None
    assert found.failure == "there is not enough memory for it: Unable to allocate 9.9 GiB"
