"""The exact exchange: on a tree of areas its fixed point is the centralised estimate, whatever is lost on the way."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import DownMessage, UpMessage, decode, encode
from agents.protocol.events import Received
from dsse_core.estimation.residuals import chi_square_limit
from dsse_core.grid.measurement import Measurement, Source
from dsse_core.linear.area_model import build_area_model
from dsse_core.linear.boundary_information import BoundaryInformation
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.link_faults import LinkFaults
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.back_ends import back_end
from tests.support.exact_exchange import (
    assert_equals_centralised,
    assert_same_decisions,
    run_feeder,
    settle,
    settle_bus,
)
from tests.support.feeders import make_feeder, make_star
from tests.support.grids import with_gross_errors
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of
from tests.support.tree_of_areas import tree_scenario

COLD = 4  # rounds that a first scan takes without removals, each of one message in either direction


@pytest.mark.usefixtures("each_back_end")
@pytest.mark.parametrize("loss", [0.3, *further(0.0, 0.9)])
@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_the_thesiss_systems_reach_the_centralised_state_and_covariance(name, loss):
    assert_equals_centralised(*settle(load_scenario(name), loss))


@pytest.mark.usefixtures("each_back_end")
@pytest.mark.parametrize("loss", [0.5, *further(0.0)])
def test_a_tree_of_areas_without_voltmeters_in_some_reaches_it_too(loss):
    bus, report = settle(tree_scenario(), loss)
    assert_equals_centralised(bus, report)
    assert sum(s.objective for s in bus.states.values()) == pytest.approx(report.objective, rel=1e-6)
    assert sum(s.degrees_of_freedom for s in bus.states.values()) == report.degrees_of_freedom


@pytest.mark.usefixtures("back_end_in_turn")
@pytest.mark.random_cases(few=3, long=18, many=200)
def test_random_feeders_reach_it_whatever_the_bus_does(random_seed):
    check_random_feeder(random_seed)


def check_random_feeder(random_seed):
    assert_equals_centralised(*run_random_feeder(random_seed))


def run_random_feeder(random_seed):
    rng = np.random.default_rng(random_seed)
    size = {"n_bus": int(rng.integers(3, 60)), "n_area": int(rng.integers(2, 13))}
    feeder = make_feeder(
        random_seed,
        **size,
        shape=rng.choice([0.3, 0.6, 0.9, 1.0]),
        decades=rng.choice([0, 1, 2, 4]),
        dense=rng.choice([0.2, 0.5, 1.0]),
    )
    faults = {"jitter_s": rng.choice([0.0, 0.01, 0.3]), "duplicate": rng.choice([0.0, 0.3])}
    return run_feeder(feeder, rng.choice([0, 0.3, 0.6, 0.9]), random_seed, **faults)


def test_what_early_messages_make_of_voltages_is_not_shown_where_it_is_far_from_the_start():
    with back_end("sparse"):
        check_random_feeder(105)  # in its first moments a8 receives -5 p.u. at the boundary, known to 0.1 p.u.


def test_standard_deviations_are_as_exact_where_sigmas_and_impedances_differ_by_decades():
    with back_end("dense"):
        check_random_feeder(55)


def test_standard_deviations_rest_on_no_order_of_the_meters():
    """Of a11 the tableau is singular to working precision: its refined inverse is wrong by 1e-11 to 1e-5 by chance."""
    with back_end("dense"):
        bus, _ = run_random_feeder(55)
        estimation = bus.protocols["a11"].round.estimation
        model, at, received = estimation.model, estimation.linearized_at, estimation.received
        meters = list(zip(model.meters, model.z.tolist(), model.sigma.tolist(), strict=True))
        n_voltage = 2 * len(model.area.network.buses)
        expected = model.linear.variances(at, received)[0][:n_voltage]
        for seed in range(4):
            mixed = [Measurement(*meters[k]) for k in np.random.default_rng(seed).permutation(len(meters))]
            of_mixed = build_area_model(model.area, mixed, model.reference, backend="dense")
            found = of_mixed.linear.variances(at, received)[0][:n_voltage]
            np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.usefixtures("each_back_end")
@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_a_chain_of_twenty_areas_of_one_branch_each_reaches_it(loss):
    feeder = make_feeder(0, n_bus=21, n_area=21, shape=1.0)
    assert len(feeder.partition.areas) == 20
    assert_equals_centralised(*run_feeder(feeder, loss, 0))


@pytest.mark.usefixtures("each_back_end")
def test_fifteen_areas_at_one_bus_reach_it():
    assert_equals_centralised(*run_feeder(make_star(1), 0.3, 0))


@pytest.mark.usefixtures("each_back_end")
def test_areas_without_meters_of_their_own_reach_it():
    feeder = make_feeder(3, n_bus=30, n_area=8, dense=0.5)
    meterless = {area.name for area in feeder.partition.areas if not area.is_reference and area.neighbours[1:]}
    kept = [
        m
        for m in feeder.measurements
        if feeder.partition.area_of_meter(m.meter) not in meterless
        or m.meter.source is Source.VIRTUAL
        or m.meter.kind.of_injection
    ]
    assert_equals_centralised(*run_feeder(replace(feeder, measurements=tuple(kept)), 0.3, 0))


@pytest.mark.usefixtures("back_end_in_turn")
@pytest.mark.random_cases(few=3, long=24, many=200)
def test_gross_errors_are_removed_as_by_the_centralised_procedure(random_seed):
    check_gross_errors(random_seed)


def check_gross_errors(random_seed):
    rng = np.random.default_rng([7, random_seed])
    size = {"n_bus": int(rng.integers(5, 60)), "n_area": int(rng.integers(2, 10))}
    feeder = make_feeder(
        random_seed,
        **size,
        shape=float(rng.choice([0.3, 0.6, 0.9])),
        decades=float(rng.choice([0, 1])),
        dense=float(rng.choice([0.5, 1.0])),
    )
    feeder = with_gross_errors(rng, feeder)
    bus, report = run_feeder(feeder, float(rng.choice([0.0, 0.3, 0.6])), random_seed)
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)


def test_an_angle_that_is_known_worse_than_to_half_a_turn_is_no_reference():
    check_gross_errors(62)  # in its first moments a4 receives -1353 rad at the boundary, known to 76 rad


def test_equal_residuals_are_distinguished_by_the_id_of_the_meter():
    bus, report = settle(with_error(load_scenario("industrial13-thesis"), "p_flow@4:4-5", 40.0))
    (removed,) = report.removed
    assert removed.indistinguishable_from == ("p_flow@4:4-5", "p_injection@4")
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)
    for state in bus.states.values():
        assert state.quality == "degraded"
        named = f"{removed.measurement.meter.id} is removed, and the readings do not tell it from p_flow@4:4-5, p_inj"
        assert any(note.startswith(named) for note in state.notes)


def with_error(scenario, meter, sigmas):
    return replace(scenario, telemetry=replace(scenario.telemetry, gross_errors={meter: sigmas}))


def test_a_dead_voltmeter_is_removed():
    bus, report = settle(with_error(load_scenario("ieee33"), "vm@16", -500.0))
    assert [removed.measurement.meter.id for removed in report.removed] == ["vm@16"]
    assert_equals_centralised(bus, report)


def test_a_lying_neighbour_is_distinguished_from_a_bad_meter():
    scenario = load_scenario("ieee33")
    bus, _ = settle(with_error(scenario, "p_flow@2:2-3", 30.0))
    assert not any("mismatch" in note for state in bus.states.values() for note in state.notes)
    files = area_files_of(scenario, strategy="information")
    lie = {"area2": LinkFaults(lie_vm=0.002)}
    files = [replace(f, links=f.links | lie) if f.area.name == "area1" else f for f in files]
    bus = SimulatedBus(files, make_telemetry(scenario).by_area)
    bus.run(1.0)
    assert {name: state.quality for name, state in bus.states.items()} == {
        "area1": "degraded",
        "area2": "degraded",
        "area3": "degraded",
    }
    mismatch, *others = bus.states["area2"].notes
    assert mismatch.startswith("boundary mismatch with area1 at bus 6: its final voltage differs by ")
    assert others == ["behind area1 something is missing or old"]


@pytest.mark.usefixtures("each_back_end")
def test_areas_that_start_at_the_substations_busbar_reach_it_with_few_messages():
    feeder = make_star(2, busbar=True)
    bus, report = run_feeder(feeder, 0.0, 0)
    assert_equals_centralised(bus, report)
    sent = [m for _, _, _, m in bus.delivered if isinstance(m, UpMessage | DownMessage) and m.R]
    assert feeder.partition.boundaries.keys() == {1}
    assert all(m.R[k] == 0.0 for m in sent for k in (3, 6, 8, 9))  # nobody needs the angle of the reference
    assert max(m.header.sequence for m in sent) <= COLD


def test_a_wrong_load_message_changes_nothing_but_the_start():
    scenario = load_scenario("ieee33")
    wrong = replace(scenario, load_error={area.name: 0.3 + 0.3j for area in scenario.partition.areas})
    assert_equals_centralised(*settle(wrong))


def test_messages_fit_in_410_bytes_and_few_are_needed():
    bus, _ = settle(tree_scenario())
    sent = [m for _, _, _, m in bus.delivered if isinstance(m, UpMessage | DownMessage)]
    assert max(len(encode(m)) for m in sent) <= 410
    assert max(m.header.sequence for m in sent) <= COLD


def test_before_the_side_of_the_reference_has_spoken_angles_are_relative():
    scenario = tree_scenario()
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    bus.cut("b", "c")
    bus.run(3.0)
    assert {name for name, state in bus.states.items() if not state.referenced} == {"c", "d", "e"}
    notes = {name: state.notes for name, state in bus.states.items()}
    behind = "behind {} something is missing or old"
    assert notes["a"] == ("2 of 5 areas are counted", behind.format("b"))
    assert notes["b"] == ("no information from c", "2 of 5 areas are counted", behind.format("a"))  # it counts 2
    assert set(notes["d"]) > {"3 of 5 areas are counted", behind.format("c")}
    assert "no area that is counted sees the substation" in notes["d"][0]
    bus.heal("b", "c")
    bus.run_until_settled()
    assert not any(state.notes for state in bus.states.values())


@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_an_area_that_receives_nobody_publishes_its_own_best(name):
    scenario = load_scenario(name)
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    for one, other in itertools.combinations(bus.files, 2):
        bus.cut(one, other)
    bus.run(3.0)
    truth = solve_power_flow(scenario.network)
    for area, state in bus.states.items():
        vm = truth.vm[[scenario.network.row[b] for b in state.buses]]
        assert state.objective < chi_square_limit(state.degrees_of_freedom, 0.999)
        assert np.all(abs(np.array(state.vm) - vm) < 5 * np.array(state.sigma_vm))
        assert not state.checked
        assert state.referenced == bus.files[area].area.is_reference
        assert any("no information from" in note for note in state.notes)


@pytest.mark.parametrize("seed", [0, 1, *further(2, 3, 4, 5)])
def test_areas_restarted_under_loss_come_back_to_the_centralised_answer(seed):
    scenario = with_error(load_scenario("ieee33"), "p_flow@7:7-8", 30.0)
    bus, report = settle(scenario, 0.3, seed)
    for name in ("area2", "area3", "area1"):
        bus.kill(name)
        bus.run(0.3)
        bus.start(name)
        bus.send_telemetry(name)
        settle_bus(bus)
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)


def test_a_meter_that_an_area_has_not_reported_is_not_removed_on_a_neighbours_word():
    """Area 2 claims that a good meter of area 1 stands out; who owns it goes on without the side that follows."""
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    honest = bus.deliver

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        message = decode(payload)
        if sender == "area2" and isinstance(message, UpMessage):
            totals = replace(message.totals, objective=1e6, worst=(("vm@22", 90.0),))
            payload = encode(replace(message, totals=totals))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run(3.0)
    assert "vm@22" in {meter.id for meter in bus.files["area1"].meters}
    assert not any("vm@22" in state.removed for state in bus.states.values())
    assert "good" not in {state.quality for state in bus.states.values()}


def test_information_that_is_beyond_reason_is_rejected_and_counted():
    scenario = load_scenario("industrial13")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    settle_bus(bus)
    last = [m for _, s, r, m in bus.delivered if (s, r) == ("area1", "area2") and isinstance(m, DownMessage) and m.R][
        -1
    ]
    lie = replace(last, header=replace(last.header, sequence=99), R=tuple(1e30 * v for v in last.R))
    bus.post("area2", Received(lie, "area1"))
    bus.run(0.5)
    assert bus.states["area2"].rejected == {"numbers beyond reason": 1}


def test_an_area_whose_numbers_nobody_takes_has_none_and_nobody_waits_for_it(monkeypatch):
    scenario = load_scenario("ieee33")
    beyond = BoundaryInformation(1e20 * np.eye(4), np.zeros(4))
    monkeypatch.setattr(ReducedSolver, "information", lambda *_: beyond)
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    bus.run(3.0)
    assert all(protocol.outcome is not None for protocol in bus.protocols.values())
    assert not any(state.rejected for state in bus.states.values())
    assert "no estimate: ArithmeticError: the information of this side is beyond reason" in bus.states["area2"].notes


def test_a_verdict_that_does_not_follow_is_rejected_and_nobody_waits_for_ever():
    """Area 1, the hub, tells area 2 of totals from which another verdict follows; both go on without each other."""
    bus = SimulatedBus(
        area_files_of(load_scenario("ieee33"), strategy="information"),
        make_telemetry(load_scenario("ieee33")).by_area,
    )
    honest = bus.deliver

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        message = decode(payload)
        if (sender, receiver) == ("area1", "area2") and isinstance(message, DownMessage) and message.k == 1:
            payload = encode(replace(message, verdict="final"))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run(10.0)
    assert all(protocol.outcome is not None for protocol in bus.protocols.values())
    assert any(note.startswith("area1 is not believed: it says 'final'") for note in bus.states["area2"].notes)
    assert "no information from area2" in bus.states["area1"].notes
    assert "good" not in {state.quality for state in bus.states.values()}


def test_a_neighbour_whose_clock_was_set_back_is_received_again():
    bus, _ = settle(load_scenario("ieee33"))
    bus.kill("area2")
    bus.run(3.0)
    bus.set_clock_back("area2", 300_000)
    bus.start("area2")
    bus.run(3.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
