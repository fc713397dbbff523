"""The exact exchange: on a tree of areas its fixed point is the centralised estimate, whatever is lost on the way."""

from dataclasses import replace

import numpy as np
import pytest
from feeders import make_feeder
from simulated_bus import SimulatedBus, area_files_of
from test_angle_offset import tree_scenario

from agents.messages import InformationMessage, encode
from agents.protocol import Received
from dsse_core.estimation import EstimationResult, estimate_state
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

GAP = 1e-8  # p.u. and rad
SIGMA = 1e-4  # relative; FLOW_SIGMA (1e-6 p.u.) shows beside standard deviations of 1e-5


def settle(scenario, loss=0.0, seed=0):
    telemetry = make_telemetry(scenario)
    files = area_files_of(scenario, strategy="information", seed=seed)
    files = [replace(f, loss={n.area: loss for n in f.area.neighbours}) for f in files]
    bus = SimulatedBus(files, telemetry.by_area)
    settle_bus(bus)
    return bus, estimate_state(scenario.network, telemetry.union, tolerance=1e-12)


def settle_bus(bus):
    bus.run_until_settled(300.0)
    bus.run(3.0)
    bus.run_until_settled(300.0)


def assert_equals_centralised(bus: SimulatedBus, centralised: EstimationResult):
    row = centralised.network.row
    sigma_vm, sigma_va = centralised.state_sigma()
    for state in bus.states.values():
        rows = [row[b] for b in state.buses]
        np.testing.assert_allclose(state.vm, centralised.vm[rows], atol=GAP)
        turn = np.exp(1j * (np.array(state.va) - centralised.va[rows]))
        np.testing.assert_allclose(np.angle(turn), 0.0, atol=GAP)
        np.testing.assert_allclose(state.sigma_vm, sigma_vm[rows], rtol=SIGMA)
        np.testing.assert_allclose(state.sigma_va, sigma_va[rows], rtol=SIGMA, atol=1e-12)
        assert state.refused == {}


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_the_thesiss_systems_reach_the_centralised_state_and_covariance(name, loss):
    assert_equals_centralised(*settle(load_scenario(name), loss))


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_a_tree_of_areas_without_voltmeters_in_some_reaches_it_too(loss):
    bus, centralised = settle(tree_scenario(), loss)
    assert_equals_centralised(bus, centralised)
    assert sum(s.objective for s in bus.states.values()) == pytest.approx(centralised.objective, rel=1e-6)
    assert sum(s.degrees_of_freedom for s in bus.states.values()) == centralised.degrees_of_freedom


@pytest.mark.parametrize("seed", range(12))
def test_random_feeders_reach_it(seed):
    rng = np.random.default_rng(seed)
    size = {"n_bus": int(rng.integers(3, 60)), "n_area": int(rng.integers(2, 13))}
    feeder = make_feeder(
        seed,
        **size,
        shape=rng.choice([0.3, 0.6, 0.9, 1.0]),
        decades=rng.choice([0, 1, 2]),
        dense=rng.choice([0.2, 0.5, 1.0]),
    )
    bus = SimulatedBus(feeder.area_files(rng.choice([0, 0.3, 0.6, 0.9]), seed), feeder.telemetry())
    settle_bus(bus)
    assert_equals_centralised(bus, estimate_state(feeder.network, feeder.measurements, tolerance=1e-11))


def test_a_wrong_load_message_changes_nothing_but_the_start():
    scenario = load_scenario("ieee33")
    wrong = replace(scenario, load_error={area.name: 0.3 + 0.3j for area in scenario.partition.areas})
    assert_equals_centralised(*settle(wrong))


def test_messages_fit_in_200_bytes_and_few_are_needed():
    bus, _ = settle(tree_scenario())
    told = [m for _, _, _, m in bus.delivered if isinstance(m, InformationMessage)]
    assert max(len(encode(m)) for m in told) <= 200
    longest_path = 4  # areas a - b - c - d
    assert max(m.header.sequence for m in told) <= 2 * longest_path + 4


def test_before_the_side_of_the_reference_has_spoken_angles_are_relative():
    scenario = tree_scenario()
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    bus.cut("b", "c")
    bus.run(2.0)
    assert [name for name, state in bus.states.items() if not state.referenced] == ["c", "d", "e"]
    bus.heal("b", "c")
    bus.run_until_settled()


def test_information_that_is_not_semidefinite_is_refused_and_counted():
    scenario = load_scenario("industrial13")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    settle_bus(bus)
    last = [m for _, s, r, m in bus.delivered if (s, r) == ("area1", "area2") and isinstance(m, InformationMessage)][-1]
    lie = replace(last, header=replace(last.header, sequence=99), L=tuple(-v for v in last.L))
    bus.post("area2", Received(lie, "area1"))
    bus.run(0.5)
    assert bus.states["area2"].refused == {"information not semidefinite": 1}
