"""The quality of a published state: what each flag needs, and that it changes as soon as that is gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import HeartbeatMessage
from agents.peers.orders_and_ages import FRESH_HEARTBEATS, PATIENCE_HEARTBEATS
from coordinator.lab.simulator.simulate import Simulation
from dsse_core.errors import NotObservableError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.exact_exchange import assert_equals_centralised, settle_bus
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links
from tests.support.tree_of_areas import tree_scenario

HEARTBEAT_S = 0.2
SOON = (FRESH_HEARTBEATS + 1) * HEARTBEAT_S


@pytest.fixture
def bus() -> SimulatedBus:
    """The three areas of ieee33, at rest."""
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    bus.run_until_settled()
    bus.run(1.0)
    return bus


def five_areas_at_rest(strategy: str) -> SimulatedBus:
    scenario = tree_scenario()
    bus = SimulatedBus(area_files_of(scenario, strategy=strategy), make_telemetry(scenario).by_area)
    bus.run_until_settled()
    bus.run(2.0)
    return bus


def qualities(bus: SimulatedBus) -> dict[str, str]:
    return {name: state.quality for name, state in bus.states.items()}


def second_scan() -> dict:
    return make_telemetry(load_scenario("ieee33"), scan=2).by_area


@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
def test_all_is_good_once_nothing_is_missing(strategy: str):
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, strategy=strategy), make_telemetry(scenario).by_area)
    bus.run_until_settled()
    bus.run(2.0)
    assert set(qualities(bus).values()) == {"good"}
    for state in bus.states.values():
        assert max(state.ages.values()) <= HEARTBEAT_S + 0.01
        assert set(state.scans.values()) == {1}


def test_before_telemetry_there_is_no_estimate_to_evaluate(bus: SimulatedBus):
    bus.plant_publishes = False
    bus.kill("area3")
    bus.start("area3")
    bus.run(0.5)
    assert (bus.states["area3"].buses, bus.states["area3"].quality) == ((), "none")


def test_when_an_area_has_gone_all_are_degraded_at_once_and_good_again_after_its_return(bus: SimulatedBus):
    bus.kill("area2")
    bus.run(0.01)
    assert qualities(bus) == {"area1": "degraded", "area3": "degraded"}
    assert bus.states["area3"].old_sides == ("area1",)
    bus.run(2.0)
    assert bus.states["area1"].ages["area2"] > 1.9
    bus.start("area2")
    bus.run_until_settled()
    bus.run(1.0)
    assert set(qualities(bus).values()) == {"good"}


@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
def test_a_cut_link_degrades_the_whole_feeder_after_three_heartbeats(strategy: str):
    bus = five_areas_at_rest(strategy)
    bus.cut("a", "b")
    bus.run((FRESH_HEARTBEATS - 1) * HEARTBEAT_S)
    assert set(qualities(bus).values()) == {"good"}
    bus.run(2 * HEARTBEAT_S)
    assert set(qualities(bus).values()) == {"degraded"}
    bus.heal("a", "b")
    bus.run(HEARTBEAT_S + 0.02)
    assert set(qualities(bus).values()) == {"good"}


@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
@pytest.mark.parametrize("direction", [("a", "b"), *further(("b", "a"))])
def test_a_link_that_passes_messages_one_way_only_leaves_no_area_good(strategy: str, direction: tuple[str, str]):
    bus = five_areas_at_rest(strategy)
    bus.reject_delivery = lambda sender, receiver, message: (sender, receiver) == direction
    bus.run(
        (2 * PATIENCE_HEARTBEATS + FRESH_HEARTBEATS) * HEARTBEAT_S
    )  # one side falls silent for the other, which then learns so
    assert "good" not in set(qualities(bus).values())
    bus.reject_delivery = lambda sender, receiver, message: False
    bus.run(2 * HEARTBEAT_S)
    assert set(qualities(bus).values()) == {"good"}


def test_an_area_without_telemetry_is_missed_in_the_whole_feeder(bus: SimulatedBus):
    send = bus.send_telemetry
    bus.send_telemetry = lambda name: None if name == "area2" else send(name)
    bus.run(SOON)
    assert qualities(bus) == {"area1": "degraded", "area2": "stale", "area3": "degraded"}
    assert (bus.states["area3"].telemetry_age < HEARTBEAT_S, max(bus.states["area3"].ages.values()) < HEARTBEAT_S) == (
        True,
        True,
    )


def test_what_is_old_far_away_moves_no_estimate_and_changes_no_number():
    bus = five_areas_at_rest("information")
    before = dict(bus.states)
    bus.cut("a", "b")
    bus.run(2.0)
    for name, state in bus.states.items():
        assert (state.header.sequence, state.vm, state.va) == (
            before[name].header.sequence,
            before[name].vm,
            before[name].va,
        )
        assert (state.sent, state.checked) == (before[name].sent, True)


def test_two_lost_repeats_in_a_row_are_no_matter_for_others():
    bus = five_areas_at_rest("information")
    bus.delivered.clear()
    while not [m for _, sender, _, m in bus.delivered if sender == "a" and isinstance(m, HeartbeatMessage)]:
        bus.run(0.01)
    bus.cut("a", "b")
    bus.run(2.5 * HEARTBEAT_S)
    bus.heal("a", "b")
    bus.run(HEARTBEAT_S)
    assert all(m.complete for _, _, _, m in bus.delivered if isinstance(m, HeartbeatMessage))
    assert set(qualities(bus).values()) == {"good"}


def test_the_side_of_the_reference_is_missed_as_soon_as_its_update_is_of_a_former_scan(bus: SimulatedBus):
    """Then the parent's message is no longer used: angles are the area's own, and so are the standard deviations."""
    before = bus.states["area2"]
    bus.kill("area1")
    bus.run(0.1)
    assert qualities(bus)["area2"] == "degraded"  # it still knows the whole scan
    assert bus.states["area2"].sigma_va == before.sigma_va
    bus.next_scan(second_scan())
    bus.run(SOON)
    after = bus.states["area2"]
    assert (after.quality, after.referenced) == ("relative-angle", False)
    assert min(np.array(after.sigma_va) / before.sigma_va) > 2.0
    assert min(np.array(after.sigma_vm) / before.sigma_vm) > 1.0


def test_information_of_a_former_scan_degrades_and_the_sigmas_of_those_who_do_without_are_honest(bus: SimulatedBus):
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario, scan=2)
    bus.cut("area1", "area2")
    bus.next_scan(telemetry.by_area)
    bus.run((PATIENCE_HEARTBEATS + 2) * HEARTBEAT_S)
    central = process_bad_data(scenario.network, telemetry.union).result
    assert set(qualities(bus).values()) == {"degraded", "relative-angle"}
    for state in bus.states.values():
        rows = [central.network.row[b] for b in state.buses]
        assert np.all(abs(np.array(state.vm) - central.vm[rows]) <= 3 * np.array(state.sigma_vm))
        if state.referenced:
            assert np.all(abs(np.array(state.va) - central.va[rows]) <= 3 * np.array(state.sigma_va))


def test_a_silent_plant_makes_every_estimate_stale_visibly(bus: SimulatedBus):
    bus.plant_publishes = False
    bus.run(SOON)
    assert set(qualities(bus).values()) == {"stale"}
    assert all(state.telemetry_age >= FRESH_HEARTBEATS * HEARTBEAT_S for state in bus.states.values())
    assert all(state.oldest_reading >= state.telemetry_age for state in bus.states.values())
    bus.plant_publishes = True
    bus.run(HEARTBEAT_S + 0.01)
    assert set(qualities(bus).values()) == {"good"}


def test_an_area_that_never_receives_telemetry_is_as_long_without_it_as_it_runs():
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    bus.plant_publishes = False
    bus.run(5.0)
    ages = [age for state in bus.states.values() for age in (state.telemetry_age, state.oldest_reading)]
    assert min(ages) >= 5.0 - 2 * HEARTBEAT_S


def test_one_late_area_degrades_those_who_are_ahead_and_itself(bus: SimulatedBus):
    bus.next_scan(second_scan(), late_s={"area2": 2.0})
    bus.run(SOON)
    assert qualities(bus)["area1"] == "degraded"
    assert qualities(bus)["area2"] == "degraded"
    bus.run(2.0)
    assert set(qualities(bus).values()) == {"good"}


def test_what_a_paused_area_says_when_it_wakes_does_not_pass_for_update():
    scenario, shown = load_scenario("ieee33"), []
    files, telemetry = area_files_of(scenario), make_telemetry(scenario).by_area
    bus = SimulatedBus(files, telemetry, on_state=lambda at, state: shown.append(state))
    bus.run_until_settled()
    bus.run(1.0)
    bus.pause("area2")
    bus.next_scan(second_scan())
    bus.run(3.0)
    assert qualities(bus)["area1"] == "degraded"
    shown.clear()
    bus.resume("area2")
    bus.run(1.0)
    assert set(qualities(bus).values()) == {"good"}
    assert not [s for s in shown if s.quality == "good" and s.header.scan == 1]


def test_quality_is_no_change_of_the_state_and_keeps_its_number(bus: SimulatedBus):
    before = bus.states["area1"]
    bus.plant_publishes = False
    bus.run(SOON)
    after = bus.states["area1"]
    assert (before.quality, after.quality) == ("good", "stale")
    assert before.header.sequence == after.header.sequence
    assert after.header.time > before.header.time


def test_with_many_losses_areas_are_good_only_while_they_receive_each_other():
    scenario = tree_scenario()
    shown = []
    files = with_links(area_files_of(scenario, strategy="information"), LinkFaults(loss=0.8))
    bus = SimulatedBus(files, make_telemetry(scenario).by_area, on_state=lambda at, state: shown.append((at, state)))
    bus.run(30.0)
    found = {state.quality for _, state in shown}
    assert {"good", "degraded"} <= found
    for _, state in shown:
        if state.quality == "good":
            assert max(state.ages.values()) < FRESH_HEARTBEATS * HEARTBEAT_S
            assert set(state.scans.values()) == {state.header.scan}


def test_a_contradiction_is_never_good():
    link = [{"from": "area3", "to": "area1", "lie": {"vm_pu": 0.02}}]
    scenario = load_scenario("ieee33", changes={"faults.link": link, "run.timeout_s": 3.0})
    areas = {area.name: area for area in _evaluated(scenario).area_results}
    assert areas["area1"].quality == "degraded"
    assert any("boundary mismatch with area3 at bus 6" in note for note in areas["area1"].notes)
    assert any("boundary mismatch with area1 at bus 6" in note for note in areas["area3"].notes)


def _evaluated(scenario):
    simulation = Simulation(replace(scenario, strategy="information"))
    return simulation.evaluate(simulation.run())


def test_a_scan_whose_readings_do_not_determine_the_state_is_unobservable_and_no_consensus():
    """The only voltmeter is silent: without the buses and the meter named, 0.028 p.u. off would pass for good."""
    changes = {"measurements.voltage.buses": [1], "faults.telemetry.missing": 0.02, "run.timeout_s": 20.0}
    simulation = Simulation(replace(load_scenario("ieee33", changes=changes), seed=14))
    result = simulation.evaluate(simulation.run())
    assert not result.verdict.consensus
    assert "do not determine the state: not observable" in str(result.verdict.reason)
    assert {area.quality for area in result.area_results} == {"unobservable"}
    notes = {area.name: area.notes for area in result.area_results}
    assert any("determines buses 1-6, 7-18, 19-25, 26-33" in note for note in notes["area2"])
    assert "no reading from vm@1" in notes["area1"]


def test_a_dead_only_voltmeter_is_not_believed():
    scenario = load_scenario("ieee33", changes={"measurements.voltage.buses": [1]})
    telemetry = make_telemetry(scenario).by_area
    dead = [replace(m, value=0.45) if m.meter.id == "vm@1" else m for m in telemetry["area1"]]
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), telemetry | {"area1": dead})
    bus.run(1.0)
    assert set(qualities(bus).values()) == {"unobservable"}
    assert any("left out as dead: vm@1" in note for note in bus.states["area1"].notes)
    assert not any(state.removed for state in bus.states.values())


def _cut(bus: SimulatedBus) -> None:
    bus.cut("area1", "area2")


def _kill(bus: SimulatedBus) -> None:
    bus.kill("area2")


def _pause(bus: SimulatedBus) -> None:
    bus.pause("area3")


def _silence_plant(bus: SimulatedBus) -> None:
    bus.plant_publishes = False


def _begin_scan_late(bus: SimulatedBus) -> None:
    bus.next_scan(second_scan(), late_s={"area2": 2.0})


def _lack_readings(bus: SimulatedBus) -> None:
    telemetry = second_scan()
    bus.next_scan(telemetry | {"area2": [m for m in telemetry["area2"] if m.meter.branch != "7-8"]})


def _be_unobservable(bus: SimulatedBus) -> None:
    telemetry = second_scan()
    bus.next_scan(
        {area: [m for m in read if m.meter.kind is not MeasurementKind.VM] for area, read in telemetry.items()}
    )


DISTURBANCES = (_cut, _kill, _pause, _silence_plant, _begin_scan_late, _lack_readings, _be_unobservable)
REMARKS = ("no reading from ",)  # they do not take good away


@pytest.mark.parametrize("strategy", ["information", *further("angle-offset", "admm")])
@pytest.mark.parametrize("disturb", DISTURBANCES, ids=lambda disturb: disturb.__name__.strip("_"))
def test_no_state_is_less_than_good_without_a_reason_nor_good_with_one(strategy: str, disturb):
    scenario, shown = load_scenario("ieee33"), []
    bus = SimulatedBus(
        area_files_of(scenario, strategy=strategy),
        make_telemetry(scenario).by_area,
        on_state=lambda at, state: shown.append(state),
    )
    bus.run(1.0)
    disturb(bus)
    bus.run(3.0)
    assert {"good"} < {state.quality for state in shown}
    for state in shown:
        reasons = [note for note in state.notes if not note.startswith(REMARKS)]
        assert (state.quality == "good") == (not reasons), (state.quality, state.notes)
        assert (state.quality in ("none", "unobservable")) == (not state.buses)
        assert state.quality in ("none", "unobservable", "stale") or state.referenced == (
            state.quality != "relative-angle"
        )


def with_readings(change: Callable[[Measurement], float]) -> SimulatedBus:
    """The areas of ieee33 at rest with other readings."""
    scenario = load_scenario("ieee33")
    read = make_telemetry(scenario).by_area
    changed = {area: [replace(m, value=change(m)) for m in found] for area, found in read.items()}
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), changed)
    bus.run(2.0)
    return bus


def test_an_area_that_had_to_remove_a_large_share_of_its_meters_is_degraded_and_says_how_many():
    wrong = {f"{kind}@{bus}:{bus}-{bus + 1}" for kind in ("p_flow", "q_flow") for bus in range(7, 15)}
    bus = with_readings(lambda m: m.value + 50 * m.sigma * (m.meter.id in wrong))
    for name, state in bus.states.items():
        meters = [m for m in bus.files[name].meters if m.source is not Source.VIRTUAL]
        is_much = len(state.removed) > 0.2 * len(meters)
        assert is_much == any("meters are removed, more than 20 %" in note for note in state.notes)
        assert state.quality != "good" or not is_much
    assert any("meters are removed" in note for note in bus.states["area2"].notes)


def test_voltages_outside_the_band_of_the_scenario_are_degraded_and_named():
    scenario = load_scenario("ieee33", changes={"quality.lowest_vm_pu": 0.92})
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    bus.run(1.0)
    for state in bus.states.values():
        low = [bus_id for bus_id, vm in zip(state.buses, state.vm, strict=True) if vm < 0.92]
        assert (state.quality == "degraded") == bool(low)
        if low:
            assert state.notes[0].startswith(f"voltages of {len(low)} buses are outside 0.92 to 1.5 p.u., the farthest")
    assert {state.quality for state in bus.states.values()} == {"good", "degraded"}


@pytest.mark.parametrize(
    "dead", [{"vm@1": 0.45}, {"vm@16": 0.0}, {"vm@6": 0.3, "vm@33": 0.499}, {"vm@1": 0.0, "vm@6": 0.2, "vm@16": 0.4}]
)
@pytest.mark.parametrize("voltmeters", [[1, 6, 16, 33], [1, 6], [1]])
def test_dead_voltmeters_are_left_out_by_areas_and_centre_alike_or_it_is_not_observable(dead, voltmeters):
    """Bus 6 lies between two areas. The centre and the areas name the same meters, and find the same state."""
    scenario = tree_scenario()
    others = [meter for meter in scenario.meters if meter.kind is not MeasurementKind.VM]
    scenario = replace(scenario, meters=(*others, *(Meter(MeasurementKind.VM, k) for k in voltmeters)))
    telemetry = make_telemetry(scenario)
    readings = [replace(m, value=dead.get(m.meter.id, m.value)) for m in telemetry.union]
    left_out = {m.meter.id for m in readings} & dead.keys()
    by_area = {
        name: [replace(m, value=dead.get(m.meter.id, m.value)) for m in own] for name, own in telemetry.by_area.items()
    }
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), by_area)
    if left_out == {f"vm@{k}" for k in voltmeters}:
        bus.run(1.0)
        with pytest.raises(NotObservableError) as caught:
            process_bad_data(scenario.network, readings)
        assert {text.split()[0] for text in caught.value.left_out} == left_out
        assert set(qualities(bus).values()) == {"unobservable"}
        notes = " ".join(note for state in bus.states.values() for note in state.notes)
        assert all(meter in notes for meter in left_out)
        return
    settle_bus(bus)
    report = process_bad_data(scenario.network, readings, tolerance=1e-11)
    assert {removed.measurement.meter.id for removed in report.removed} == left_out
    assert_equals_centralised(bus, report)
