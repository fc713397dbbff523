"""A switch that is not as its status says: its holder knows by how much J of the whole grid is less the other way."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from dsse_core.errors import DsseError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.residuals import THRESHOLD
from dsse_core.estimation.switches import Gain, build_alternatives, describe_switches, weigh_switches
from dsse_core.exchange import area_estimation
from dsse_core.exchange.area_estimation import AreaEstimation
from dsse_core.grid.network import Network
from dsse_core.grid.supply import find_alternatives
from dsse_core.grid.switches import keep_in_service
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.telemetry import make_telemetry
from tests.protocol.strategies.test_switches import GAP, find_gap, order, read_after, settle, switched33
from tests.support.feeders import Feeder, read_with_noise
from tests.support.levels import further
from tests.support.rings import make_ring_feeder
from tests.support.simulated_bus import SimulatedBus, area_files_of

WRONG = [(3, {"18-33": True}), *further((5, {"18-33": True}), (5, {"12-22": True}), (8, {"25-29": True}))]


@pytest.mark.parametrize("case", WRONG)
def test_areas_and_centre_name_a_wrong_status_and_estimate_with_the_other_one(case):
    n_area, truth = case
    operated, telemetry, by_area = read_after(scenario := switched33(n_area), truth)
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), by_area)
    bus.run(2.0)
    in_use = keep_in_service(
        scenario.network, telemetry.union
    )  # for areas and centre alike, by the status that is read
    report = process_bad_data(scenario.network, in_use)
    assert [*report.switched] == [*truth]
    assert report.result.network.switches == operated.network.switches
    assert report.removed == ()
    (note,) = describe_switches(truth, {})
    for state in bus.states.values():
        assert (state.quality, state.notes[0], state.removed) == ("degraded", note, ())
    assert find_gap(bus, operated, replace(telemetry, union=in_use)) < GAP


def test_models_of_other_statuses_serve_all_scans_of_the_same_meters_and_statuses():
    bus = settle(scenario := switched33(3))
    estimation = next(p.round.estimation for p in bus.protocols.values() if "18-33" in p.round.estimation.gains)
    before = dict(estimation.gains)
    with mock.patch.object(area_estimation, "build_alternatives", wraps=build_alternatives) as build:
        bus.next_scan(make_telemetry(replace(scenario, seed=2)).by_area)
        bus.run(2.0)
        assert build.call_count == 0
        weighed = estimation.gains
        fresh = build_alternatives(estimation.model, find_alternatives(estimation.area, estimation._pieces))
        assert before != weighed == weigh_switches(estimation.model, estimation.x, estimation.received, fresh)
        order(bus, {"18-33": True})
        bus.run(2.0)
        assert build.call_count > 0


def test_a_status_is_undecided_where_both_may_fit_by_the_figure_or_by_its_doubt():
    gains = {"a": Gain(8.0, 0.0), "b": Gain(-191.0, 651.0), "c": Gain(-191.0, 3.0), "d": Gain(20.0, 100.0)}
    better, undecided = describe_switches((), gains)
    assert "switch@d (J less by 20)" in better
    assert undecided == "undecided, the readings may fit both statuses: switch a, b"


def draw_switch(seed: int) -> tuple[Feeder, Network, str]:
    """A feeder in five areas with a switch in the wrong status, which no meter is at; the true network; the switch."""
    feeder = make_ring_feeder(seed, 5, 1, 0.5, 0.5, anywhere=bool(seed % 2))
    assert feeder is not None

    def mark(network: Network) -> Network:
        branches = tuple(replace(b, switch=b.id.startswith("tie")) for b in network.branches)
        return replace(network, branches=branches)

    areas = tuple(replace(area, network=mark(area.network)) for area in feeder.partition.areas)
    network = mark(feeder.network)
    ((switch, is_closed),) = network.switches.items()
    truth = network.operated({switch: not is_closed})
    flow, rng = solve_power_flow(truth), np.random.default_rng([seed, 3])
    meters = [m.meter for m in feeder.measurements if m.meter.branch != switch]
    largest = abs(flow.injection).max()
    read = tuple(read_with_noise(rng, meter, flow, largest, 0.5) for meter in meters)
    return Feeder(network, replace(feeder.partition, network=network, areas=areas), read), truth, switch


@pytest.mark.n_cases(few=1, long=4, many=500)
def test_the_holder_knows_the_change_of_J_of_the_whole_grid_or_doubts_it(n_cases):
    seed = n_found = n_size = n_doubt = 0
    while n_found < n_cases:
        seed += 1
        try:
            feeder, truth, switch = draw_switch(seed)
            read, other = (estimate_state(of, feeder.measurements) for of in (feeder.network, truth))
        except (DsseError, AssertionError):
            continue  # no place for a tie, or no estimate in the centre
        if (central := read.gains.get(switch)) is None:
            continue  # from the status that was read no steps lead to an end with the other one
        change, gain, n_found = read.objective - other.objective, find_first_gain(feeder, switch), n_found + 1
        if abs(change) < 1e5:  # beyond, J of the wrong status may have several minima
            assert central == (pytest.approx(change, rel=1e-6, abs=1e-6), 0.0)  # without neighbours nothing is linear
        if not gain.is_undecided:
            assert np.sign(gain.fall) == np.sign(change), seed
        n_size += abs(gain.fall - change) < 0.5 + 2e-3 * abs(change) or abs(change) > 1e5
        n_doubt += gain.doubt > abs(gain.fall) > THRESHOLD**2
    assert n_size >= 0.97 * n_cases
    assert n_doubt <= 0.05 * n_cases


def find_first_gain(feeder: Feeder, switch: str) -> Gain:
    """What the holder finds at the first end of the scan, with the status that was read."""
    found: list[Gain] = []
    weigh = AreaEstimation.weigh_switches

    def record(estimation: AreaEstimation) -> None:
        weigh(estimation)
        found.extend(estimation.gains.values())

    bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
    with mock.patch.object(AreaEstimation, "weigh_switches", record):
        while not found:
            assert bus.now < 60.0, f"no area has weighed {switch}"
            bus.run(0.05)
    return found[0]


@pytest.mark.n_cases(few=1, long=1, many=10_000)
def test_sound_readings_accuse_no_switch(n_cases):
    scenario = switched33(3)
    n_false = 0
    for seed in range(n_cases):
        readings = make_telemetry(replace(scenario, seed=seed)).union
        if estimate_state(scenario.network, readings).memory.evaluating:
            n_false += bool(process_bad_data(scenario.network, readings).switched)
    assert n_false <= max(1, n_cases * 4e-4)
