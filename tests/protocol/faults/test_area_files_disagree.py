"""Area files that contradict each other, as after an edit by hand: nobody waits for ever, both sides name it."""

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.grid.partition import Neighbour
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of

LONG_S = 10.0  # several times the patience


def run_edited(edit, name, strategy="information"):
    """ieee33 with ``edit`` made in the area file of ``name``: its states after the patience."""
    scenario = load_scenario("ieee33")
    files = area_files_of(scenario, strategy=strategy)
    files = [replace(f, area=edit(f.area)) if f.area.name == name else f for f in files]
    bus = SimulatedBus(files, make_telemetry(scenario).by_area)
    bus.run(LONG_S)
    return bus.states


def end_of_hub(files):
    """The hub, and an area that names it."""
    hub = next(f.area for f in files if f.area.towards_hub is None)
    return hub.name, next(f.area.name for f in files if f.area.towards_hub == hub.name)


def assert_both_name(states, one, other, key):
    for name, problem in ((one, other), (other, one)):
        assert states[name].quality in {"degraded", "relative-angle"}
        assert np.isfinite(states[name].vm).all()
        assert len(states[name].vm) > 0
        assert any(problem in note and key in note for note in states[name].notes), states[name].notes
        assert states[name].rejected["contradicts the area file"] > 0


def test_a_boundary_where_neither_side_looks_towards_the_hub_blocks_nobody_and_both_name_it():
    hub, child = end_of_hub(area_files_of(load_scenario("ieee33")))
    states = run_edited(lambda area: replace(area, towards_hub=None), child)
    assert_both_name(states, hub, child, "exchange.towards_hub")


def test_a_boundary_where_both_sides_look_towards_the_hub_blocks_nobody_and_both_name_it():
    hub, child = end_of_hub(area_files_of(load_scenario("ieee33")))
    states = run_edited(lambda area: replace(area, towards_hub=child), hub)
    assert_both_name(states, hub, child, "exchange.towards_hub")


@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
def test_areas_that_disagree_on_their_number_are_not_good_and_name_it(strategy):
    states = run_edited(lambda area: replace(area, n_areas=4), "area1", strategy)
    other = next(n.area for f in area_files_of(load_scenario("ieee33")) for n in f.area.neighbours if n.area != "area1")
    assert {state.quality for state in states.values()}.isdisjoint({"good"})
    assert any("exchange.areas is 4 here and 3" in note for note in states["area1"].notes)
    assert any("exchange.areas is 3 here and 4" in note for note in states[other].notes)


def test_areas_with_different_bases_do_not_take_each_others_numbers():
    states = run_edited(
        lambda area: replace(area, network=replace(area.network, base_mva=2 * area.network.base_mva)), "area1"
    )
    assert {state.quality for state in states.values()}.isdisjoint({"good"})
    assert any("network.base_mva" in note for note in states["area1"].notes)


def test_a_boundary_where_both_sides_are_the_parents_child_is_named():
    def turn(area):
        first, last = area.neighbours
        return replace(area, neighbours=tuple(Neighbour(n.area, n.bus, not n.is_parent) for n in (first, last)))

    middle = next(f.area.name for f in area_files_of(load_scenario("ieee33")) if len(f.area.neighbours) == 2)
    states = run_edited(turn, middle)
    assert any("neighbour.is_parent" in note for note in states[middle].notes)
    assert {state.quality for state in states.values()}.isdisjoint({"good"})


@pytest.mark.parametrize("other", ["angle-offset", "admm"])
def test_a_neighbour_of_another_strategy_keeps_no_scan_from_its_end_and_is_named(other):
    scenario = load_scenario("ieee33")
    files = [replace(f, strategy=other) if f.area.name == "area2" else f for f in area_files_of(scenario)]
    bus = SimulatedBus(files, make_telemetry(scenario).by_area)
    bus.run(LONG_S)
    (note,) = [note for note in bus.states["area1"].notes if "rejected" in note]
    expected = "area2 is rejected: strategy is 'information' here and another in the area file of area2; correct one"
    assert note.startswith(expected)
    assert bus.states["area1"].rejected["contradicts the area file"] > 0
    assert {state.quality for state in bus.states.values()} == {"degraded", "relative-angle"}
    bus.next_scan(make_telemetry(scenario, scan=2).by_area)
    bus.run(LONG_S)
    assert {bus.states[name].header.scan for name in ("area1", "area3")} == {2}


def test_a_neighbour_that_returns_with_the_strategy_of_all_is_taken_back():
    scenario = load_scenario("ieee33")
    files = area_files_of(scenario)
    wrong = [replace(f, strategy="admm") if f.area.name == "area2" else f for f in files]
    bus = SimulatedBus(wrong, make_telemetry(scenario).by_area)
    bus.run(LONG_S)
    bus.kill("area2")
    bus.files["area2"] = next(f for f in files if f.area.name == "area2")
    bus.start("area2")
    bus.send_telemetry("area2")
    bus.run(LONG_S)
    assert {state.quality for state in bus.states.values()} == {"good"}
