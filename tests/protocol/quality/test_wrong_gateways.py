"""A gateway that is wrong as a whole is named by its area, and no area is good; sound ones are not named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.strategies.installed import list_strategies
from benchmarks.wrong_gateways import SCENARIOS, find_named, run_sound, run_wrong, spoil
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of

AREAS = ("area1", "area2", "area3")


@pytest.mark.random_cases(few=1, long=3, many=45)
@pytest.mark.parametrize("what", ["sign", "x 0.001"])
def test_a_gateway_with_a_wrong_sign_or_unit_is_named_within_ten_scans_under_any_load(what: str, random_seed: int):
    scan, another, _ = run_wrong(SCENARIOS[random_seed % len(SCENARIOS)], what, random_seed + 1)
    assert scan is not None
    assert not another


@pytest.mark.random_cases(few=1, long=3, many=9)
def test_a_sound_gateway_is_not_named_under_any_load(random_seed: int):
    counts = run_sound(SCENARIOS[random_seed % len(SCENARIOS)], 6, random_seed + 1)
    assert counts["false alarms"] == 0
    assert counts["scans"] == 6


@pytest.mark.parametrize("strategy", list_strategies())
def test_it_is_named_under_every_strategy_until_it_is_right_again(strategy: str):
    scenario = replace(load_scenario("ieee33"), strategy=strategy)
    readings = dict(make_telemetry(scenario).by_area)
    bus = SimulatedBus(area_files_of(scenario), readings)
    bus.run(1.5)
    assert find_named(bus) == {}
    bus.next_scan(spoil(readings, "area2", -1.0))
    bus.run(1.5)
    assert find_named(bus).keys() == {"area2"}
    assert "gateway plant look wrong, sign" in find_named(bus)["area2"]
    assert "good" not in {state.quality for state in bus.states.values()}
    for _ in range(2):
        bus.next_scan(readings)
        bus.run(1.5)
    assert find_named(bus) == {}


def test_a_single_bad_meter_is_no_wrong_gateway():
    scenario = load_scenario("ieee33")
    readings = dict(make_telemetry(scenario).by_area)
    bad = "p_flow@6:6-7"
    readings["area2"] = [replace(m, value=-m.value) if m.meter.id == bad else m for m in readings["area2"]]
    bus = SimulatedBus(area_files_of(scenario), readings)
    bus.run(1.5)
    assert find_named(bus) == {}
    assert bus.states["area2"].removed == (bad,)
    assert {state.quality for state in bus.states.values()} == {"good"}
