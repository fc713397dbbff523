"""Consensus ADMM: its fixed point is the centralised estimate, whatever is lost, repeated, overtaken or restarted."""

from dataclasses import replace

import numpy as np
import pytest

from agents.area_files.area_file import stamp_split
from agents.messages.packing import encode
from agents.protocol.events import Received
from agents.strategies.admm_boundary import AdmmMessage
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.division import build_partition
from dsse_core.link_faults import LinkFaults
from scenarios.faults.faults import Faults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.feeders import make_feeder
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links
from tests.support.tree_of_areas import tree_scenario, with_angle_meters

GAP = 1e-8  # p.u. and rad


def bus_with(scenario, loss=0.0, seed=0, jitter_s=0.0, duplicate=0.0, **changes):
    telemetry = make_telemetry(scenario)
    files = area_files_of(scenario, strategy="admm", seed=seed, **changes)
    faults = LinkFaults(loss=loss, jitter_s=jitter_s, duplicate=duplicate)
    bus = SimulatedBus(with_links(files, faults), telemetry.by_area)
    return bus, centralised_of(scenario, telemetry)


def centralised_of(scenario, telemetry) -> EstimationResult:
    return estimate_state(scenario.network, telemetry.union, tolerance=1e-12)


def settle(bus):
    """Until nobody has had anything to tell for two seconds."""
    deadline, sent = bus.now + 300.0, None
    while sent != (sent := [state.header.sequence for state in bus.states.values()]) or not bus.settled:
        assert bus.now < deadline, {name: state.notes for name, state in bus.states.items()}
        bus.run(2.0)


def gap_of(bus, centralised):
    """Largest distance of any area's voltage from the centralised estimate, p.u."""
    row = centralised.network.row
    v = centralised.vm * np.exp(1j * centralised.va)
    gaps = [
        abs(np.array(s.vm) * np.exp(1j * np.array(s.va)) - v[[row[b] for b in s.buses]]).max()
        for s in bus.states.values()
        if s.buses
    ]
    return max(gaps) if len(gaps) == len(bus.files) else 1.0


def assert_equals_centralised(bus: SimulatedBus, centralised: EstimationResult):
    row = centralised.network.row
    for state in bus.states.values():
        rows = [row[b] for b in state.buses]
        np.testing.assert_allclose(state.vm, centralised.vm[rows], atol=GAP)
        np.testing.assert_allclose(state.va, centralised.va[rows], atol=GAP)
        assert state.rejected == {}


def sent_in(bus):
    return [m for _, _, _, m in bus.delivered if isinstance(m, AdmmMessage)]


def iterations_to(bus, centralised, gap):
    while gap_of(bus, centralised) > gap:
        assert bus.now < 5.0
        bus.run(0.0005)
    return max(m.iteration for m in sent_in(bus))


@pytest.mark.parametrize("loss", [0.3, *further(0.0, 0.6)])
@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_the_thesiss_systems_reach_the_centralised_state(name, loss):
    bus, centralised = bus_with(load_scenario(name), loss)
    settle(bus)
    assert_equals_centralised(bus, centralised)


@pytest.mark.parametrize("loss", [0.3, *further(0.0, 0.6)])
def test_a_tree_of_areas_without_voltmeters_in_some_reaches_it_too(loss):
    bus, centralised = bus_with(tree_scenario(), loss)
    settle(bus)
    assert_equals_centralised(bus, centralised)
    assert sum(s.objective for s in bus.states.values()) == pytest.approx(centralised.objective, rel=1e-6)
    assert sum(s.degrees_of_freedom for s in bus.states.values()) == centralised.degrees_of_freedom


@pytest.mark.parametrize("seed", [0, *further(1, 2)])
def test_messages_that_arrive_twice_and_in_another_order_change_nothing(seed):
    bus, centralised = bus_with(tree_scenario(), 0.3, seed, jitter_s=0.02, duplicate=0.5)
    settle(bus)
    assert_equals_centralised(bus, centralised)


@pytest.mark.parametrize("seed", [2, 3, *further(8, 11, 24)])
def test_random_feeders_reach_it(seed):
    rng = np.random.default_rng(seed)
    feeder = make_feeder(seed, n_bus=int(rng.integers(3, 60)), n_area=int(rng.integers(2, 8)), decades=seed % 3)
    files = stamp_split(
        [replace(f, strategy="admm") for f in feeder.area_files(rng.choice([0.0, 0.3]), seed)], time=0.0
    )
    bus = SimulatedBus(files, feeder.telemetry())
    settle(bus)
    assert gap_of(bus, estimate_state(feeder.network, feeder.measurements, tolerance=1e-11)) < GAP


@pytest.mark.parametrize("name", ["c", *further("a", "e")])
def test_an_area_that_restarts_goes_on_from_what_it_receives(name):
    bus, centralised = bus_with(tree_scenario(), 0.3)
    for pause in (0.1, 3.0):  # in the midst of the exchange, and long after it
        bus.run(pause)
        bus.kill(name)
        bus.run(1.0)
        bus.start(name)
        bus.send_telemetry(name)
    settle(bus)
    assert_equals_centralised(bus, centralised)


