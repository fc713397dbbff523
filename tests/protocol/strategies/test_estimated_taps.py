"""Taps as variables of the areas that hold their branches: found as in the centre, with the flows that follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import NotObservableError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Meter
from dsse_core.grid.network import Network
from dsse_core.linear import choose
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.branches import make_branch_table
from dsse_core.results.results import results_of_estimate
from dsse_core.results.state import AreaVoltages, join_states
from scenarios.scenario import load_scenario
from tests.support.back_ends import back_end
from tests.support.exact_exchange import SIGMA, assert_equals_centralised, run_feeder
from tests.support.feeders import KIND, Feeder, make_feeder, read_with_noise
from tests.support.levels import further
from tests.support.rings import make_ring_feeder

STEP = 0.0125  # of the tap ratio
GAP = 1e-9
BACK_ENDS = ("dense", *further("sparse", "radial"))


def draw_taps(seed: int, *, ring: bool = False, n_area: int = 5) -> tuple[Feeder, dict[str, float]]:
    """A feeder, or one with a ring, with up to three estimated taps, and these as they are; one is at a boundary.

    Voltmeters of 0.2 % stand at the ends of these branches.
    """
    found = make_ring_feeder(seed, n_area, 1, 0.5, 0.5) if ring else make_feeder(seed, 30, n_area, 0.5, 0.0, 0.8)
    assert found is not None
    feeder, rng = found, np.random.default_rng([seed, 7])
    met = {bus for area in feeder.partition.areas for bus in area.boundary_buses}
    closed = [branch for branch in feeder.network.branches if branch.in_service]
    taps = {str(rng.choice([b.id for b in closed if not met.isdisjoint((b.from_bus, b.to_bus))]))}
    taps |= {str(branch) for branch in rng.choice([b.id for b in closed], 2, replace=False)}

    def mark(network: Network) -> Network:
        marked = (replace(b, tap_steps=STEP, estimate_tap=b.id in taps) for b in network.branches)
        return replace(network, branches=tuple(marked))

    network = mark(feeder.network)
    truth = {tap: network.branch(tap).tap + STEP * int(rng.integers(-3, 4)) for tap in sorted(taps)}
    flow = solve_power_flow(network.with_taps(truth))
    ends = {bus for tap in taps for bus in (network.branch(tap).from_bus, network.branch(tap).to_bus)}
    meters = [m.meter for m in feeder.measurements if m.meter.kind is not KIND.VM]
    meters += [Meter(KIND.VM, bus) for bus in sorted(ends)]
    largest = abs(flow.injection).max()
    read = tuple(read_with_noise(rng, meter, flow, largest, 0.0) for meter in meters)
    areas = tuple(replace(area, network=mark(area.network)) for area in feeder.partition.areas)
    return Feeder(network, replace(feeder.partition, network=network, areas=areas), read), truth


def assert_taps_equal(feeder: Feeder, truth: dict[str, float]) -> None:
    bus, report = run_feeder(feeder, 0.0, 0)
    assert_equals_centralised(bus, report)
    found = {tap: of for state in bus.states.values() for tap, of in state.taps.items()}
    assert found.keys() == report.result.estimated_taps.keys() == truth.keys()
    for tap, (ratio, sigma) in report.result.estimated_taps.items():
        assert found[tap] == (pytest.approx(ratio, abs=GAP), pytest.approx(sigma, rel=SIGMA))
        assert abs(ratio - truth[tap]) < 4 * sigma
    for state in bus.states.values():
        assert state.quality == "good", state.notes
    of_areas = {
        name: AreaVoltages(np.array(s.vm), np.array(s.va), s.referenced, taps=s.taps) for name, s in bus.states.items()
    }
    joined = make_branch_table(join_states(feeder.partition, of_areas))
    central = results_of_estimate(report).branches
    for column in ("p_from_kw", "q_to_kvar", "i_from_a", "loss_kw"):
        np.testing.assert_allclose(joined[column], central[column], atol=1e-6 * abs(central[column]).max())
    np.testing.assert_array_equal(joined.tap_steps_off, central.tap_steps_off)


@pytest.mark.parametrize("name", BACK_ENDS)
def test_areas_find_taps_and_the_flows_that_follow_as_the_centre_does(name):
    with back_end(name):
        assert_taps_equal(*draw_taps(2))


@pytest.mark.long
@pytest.mark.parametrize("pieces_from", [choose.PIECES_FROM, 0])
def test_so_they_do_where_a_ring_passes_through_areas(pieces_from, monkeypatch):
    monkeypatch.setattr(choose, "PIECES_FROM", pieces_from)
    assert_taps_equal(*draw_taps(1, ring=True))


@pytest.mark.long
@pytest.mark.n_cases(few=10, long=10, many=100)
def test_errors_of_taps_are_as_large_as_their_standard_deviations_say(n_cases):
    off = []
    for seed in range(n_cases):
        feeder, truth = draw_taps(seed)
        found = estimate_state(feeder.network, feeder.measurements).estimated_taps
        off += [(found[tap][0] - ratio) / found[tap][1] for tap, ratio in truth.items()]
    bound = 4 / np.sqrt(2 * len(off))  # four standard deviations of the rms of normal numbers
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=bound)


def test_a_tap_without_a_voltmeter_behind_it_is_not_observable_and_the_cure_is_named():
    feeder, _ = draw_taps(2)
    one = next(iter(feeder.network.estimated_taps))
    alone = tuple(replace(b, estimate_tap=b.id == one) for b in feeder.network.branches)
    network = replace(feeder.network, branches=alone)
    with_one = [m for m in feeder.measurements if m.meter.kind is not KIND.VM]
    with_one.append(next(m for m in feeder.measurements if m.meter.kind is KIND.VM))
    with pytest.raises(NotObservableError, match="voltage magnitude at bus") as raised:
        estimate_state(network, with_one)
    assert network.branch(one).from_bus in raised.value.buses or network.branch(one).to_bus in raised.value.buses


def test_a_tap_without_supply_is_not_among_the_estimated_ones():
    network = load_scenario("ieee33").network
    tapped = tuple(
        replace(b, estimate_tap=b.id in ("7-8", "21-22"), in_service=b.in_service and b.id != "6-7")
        for b in network.branches
    )
    fed = replace(network, branches=tapped).supplied()
    flow = solve_power_flow(fed)
    alive = [bus for bus, dead in zip(fed.node_buses, fed.is_dead.tolist(), strict=True) if not dead]
    meters = [Meter(kind, bus) for kind in (KIND.VM, KIND.P_INJECTION, KIND.Q_INJECTION) for bus in alive]
    read = tuple(read_with_noise(np.random.default_rng(1), meter, flow, 1.0, 0.0) for meter in meters)
    found = estimate_state(fed, read).estimated_taps
    assert found.keys() == {"21-22"}
    ratio, sigma = found["21-22"]
    assert abs(ratio - 1.0) < 4 * sigma
