"""A verdict on a run in which the operator has switched meters off."""

from __future__ import annotations

from dataclasses import replace

from coordinator.lab.evaluation.used_readings import UsedReadings
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.shown_states import a_state


def test_a_run_is_not_compared_with_readings_of_meters_that_are_off():
    scenario = load_scenario("industrial13")
    telemetry, used = make_telemetry(scenario), UsedReadings(scenario)
    states = {name: a_state() for name in ("area1", "area2")}
    assert used.put_into(telemetry, states) is telemetry
    off = next(m.meter.id for m in telemetry.by_area["area2"] if m.meter.id.startswith("vm@"))
    states["area2"] = replace(states["area2"], meters_off=(off,))
    without = used.put_into(telemetry, states)
    assert [m for m in telemetry.union if m not in without.union] == [m for m in telemetry.union if m.meter.id == off]
    assert len(without.by_area["area2"]) == len(telemetry.by_area["area2"]) - 1
    assert without.by_area["area1"] == telemetry.by_area["area1"]
