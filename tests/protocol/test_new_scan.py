"""Rounds when a new scan begins: how many messages it takes, who waits for whom, and what is shown."""

import numpy as np
import pytest
from exact_exchange import settle_bus
from feeders import make_feeder
from simulated_bus import SimulatedBus, area_files_of

from agents.messages import DownMessage, UpMessage
from agents.scan_readings import DEADLINE_BEATS
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

BEAT = 0.2
WARM, COLD = 3, 4  # rounds that a scan takes, each of one message in either direction


def new_scan(**changes):
    """ieee33 at rest when a new scan begins, and what is delivered and shown from then on."""
    scenario = load_scenario("ieee33")
    shown = []
    files = area_files_of(scenario, strategy="information")
    bus = SimulatedBus(files, make_telemetry(scenario).by_area, on_state=lambda at, state: shown.append((at, state)))
    settle_bus(bus)
    bus.delivered.clear()
    shown.clear()
    bus.next_scan(make_telemetry(scenario, scan=2).by_area, **changes)
    return bus, shown


def rounds_of(bus):
    return [m for *_, m in bus.delivered if isinstance(m, UpMessage | DownMessage)]


def test_a_new_scan_takes_three_rounds_and_each_area_shows_its_state_once():
    bus, shown = new_scan()
    bus.run(0.1)
    assert len(rounds_of(bus)) == 2 * 2 * WARM  # two boundaries, both directions
    of_scan = [state for _, state in shown if state.header.scan == 2]
    assert {state.header.sender for state in of_scan} == {"area1", "area2", "area3"}
    for state in of_scan:
        first = next(s for s in of_scan if s.header.sender == state.header.sender)
        np.testing.assert_array_equal(state.vm, first.vm)
    assert {state.quality for state in bus.states.values()} == {"good"}


@pytest.mark.parametrize("n_area", [10, 60])
def test_areas_in_a_row_take_no_more_rounds_than_a_few(n_area):
    feeder = make_feeder(1, n_bus=n_area + 1, n_area=n_area + 1, shape=1.0)
    bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
    settle_bus(bus)
    assert len(feeder.partition.areas) == n_area
    assert {m.k for m in rounds_of(bus)} == set(range(COLD))
    bus.delivered.clear()
    bus.next_scan(feeder.telemetry())
    settle_bus(bus)
    assert {m.k for m in rounds_of(bus)} <= set(range(WARM))


def test_who_gets_its_readings_late_is_waited_for_until_the_deadline():
    bus, shown = new_scan(late_s={"area3": 0.5 * DEADLINE_BEATS * BEAT})
    bus.run(DEADLINE_BEATS * BEAT)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}
    assert not any("no readings" in note for _, state in shown for note in state.notes)


def test_who_gets_its_readings_after_the_deadline_is_first_done_without_and_then_counted():
    bus, _ = new_scan(late_s={"area3": 2 * DEADLINE_BEATS * BEAT})
    bus.run(1.5 * DEADLINE_BEATS * BEAT)
    qualities = {name: state.quality for name, state in bus.states.items()}
    assert qualities == {"area1": "degraded", "area2": "degraded", "area3": "stale"}
    assert "no readings of this scan in area3" in bus.states["area1"].notes
    bus.run(DEADLINE_BEATS * BEAT)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}
