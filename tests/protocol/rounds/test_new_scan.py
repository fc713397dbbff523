"""Rounds when a new scan begins: how many messages it takes, who waits for whom, and what is shown."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import DownMessage, Header, Incarnation, LoadMessage, UpMessage
from agents.protocol.numbering import ScanReadings
from agents.protocol.readings import DEADLINE_HEARTBEATS
from coordinator.lab.plant.telemetry_messages import make_message
from coordinator.lab.simulator import simulator
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.exact_exchange import settle_bus
from tests.support.feeders import make_feeder
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of

HEARTBEAT_S = 0.2
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


def test_a_finished_scan_is_shown_where_the_readings_of_the_next_one_wait_already():
    expected, _ = new_scan()
    expected.run(1.0)
    bus, shown = new_scan()
    bus.run(0.001)  # all areas are in the second scan, none is at its end
    assert {state.header.scan for state in bus.states.values()} == {1}
    bus.next_scan(make_telemetry(load_scenario("ieee33"), scan=3).by_area)
    bus.run(1.0)
    assert {state.header.scan for state in bus.states.values()} == {3}
    for name, state in expected.states.items():
        of_area = [s for _, s in shown if s.header.sender == name and s.header.scan == 2]
        assert any(np.allclose(s.vm, state.vm, rtol=0.0, atol=1e-9) for s in of_area), name


def test_a_scan_under_way_is_not_shown_and_its_end_no_more_than_twice():
    bus, shown = new_scan()
    bus.run(0.1)
    assert {state.header.scan for _, state in shown} == {2}
    assert max(Counter(state.header.sender for _, state in shown).values()) <= 2  # at its end, and when all agree


def test_a_scan_that_does_not_end_takes_good_from_all_at_the_heartbeat():
    bus, _ = new_scan()
    bus.reject_delivery = lambda sender, receiver, message: isinstance(message, UpMessage)
    bus.run(1.5 * HEARTBEAT_S)
    assert {state.quality for state in bus.states.values()} == {"degraded"}


def loads_of(bus):
    return {(sender, receiver): m for _, sender, receiver, m in bus.delivered if isinstance(m, LoadMessage)}


def test_no_load_message_delays_a_message_of_a_round():
    bus, shown = new_scan()
    while {state.quality for _, state in shown[-3:]} != {"good"}:
        bus.run(0.001)
    assert len(rounds_of(bus)) == 2 * 2 * WARM
    assert not loads_of(bus)
    bus.run(2 * HEARTBEAT_S)
    boundaries = {("area1", "area2"), ("area2", "area1"), ("area1", "area3"), ("area3", "area1")}
    assert loads_of(bus).keys() == boundaries
    assert {m.header.scan for m in loads_of(bus).values()} == {2}


def test_the_first_load_messages_come_before_the_end_of_the_first_scan_and_after_the_messages_of_its_first_round():
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    while any(protocol.outcome is None for protocol in bus.protocols.values()):
        bus.run(0.001)
    assert len(loads_of(bus)) == 4
    for sender in ("area2", "area3"):
        kinds = [type(m) for _, a, _, m in bus.delivered if a == sender and isinstance(m, UpMessage | LoadMessage)]
        assert kinds[0] is UpMessage


def test_load_messages_of_a_scan_that_does_not_end_come_at_the_heartbeat():
    bus, _ = new_scan()
    bus.reject_delivery = lambda sender, receiver, message: isinstance(message, UpMessage)
    bus.run(1.5 * HEARTBEAT_S)
    assert all(protocol.outcome is None for protocol in bus.protocols.values())
    assert {m.header.scan for m in loads_of(bus).values()} == {2}


@pytest.mark.parametrize("n_area", [10, *further(60)])
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
    bus, shown = new_scan(late_s={"area3": 0.5 * DEADLINE_HEARTBEATS * HEARTBEAT_S})
    bus.run(DEADLINE_HEARTBEATS * HEARTBEAT_S)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}
    assert not any("no readings" in note for _, state in shown for note in state.notes)


def test_who_gets_its_readings_after_the_deadline_is_first_done_without_and_then_counted():
    bus, _ = new_scan(late_s={"area3": 2 * DEADLINE_HEARTBEATS * HEARTBEAT_S})
    bus.run(1.5 * DEADLINE_HEARTBEATS * HEARTBEAT_S)
    qualities = {name: state.quality for name, state in bus.states.items()}
    assert qualities == {"area1": "degraded", "area2": "degraded", "area3": "stale"}
    assert "no readings of this scan in area3" in bus.states["area1"].notes
    bus.run(DEADLINE_HEARTBEATS * HEARTBEAT_S)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}


def test_readings_that_a_newer_scan_has_replaced_unread_are_not_waited_for():
    bus, shown = new_scan(late_s={"area3": np.inf})
    bus.run(0.01)
    assert {state.header.scan for state in bus.states.values()} == {1}  # area3 may still get its readings
    scenario = load_scenario("ieee33")
    bus.next_scan(make_telemetry(scenario, scan=3).by_area, late_s={"area1": np.inf, "area2": np.inf})
    bus.run(0.25 * DEADLINE_HEARTBEATS * HEARTBEAT_S)
    of_scan = {state.header.sender: state for _, state in reversed(shown) if state.header.scan == 2}  # the first ones
    assert of_scan.keys() == {"area1", "area2", "area3"}
    assert of_scan["area3"].quality == "stale"
    assert "no readings of this scan; the last ones stand in" in of_scan["area3"].notes
    assert "no readings of this scan in area3" in of_scan["area1"].notes


def test_the_newest_readings_stand_in_for_those_that_are_lost():
    content = next(f for f in area_files_of(load_scenario("ieee33")) if f.area.name == "area3")
    readings = ScanReadings(content, 0.0)
    for scan in (1, 3):
        header = Header("sim", "plant", Incarnation(1, 1), scan, scan, 0.0)
        telemetry = make_telemetry(load_scenario("ieee33"), scan=scan).by_area["area3"]
        readings.take(make_message(header, "area3", telemetry), now=0.1)
        if scan == 1:
            readings.enter(1, 0.1)
            readings.enter(2, 0.2)
            assert readings.deadline > 0.2
    assert readings.deadline <= 0.2
    readings.go_on_without(0.2)
    newest = {m.meter.id: m.value for m in telemetry}
    assert all(newest[m.meter.id] == m.value for m in readings.readings.measurements if m.meter.id in newest)
    assert readings.stale
    readings.enter(3, 0.3)
    assert readings.are_there
    assert not readings.stale


def test_where_the_time_between_scans_is_known_nobody_is_waited_for_longer_than_a_quarter_of_it():
    scan_s = 2 * DEADLINE_HEARTBEATS * HEARTBEAT_S
    files = area_files_of(load_scenario("ieee33"), strategy="information", scan_s=scan_s)
    telemetry = make_telemetry(load_scenario("ieee33")).by_area
    bus = SimulatedBus(files, telemetry)
    settle_bus(bus)
    bus.next_scan(telemetry, late_s={"area3": 0.6 * scan_s})
    bus.run(0.2 * scan_s)
    assert bus.states["area1"].header.scan == 1
    bus.run(0.1 * scan_s)
    qualities = {name: state.quality for name, state in bus.states.items()}
    assert qualities == {"area1": "degraded", "area2": "degraded", "area3": "stale"}
    bus.run(0.5 * scan_s)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}


@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
def test_a_reading_that_is_marked_invalid_moves_no_estimate_and_is_named(strategy, monkeypatch):
    files = area_files_of(load_scenario("ieee33"), strategy=strategy)
    telemetry = make_telemetry(load_scenario("ieee33")).by_area
    bad = next(m.meter.id for m in telemetry["area2"] if m.meter.id.startswith("p_inj"))
    without = telemetry | {"area2": [m for m in telemetry["area2"] if m.meter.id != bad]}
    expected = SimulatedBus(files, without)
    expected.run_until_settled()

    def mark(*made_of):
        message = make_message(*made_of)
        values = tuple(
            9.0 if name == bad else value for name, value in zip(message.meters, message.values, strict=True)
        )
        return replace(message, values=values, valid=tuple(name != bad for name in message.meters))

    monkeypatch.setattr(simulator, "make_message", mark)
    bus = SimulatedBus(files, telemetry)
    bus.run_until_settled()
    for name, state in bus.states.items():
        np.testing.assert_allclose(state.vm, expected.states[name].vm, atol=1e-9)
    assert f"marked invalid: the reading of {bad}" in bus.states["area2"].notes
    assert bus.states["area2"].rejected["marked invalid"] >= 1
    assert not any("no reading from" in note for note in bus.states["area2"].notes)
