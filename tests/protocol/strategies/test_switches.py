"""Switches operated while areas run: states are the centre's with these statuses, which only the holder knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from agents.protocol.events import Ordered
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.watch.observe.switches import find_statuses
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.switches import keep_in_service
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry, make_telemetry
from tests.support.levels import further
from tests.support.rings import ACROSS, TIES, tied33
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links

GAP = 1e-9  # p.u.


def switched33(n_area: int) -> Scenario:
    """ieee33 with its five ties open; these, and a branch of each ring, may be operated."""
    return tied33(n_area, (), switches=(*TIES, *ACROSS))


def settle(scenario: Scenario, loss: float = 0.0) -> SimulatedBus:
    files = with_links(area_files_of(scenario, strategy="information"), LinkFaults(loss=loss))
    bus = SimulatedBus(files, make_telemetry(scenario).by_area)
    bus.run(3.0)
    return bus


def read_after(scenario: Scenario, closed: Mapping[str, bool]) -> tuple[Scenario, Telemetry, dict]:
    """The scenario after ``closed``, its telemetry, and that of areas, in which meters of open branches read 0."""
    operated = scenario.operated(closed)
    telemetry, by_area = make_telemetry(operated), {}
    before = make_telemetry(scenario)
    known = {m.meter.id for m in telemetry.union}
    for area, readings in telemetry.by_area.items():
        dark = [replace(m, value=0.0) for m in before.by_area[area] if m.meter.id not in known]
        by_area[area] = [*readings, *dark]
    return operated, telemetry, by_area


def order(bus: SimulatedBus, closed: Mapping[str, bool], sequence: int = 1) -> None:
    """The operator's order to the areas that hold the switches."""
    for name, content in bus.files.items():
        if own := {switch: closed[switch] for switch in content.area.network.switches if switch in closed}:
            bus.post(name, Ordered((5, 6, sequence), (), switches=own))


def find_gap(bus: SimulatedBus, scenario: Scenario, telemetry: Telemetry) -> float:
    """The largest distance of a voltage from the centralised estimate with these switches, p.u."""
    readings = keep_in_service(scenario.network, telemetry.union)
    result, row = process_bad_data(scenario.network, readings, tolerance=1e-12).result, scenario.network.row
    central = result.vm * np.exp(1j * result.va)
    return max(
        abs(vm * np.exp(1j * va) - central[row[bus_id]])
        for state in bus.states.values()
        for bus_id, vm, va in zip(state.buses, state.vm, state.va, strict=True)
    )


CLOSED, REWIRED = dict.fromkeys(TIES, True), dict.fromkeys(TIES, True) | dict.fromkeys(ACROSS, False)
CASES = [(5, CLOSED, 0.0), (5, REWIRED, 0.3), (8, CLOSED, 0.3), (8, REWIRED, 0.0), (3, CLOSED, 0.0)]


@pytest.mark.parametrize("case", [(3, REWIRED, 0.3), *further(*CASES)])
def test_sections_are_fed_from_another_side_after_orders_with_the_files_and_the_processes_of_before(case):
    n_area, closed, loss = case
    bus = settle(scenario := switched33(n_area), loss)
    variables = {name: content.area.boundaries for name, content in bus.files.items()}
    operated, telemetry, by_area = read_after(scenario, closed)
    bus.next_scan(by_area)
    order(bus, closed)
    bus.run(5.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, operated, telemetry) < GAP
    assert find_statuses(scenario.partition, bus.states) == scenario.network.switches | closed
    assert variables == {area.name: area.boundaries for area in operated.partition.areas}


@pytest.mark.long
@pytest.mark.parametrize("switch", TIES)
def test_a_tie_that_is_closed_and_opened_again_leaves_nothing_behind(switch):
    bus = settle(scenario := switched33(5))
    before = {name: (state.vm, state.objective) for name, state in bus.states.items()}
    for sequence, closed in enumerate(({switch: True}, {switch: False}), 1):
        operated, telemetry, by_area = read_after(scenario, closed)
        bus.next_scan(by_area)
        order(bus, closed, sequence)
        bus.run(3.0)
        assert find_gap(bus, operated, telemetry) < GAP
    np.testing.assert_allclose(bus.states["area3"].vm, before["area3"][0], atol=0.02)


@pytest.mark.long
@pytest.mark.parametrize("victim", ["area3", "area5"])
def test_an_order_that_meets_a_kill_or_crosses_another_one_counts_from_the_next_term(victim):
    """The killed holder begins with the written status, as the loop posts it before all other events."""
    bus = settle(scenario := switched33(5), 0.3)
    operated, telemetry, by_area = read_after(scenario, REWIRED)
    own = {s: REWIRED[s] for s in bus.files[victim].area.network.switches if s in REWIRED}
    bus.next_scan(by_area)
    bus.kill(victim)
    order(bus, {s: c for s, c in REWIRED.items() if s not in own})
    bus.run(3.0)
    assert all(state.quality != "good" for name, state in bus.states.items() if name != victim)
    bus.start(victim)
    bus.post(victim, Ordered((5, 6, 1), (), switches=own))
    bus.run(5.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, operated, telemetry) < GAP


@pytest.mark.long
def test_a_section_without_supply_is_named_and_its_estimate_comes_back_with_the_supply():
    bus = settle(scenario := switched33(3))
    order(bus, {"17-18": False})
    bus.run(2.0)
    assert {state.quality for state in bus.states.values()} == {"unobservable"}
    order(bus, {"17-18": True}, 2)
    bus.run(2.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, scenario, make_telemetry(scenario)) < GAP


@pytest.mark.parametrize("strategy", ["admm", "angle-offset"])
def test_a_strategy_that_cannot_operate_switches_refuses_them_by_name(strategy):
    scenario = replace(tied33(3, (), switches=("7-8",)), strategy=strategy)
    with pytest.raises(InvalidInputError, match=f"switch 7-8, which strategy '{strategy}' cannot operate"):
        check_with_strategy(scenario)
