"""Switches operated while areas run: states are the centre's with these statuses, which only the holder knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from agents.protocol.events import Ordered
from coordinator.lab.evaluation.comparison import compare
from coordinator.lab.evaluation.evaluation import estimate_centralised
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.watch.observe.switches import find_statuses
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.nodes import name_node
from dsse_core.grid.switches import keep_in_service
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import Telemetry, make_telemetry
from tests.support.levels import further, many_more
from tests.support.rings import ACROSS, TIES, switched13, tied33
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links

GAP = 1e-9  # p.u.


def switched33(n_area: int, *further: str) -> Scenario:
    """ieee33 with its five ties open; these, a branch of each ring, and ``further`` ones may be operated."""
    return tied33(n_area, (), switches=(*TIES, *ACROSS, *further))


def settle(scenario: Scenario, loss: float = 0.0) -> SimulatedBus:
    files = with_links(area_files_of(scenario, strategy="information"), LinkFaults(loss=loss))
    bus = SimulatedBus(files, make_telemetry(scenario).by_area)
    bus.run(3.0)
    return bus


def read_after(scenario: Scenario, closed: Mapping[str, bool]) -> tuple[Scenario, Telemetry, dict]:
    """The scenario after ``closed``, its telemetry, and that of areas."""
    telemetry = make_telemetry(scenario, closed=closed)
    return scenario.operated(closed), telemetry, telemetry.by_area


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


def assert_equals_fed_centre(bus: SimulatedBus, scenario: Scenario, telemetry: Telemetry) -> None:
    """That all areas are good, equal to the centre of the part with supply, and state 0 elsewhere."""
    report = estimate_centralised(scenario, telemetry).report
    comparison = compare(scenario.partition, bus.states, None, report)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert comparison.gap.vm_pu < GAP
    assert np.radians(comparison.gap.va_deg) < GAP
    totals = bus.protocols["area1"].outcome.totals
    assert totals.objective == pytest.approx(report.objective, rel=1e-6)
    assert totals.degrees_of_freedom == report.degrees_of_freedom
    dead = {scenario.network.nodes[row] for row in scenario.network.dead}
    for state in bus.states.values():
        for node, vm, sigma in zip(state.nodes, state.vm, state.sigma_vm, strict=True):
            assert (vm == 0.0) == (sigma == 0.0) == (node in dead)
        assert not {f"vm@{name_node(*node)}" for node in dead} & set(state.removed)


DARK = [(3, {"28-29": False}), (5, {"7-8": False}), (8, {"7-8": False, "28-29": False}), (5, {"2-3": False})]


@pytest.mark.parametrize("case", [(3, {"7-8": False}), *further(*DARK)])
def test_a_section_without_supply_is_at_0_the_rest_as_if_it_were_the_grid_and_it_comes_back(case):
    n_area, opened = case
    bus, before = settle(scenario := switched33(n_area, "2-3")), make_telemetry(scenario)
    operated, telemetry, by_area = read_after(scenario, opened)
    order(bus, opened)
    bus.next_scan(by_area)
    bus.run(3.0)
    assert_equals_fed_centre(bus, operated, telemetry)
    assert any("without supply: buses" in note for state in bus.states.values() for note in state.notes)
    order(bus, dict.fromkeys(opened, True), 2)
    bus.next_scan(before.by_area)
    bus.run(3.0)
    assert_equals_fed_centre(bus, scenario, before)


FEW_PHASES = [{"632-670.c": False, "633-680": False}, {"671-684.a": False}, {"60-632.a": False, "60-632.b": False}]
DRAWN = [{s: k >> i & 3 > 0 for i, s in enumerate(switched13().network.switches)} for k in range(37, 8000, 398)]


@pytest.mark.parametrize("closed", [*further(*FEW_PHASES[:2]), *many_more(*FEW_PHASES[2:], *DRAWN)])
def test_phases_without_supply_are_at_0_the_others_as_the_centre_has_them_and_they_come_back(closed):
    """The second scan: in the first one the earliest messages still speak of what is dead since, by coupling."""
    bus, before = settle(scenario := switched13()), make_telemetry(scenario)
    operated, telemetry, by_area = read_after(scenario, closed)
    order(bus, closed)
    for _ in range(2):
        bus.next_scan(by_area)
        bus.run(3.0)
    assert_equals_fed_centre(bus, operated, telemetry)
    network = operated.network
    notes = " ".join(note for state in bus.states.values() for note in state.notes if "without supply" in note)
    dead = {
        network.node_buses[node]: bool(network.is_dead[network.nodes_at(network.node_buses[node])].all())
        for node in np.flatnonzero(network.is_dead).tolist()
    }
    assert dead
    assert all((f"{at}." in notes) != is_whole for at, is_whole in dead.items())
    order(bus, scenario.network.switches, 2)
    for _ in range(2):
        bus.next_scan(before.by_area)
        bus.run(3.0)
    assert_equals_fed_centre(bus, scenario, before)


LEGS_AT_THE_END = """
name = "legs"
data_source = "made up"
base_mva = 1.0
bus = [
    { id = 1, base_kv = 4.16, phases = "abc" },
    { id = 2, base_kv = 4.16, phases = "abc" },
    { id = 3, base_kv = 4.16, phases = "abc" },
]
branch = [
    { from = 1, to = 2, phases = "a", r_ohm = 0.1, x_ohm = 0.3, id = "a", switch = true },
    { from = 1, to = 2, phases = "b", r_ohm = 0.1, x_ohm = 0.3, id = "b", switch = true },
    { from = 1, to = 2, phases = "c", r_ohm = 0.1, x_ohm = 0.3, id = "c", switch = true },
    { from = 2, to = 3, phases = "abc", r_ohm = 0.1, x_ohm = 0.3 },
]
load = [
    { bus = 2, phases = "a,b,c", p_kw = [5.0, 6.0, 8.0], q_kvar = [2.0, 2.4, 3.2] },
    { bus = 3, phases = "bc", p_kw = [3.0], q_kvar = [1.2] },
]
source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }]
"""
IN_TWO_AREAS = """
version = 1
description = "legs between two phases at the end of a feeder"
network = "legs.toml"
areas.area1.buses = [1, 2]
areas.area2.buses = [2, 3]
measurements.floor_kva = 0.1
measurements.voltage = { buses = "all", sigma_percent = 0.5 }
measurements.flow = { branches = "all", sigma_percent = 1.0 }
measurements.injection = { buses = "all", sigma_percent = 5.0 }
telemetry.noise = false
"""


@pytest.mark.parametrize("opened", ["bc", *further("c", "a")])
def test_a_sum_of_currents_that_follows_from_the_nodes_with_supply_is_no_second_constraint(tmp_path, opened):
    """Legs stand between b and c alone: once both are dead, the sum at bus 3 is the current of a, which is 0 itself."""
    (tmp_path / "legs.toml").write_text(LEGS_AT_THE_END)
    (tmp_path / "scenario.toml").write_text(IN_TWO_AREAS)
    bus = settle(scenario := load_scenario(tmp_path / "scenario.toml"))
    operated, telemetry, by_area = read_after(scenario, dict.fromkeys(opened, False))
    order(bus, dict.fromkeys(opened, False))
    for _ in range(2):
        bus.next_scan(by_area)
        bus.run(3.0)
    assert_equals_fed_centre(bus, operated, telemetry)
    report = estimate_centralised(operated, telemetry).report
    assert telemetry.truth is not None
    assert report.removed == ()
    assert abs(report.result.vm - telemetry.truth.vm).max() < GAP
    result, exact = report.result, [m.meter for m in report.result.measurements if m.meter.source is Source.VIRTUAL]
    H = build_measurement_model(result.network, build_admittance(result.network), exact).jacobian(result.x)
    assert np.linalg.matrix_rank(H.toarray()[:, np.tile(~result.network.is_dead, 2)]) == len(exact)
    assert ("i_real@3" not in {meter.id for meter in exact}) == (opened == "bc")


@pytest.mark.long
def test_a_voltage_where_there_is_no_supply_takes_good_from_all_and_names_the_open_branches_around():
    bus = settle(scenario := switched33(5))
    order(bus, {"7-8": False})
    bus.run(2.0)
    assert {state.quality for state in bus.states.values()} == {"degraded"}
    voltmeters = {m.id for m in scenario.meters if m.kind is MeasurementKind.VM and 8 <= m.bus <= 18}
    note = next(note for note in bus.states["area1"].notes if "read a voltage where there is no supply" in note)
    assert voltmeters
    assert all(meter in note for meter in voltmeters)
    assert "open around: 12-22, 18-33, 21-8, 7-8, 9-15; check these statuses" in note


def test_a_voltage_between_a_dead_phase_and_a_live_one_contradicts_nothing():
    whole, between = switched13(), Meter(MeasurementKind.VM, 684, phases="ac")
    scenario = replace(whole, meters=(*whole.meters, between))
    bus, closed = settle(scenario), {"671-684.a": False}
    _, telemetry, by_area = read_after(scenario, closed)
    assert next(m.value for m in telemetry.union if m.meter == between) > 0.5
    order(bus, closed)
    bus.next_scan(by_area)
    bus.run(3.0)
    notes = [note for state in bus.states.values() for note in state.notes]
    assert any("without supply" in note and "684.a" in note for note in notes)
    assert not any("read a voltage" in note for note in notes)


@pytest.mark.parametrize("strategy", ["admm", "angle-offset"])
def test_a_strategy_that_cannot_operate_switches_refuses_them_by_name(strategy):
    scenario = replace(tied33(3, (), switches=("7-8",)), strategy=strategy)
    with pytest.raises(InvalidInputError, match=f"switch 7-8, which strategy '{strategy}' cannot operate"):
        check_with_strategy(scenario)