def test_two_neighbours_that_restart_together_reach_it_again():
    bus, centralised = bus_with(tree_scenario())
    settle(bus)
    for name in ("b", "c"):
        bus.kill(name)
    for name in ("b", "c"):
        bus.start(name)
        bus.send_telemetry(name)
    settle(bus)
    assert_equals_centralised(bus, centralised)


def test_a_new_scan_starts_from_the_old_one_and_ends_at_its_own_estimate():
    scenario = tree_scenario()
    bus, _ = bus_with(scenario, 0.3)
    bus.run(0.3)
    telemetry = make_telemetry(replace(scenario, seed=2))
    bus.next_scan(telemetry.by_area)
    settle(bus)
    assert_equals_centralised(bus, centralised_of(scenario, telemetry))


def test_a_dead_neighbour_is_not_waited_for():
    bus, _ = bus_with(tree_scenario())
    bus.run(0.008)
    bus.kill("e")
    bus.run(10.0)
    for boundary in (2, 3, 6):
        one, other = bus.voltages()[boundary]
        assert abs(one - other) < GAP
    assert {m.header.sender for m in sent_in(bus) if m.iteration > 20} == {"a", "b", "c", "d"}


def test_before_the_side_of_the_reference_has_spoken_angles_are_relative():
    bus, centralised = bus_with(tree_scenario())
    bus.cut("b", "c")
    bus.run(2.0)
    assert [name for name, state in bus.states.items() if not state.referenced] == ["c", "d", "e"]
    bus.heal("b", "c")
    settle(bus)
    assert_equals_centralised(bus, centralised)


def test_where_both_sides_have_angle_meters_the_angle_is_negotiated_like_the_rest():
    scenario = with_angle_meters(tree_scenario(), [1, 4, 8, 18, 33])
    bus, centralised = bus_with(scenario)
    settle(bus)
    assert_equals_centralised(bus, centralised)


def test_a_grid_of_one_area_is_estimated_alone():
    scenario = load_scenario("industrial13")
    whole = build_partition(scenario.network, {"all": [bus.id for bus in scenario.network.buses]})
    bus, centralised = bus_with(replace(scenario, partition=whole, load_error={"all": 0j}, faults=Faults({})))
    settle(bus)
    assert_equals_centralised(bus, centralised)


def test_a_wrong_load_message_changes_nothing_but_the_start():
    scenario = load_scenario("ieee33")
    wrong = replace(scenario, load_error={area.name: 0.3 + 0.3j for area in scenario.partition.areas})
    bus, centralised = bus_with(wrong)
    settle(bus)
    assert_equals_centralised(bus, centralised)


@pytest.mark.parametrize(("name", "most"), [("ieee33", 12), ("industrial13", 8), ("tree", 24)])
def test_a_millionth_is_reached_in_as_many_iterations_as_theory_says(name, most):
    """docs/reference/figures.md, `penalty`; a plain scalar penalty with the angle as one of four takes 48."""
    bus, centralised = bus_with(tree_scenario() if name == "tree" else load_scenario(name))
    assert iterations_to(bus, centralised, 1e-6) <= most


@pytest.mark.parametrize("penalty", [*further(0.1), 10.0])
def test_another_penalty_takes_longer_to_the_same_end(penalty):
    default, centralised = bus_with(load_scenario("industrial13"))
    other, _ = bus_with(load_scenario("industrial13"), penalty=penalty)
    assert iterations_to(other, centralised, 1e-6) > 3 * iterations_to(default, centralised, 1e-6)
    settle(other)
    assert_equals_centralised(other, centralised)


def test_each_message_is_an_answer_that_brings_the_next_step_along():
    bus, _ = bus_with(load_scenario("industrial13"))
    settle(bus)
    last = sent_in(bus)[-1]
    assert last.header.sequence <= last.iteration / 2 + 3
    assert max(len(encode(m)) for m in sent_in(bus)) <= 200


def test_a_lost_message_costs_no_heartbeat():
    """Of 30 messages every third is lost; each is repeated after a tenth of a heartbeat of a second."""
    bus, centralised = bus_with(load_scenario("industrial13"), 0.3, beat_s=1.0)
    bus.run(0.9)
    assert gap_of(bus, centralised) < 1e-6


def test_numbers_beyond_reason_are_rejected_and_counted():
    bus, centralised = bus_with(load_scenario("industrial13"))
    settle(bus)
    last = [m for m in sent_in(bus) if m.header.sender == "area1"][-1]
    header = replace(last.header, sequence=99)
    bus.post("area2", Received(replace(last, header=header, r=(1e300, 0.0, 1.0, 0.0)), "area1"))
    bus.post("area2", Received(replace(last, header=header, weight=(1.0, 1.0, 0.0, 1.0)), "area1"))
    bus.run(0.5)
    assert bus.states["area2"].rejected == {"numbers beyond reason": 2}
    assert gap_of(bus, centralised) < GAP
