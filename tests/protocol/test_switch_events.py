"""Switches that a scenario operates: the truth, its readings, the status that is read, and the verdict on all of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.packing import Header, Incarnation, StateMessage, TelemetryMessage
from agents.protocol.events import Ordered
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.lab.simulator.simulate import Simulation
from coordinator.lab.simulator.simulator import STARTED_AT
from scenarios.faults.faults import FaultEvent
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry
from tests.support.rings import ACROSS, TIES, tied33
from tests.support.simulated_bus import SimulatedBus, area_files_of

pytestmark = pytest.mark.long


def simulate(*events: FaultEvent) -> tuple[RunOutcome, dict[str, StateMessage]]:
    """ieee33 in three areas with ``events``, until the verdict."""
    scenario: Scenario = tied33(3, (), switches=(*TIES, *ACROSS))
    simulation = Simulation(replace(scenario, faults=replace(scenario.faults, events=events)))
    reason = simulation.run()
    return simulation.evaluate(reason), simulation._bus.states


def event(at_s: float, switch: str, to: str, late_s: float = 0.0, status: str = "") -> FaultEvent:
    return FaultEvent(at_s, "switch", (switch,), late_s, to, status)


CASES = {
    "fed from another side": ((event(1.0, "18-33", "closed"), event(1.5, "12-13", "open")), ()),
    "known late": ((event(0.1, "18-33", "closed", 0.2),), ()),
    "dead": ((event(1.0, "28-29", "open"),), (29, 30, 31, 32, 33)),
    "energised again": ((event(1.0, "28-29", "open"), event(3.0, "28-29", "closed")), ()),
}


@pytest.mark.parametrize("name", CASES)
def test_areas_follow_switches_and_the_verdict_compares_with_the_grid_as_it_is(name):
    events, dead = CASES[name]
    outcome, states = simulate(*events)
    comparison = outcome.comparison
    assert outcome.verdict.consensus, outcome.verdict
    assert comparison.gap.vm_pu < 1e-9
    assert comparison.error.vm_pu < 0.005
    assert {state.quality for state in states.values()} == {"good"}
    row = outcome.scenario.network.row
    assert {bus for bus in row if comparison.truth.vm[row[bus]] == 0} == set(dead)
    assert {bus for bus in row if comparison.decentralised.vm[row[bus]] == 0} == set(dead)


def test_a_status_that_lies_is_named_by_all_and_estimates_and_reference_rest_on_the_other_one():
    outcome, states = simulate(event(1.0, "18-33", "closed", status="open"))
    assert outcome.comparison.gap.vm_pu < 1e-9
    assert outcome.comparison.error.vm_pu < 0.005
    assert next(state.switches["18-33"] for state in states.values() if "18-33" in state.switches) == "closed"
    assert {state.quality for state in states.values()} == {"degraded"}
    assert all("switch@18-33 counts the other way" in state.notes[0] for state in states.values())
    assert outcome.centralised.removed == ()
    assert not outcome.centralised.detected


def test_a_status_that_nobody_knows_takes_good_from_its_area_and_is_named():
    _, states = simulate(event(1.0, "18-33", "closed", status="unknown"))
    notes = {name: note for name, state in states.items() for note in state.notes if "18-33 unknown" in note}
    assert list(notes.values()) == ["status of switch 18-33 unknown: gateway plant reads unknown; it stays as it was"]
    taken = [name for name, state in states.items() if "switch@18-33 counts the other way" in state.notes[0]]
    assert taken == [*states]  # as the readings contradict what it was


def test_a_status_that_a_gateway_reads_begins_a_new_term_of_the_scan_and_an_order_against_it_is_named():
    scenario = tied33(3, (), switches=TIES)
    gateways = {"plant": "all", "rtu": ("status@18-33",)}
    rules = {name: replace(of_area, gateways=gateways) for name, of_area in scenario.reading_rules.items()}
    bus = SimulatedBus(area_files_of(replace(scenario, reading_rules=rules)), make_telemetry(scenario).by_area)
    bus.run(2.0)
    holder = next(name for name, content in bus.files.items() if "18-33" in content.area.network.switches)
    header = Header(bus.files[holder].run, "rtu", Incarnation(1, 1), 1, 1, STARTED_AT + bus.now)
    columns = ("status@18-33",), (1.0,), (0.0,), (header.time,), (True,)
    bus.next_scan(make_telemetry(scenario, closed={"18-33": True}).by_area)
    bus.publish_readings(TelemetryMessage(header, holder, *columns))
    bus.run(2.0)
    assert bus.states[holder].switches["18-33"] == "closed"
    assert {state.quality for state in bus.states.values()} == {"good"}
    bus.post(holder, Ordered((5, 6, 1), (), switches={"18-33": False}))
    bus.run(2.0)
    assert bus.states[holder].switches["18-33"] == "closed"
    told = "gateway rtu reads closed, the operator has ordered open"
    assert f"status of switch 18-33 unknown: {told}; it stays as it was" in bus.states[holder].notes
