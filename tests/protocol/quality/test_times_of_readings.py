"""Stated times of readings where a gateway numbers scans: a reading of another time than its scan is left out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from coordinator.lab.simulator.simulator import STARTED_AT
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of

DAY_S = 86_400.0
TIMES = {"last year": -365 * DAY_S, "1970": -STARTED_AT, "six scans before": -6.0, "tomorrow": DAY_S}
AREAS = ("area1", "area2", "area3")


def make_bus(scan_s: float | None = 1.0) -> SimulatedBus:
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, scan_s=scan_s), make_telemetry(scenario).by_area)
    bus.run(0.7)
    return bus


def next_scan(bus: SimulatedBus, measured_at: dict[str, float] | None = None) -> None:
    bus.next_scan(make_telemetry(load_scenario("ieee33"), bus.scan + 1).by_area, measured_at=measured_at)
    bus.run(0.7)


def qualities(bus: SimulatedBus) -> dict[str, str]:
    return {name: state.quality for name, state in bus.states.items()}


@pytest.mark.parametrize("when", TIMES)
def test_a_reading_of_another_time_is_left_out_and_takes_good(when: str):
    bus = make_bus()
    next_scan(bus, {"vm@16": bus.now + TIMES[when]})
    state, reason = bus.states["area2"], "time in the future" if TIMES[when] > 0 else "measured long before its scan"
    assert state.quality == "degraded"
    assert state.notes[0] == f"{reason}: the newest reading of vm@16"
    assert state.rejected == {reason: 1}
    assert "vm@16" not in bus.readings["area2"].meters
    next_scan(bus)
    assert qualities(bus) == dict.fromkeys(AREAS, "good")


@pytest.mark.parametrize("when", ["last year", "1970", "tomorrow"])
@pytest.mark.parametrize("scan_s", [None, 1.0])
def test_where_all_readings_of_an_area_are_of_another_time_no_area_is_good(when: str, scan_s: float | None):
    bus = make_bus(scan_s)
    next_scan(bus, {meter: bus.now + TIMES[when] for meter in bus.readings["area2"].meters})
    assert "good" not in qualities(bus).values()
    assert any("the newest reading of" in note for note in bus.states["area2"].notes)


def test_the_time_counts_under_asynchronous_strategies_too():
    scenario = replace(load_scenario("ieee33"), strategy="angle-offset")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    bus.run(2.0)
    assert bus.states["area2"].quality == "good"
    next_scan(bus, {"vm@16": bus.now - DAY_S})
    assert bus.states["area2"].quality == "degraded"


@pytest.mark.parametrize(("off_s", "words"), [(-3600.0, "3600 s behind"), (30.0, "30 s ahead of")])
def test_a_leader_whose_clock_is_off_is_named(off_s: float, words: str):
    bus = make_bus()
    message = bus.telemetry_of("area2")
    header = replace(message.header, scan=2, sequence=2, time=STARTED_AT + bus.now + off_s)
    bus._take_over("area2", replace(message, header=header, times=(header.time,) * len(message.times)))
    bus.run(0.7)
    assert f"the clock of plant is {words} that of this area; one of the two is wrong" in bus.states["area2"].notes
    assert bus.states["area2"].quality != "good"


def test_a_scan_that_is_held_stays_good_and_an_area_that_starts_later_takes_it():
    bus = make_bus()
    bus.run(20.0)
    bus.kill("area2")
    bus.start("area2")
    bus.run(3.0)
    assert qualities(bus) == dict.fromkeys(AREAS, "good")
