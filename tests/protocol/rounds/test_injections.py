"""The injection of a boundary bus that its owner publishes is the bus's own, or absent with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from coordinator.watch.observe.area_flows import make_area_flows
from coordinator.watch.observe.freshness import freshness_of_state
from coordinator.watch.observe.grid_tables import GridTables
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.partition import Partition
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.exact_exchange import run_feeder, settle
from tests.support.feeders import make_feeder
from tests.support.grids import MeterShares, make_grid
from tests.support.levels import further
from tests.support.rings import make_ring_feeder, ring33
from tests.support.simulated_bus import SimulatedBus
from tests.support.tree_of_areas import tree_scenario

EQUAL = 1e-9  # p.u.
Settled = tuple[Partition, SimulatedBus, BadDataReport]
SCENARIOS: dict[str, Callable[[], Scenario]] = {
    "ieee33": lambda: load_scenario("ieee33"),
    "industrial13": lambda: load_scenario("industrial13"),
    "a tree of areas": tree_scenario,
    "a ring": ring33,
}
FEEDERS = {
    "feeder 0": lambda: make_feeder(0, 20, 3),
    "grid with loops": lambda: make_grid(2, 25, 4, 0.5, 1.0, 2, 0.2, None, True, MeterShares()),
    "feeder of rings": lambda: make_ring_feeder(0, 4, 2),
    **{f"feeder {k}": lambda k=k: make_feeder(k, 20 + 3 * k, 3 + k) for k in range(1, 6)},
    **{f"feeder of rings {k}": lambda k=k: make_ring_feeder(k, 4, 2) for k in (1, 2)},
}
CHEAP = "feeder 0", "grid with loops", "feeder of rings"


def settled(name: str) -> Settled:
    if name in SCENARIOS:
        scenario = SCENARIOS[name]()
        return scenario.partition, *settle(scenario)
    feeder = FEEDERS[name]()
    assert feeder is not None
    return feeder.partition, *run_feeder(feeder, loss=0.0, seed=1)


@pytest.mark.parametrize("name", [*SCENARIOS, *CHEAP, *further(*(name for name in FEEDERS if name not in CHEAP))])
def test_injections_of_areas_are_those_of_the_centre_at_boundary_buses_too(name: str):
    partition, bus, report = settled(name)
    whole = results_of_estimate(report).buses
    of_centre = dict(zip(whole.bus.tolist(), zip(whole.p_kw, whole.q_kvar, strict=True), strict=True))
    limit, found = EQUAL * 1000 * partition.network.base_mva, set[int]()
    for area in partition.areas:
        buses, _ = make_area_flows(area, bus.states[area.name])
        for bus_id, p, q, why in zip(
            buses.bus.tolist(), buses.p_kw, buses.q_kvar, buses.injection_problem, strict=True
        ):
            if why:
                on_tree = all(boundary.has_one_flow for boundary in area.boundaries.values())
                owner = partition.owner_of_bus[bus_id] if on_tree else "another area"
                assert why == f"{owner} owns this bus"
                assert np.isnan([p, q]).all()
            else:
                assert (p, q) == pytest.approx(of_centre[bus_id], rel=0, abs=limit), bus_id
                found.add(bus_id)
    assert found == of_centre.keys()


@pytest.mark.parametrize("name", SCENARIOS)
def test_injections_that_a_page_adds_up_over_the_areas_are_those_of_the_centre(name: str):
    partition, bus, report = settled(name)
    freshness = {area: freshness_of_state(state) for area, state in bus.states.items()}
    buses, _ = GridTables(SCENARIOS[name]()).buses_and_branches(bus.states, freshness)
    whole, limit = results_of_estimate(report).buses, EQUAL * 1000 * partition.network.base_mva
    assert set(buses.injection_problem) == {""}
    for column in ("p_kw", "q_kvar"):
        np.testing.assert_allclose(buses[column], whole[column], rtol=0, atol=limit)


def test_in_a_scan_without_a_child_the_injection_of_the_common_bus_is_absent_and_others_stay():
    scenario = load_scenario("ieee33")
    bus, _ = settle(scenario)
    area = scenario.partition.area("area1")
    children = [n.area for n in area.neighbours if not n.is_parent]
    bus.kill(children[0])
    bus.run(0.05)
    assert bus.states["area1"].into_children  # the last state stands until the next scan
    bus.next_scan(make_telemetry(scenario, 2).by_area)
    while len(bus.states["area1"].into_children) > 0:
        assert bus.now < 600.0
        bus.run(0.05)
    buses, _ = make_area_flows(area, bus.states["area1"])
    (common,) = {power.bus for power in area.powers_into_children}
    absent = np.isnan(buses.p_kw)
    assert buses.bus[absent].tolist() == [common]
    (reason,) = (why for why in buses.injection_problem if why)
    assert reason == "area1 does not know the power into area2, area3"
    assert set(buses.quality) == {"degraded"}


def test_an_area_that_does_not_state_the_powers_into_its_children_has_no_injection_there():
    scenario = load_scenario("industrial13")
    bus, _ = settle(scenario)
    (owner, child) = next(iter(scenario.partition.boundaries.values()))
    state = replace(bus.states[owner], into_children=())
    buses, _ = make_area_flows(scenario.partition.area(owner), state)
    assert {why for why in buses.injection_problem if why} == {f"{owner} does not know the power into {child}"}
