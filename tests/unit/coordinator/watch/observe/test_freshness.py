"""Every number carries quality and age, and only those of the present count."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation, StateMessage
from agents.protocol.quality import QUALITIES
from coordinator.show.web.moment import Moments
from coordinator.watch.observe.freshness import find_freshness
from coordinator.watch.observe.grid_tables import GridTables, Tables, find_tables
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.view_text import format_view, write_summary
from coordinator.watch.observe.watcher import Watcher
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow
from dsse_core.results.results import results_of_power_flow
from scenarios.scenario import Scenario, load_scenario
from tests.support.shown_states import published_by

FIRST = Incarnation(1, 1)
GONE_S = 200.0


@pytest.fixture(scope="module")
def solved() -> tuple[Scenario, PowerFlowResult]:
    scenario = load_scenario("ieee33")
    return scenario, solve_power_flow(scenario.network)


def state_of(area: str, solved: tuple[Scenario, PowerFlowResult], **changes: Any) -> StateMessage:
    """The state that ``area`` would publish of the true voltages."""
    scenario, flow = solved
    rows = scenario.partition.rows_of_buses[area]
    buses, sigma = tuple(scenario.network.table.bus_id[rows].tolist()), (1e-3,) * len(rows)
    vm, va = tuple(flow.vm[rows].tolist()), tuple(flow.va[rows].tolist())
    stated = {"buses": buses, "vm": vm, "va": va, "sigma_vm": sigma, "sigma_va": sigma} | changes
    return published_by(area, FIRST, **stated)


def watching(solved: tuple[Scenario, PowerFlowResult]) -> Watcher:
    watcher = Watcher("run", frozenset(area.name for area in solved[0].partition.areas))
    for name in sorted(watcher.areas or ()):
        watcher.take_presence(live_key("run", "area", name, FIRST), True)
        watcher.take_state(state_of(name, solved), 0.0)
    return watcher


def look(watcher: Watcher, known: GridTables | None, now: float) -> Tables:
    return find_tables(watcher, watcher.look(now), known)


@pytest.mark.parametrize("quality", QUALITIES)
def test_numbers_are_of_the_present_exactly_where_their_state_is(quality: str):
    is_fresh = quality in ("good", "degraded", "relative-angle")
    assert find_freshness(quality, 3.0, has_estimate=True).fresh == is_fresh
    assert not find_freshness(quality, 3.0, has_estimate=False).fresh


def test_an_area_that_is_gone_keeps_its_numbers_with_their_age_and_none_of_them_counts(solved):
    watcher, known = watching(solved), GridTables(solved[0])
    before = summarise(look(watcher, known, 0.0), known)
    assert (before.voltage.known, before.voltage.total, before.loss.known) == (33, 33, 32)
    watcher.take_presence(live_key("run", "area", "area2", FIRST), False)
    for area in ("area1", "area3"):
        watcher.take_state(replace(state_of(area, solved), header=watcher.states[area].header), GONE_S)
    tables = look(watcher, known, GONE_S)
    buses = tables.buses
    assert set(zip(buses.area, buses.quality, buses.fresh.tolist(), strict=True)) == {
        ("area1", "good", True),
        ("area2", "stale", False),
        ("area3", "good", True),
    }
    of_area2 = np.array(buses.area) == "area2"
    assert buses.value_age_s[of_area2] == pytest.approx(GONE_S + 0.1)
    assert not np.isnan(buses.vm_pu[of_area2]).any()
    after, lost = summarise(tables, known), int(of_area2.sum())
    assert (after.voltage.known, after.voltage.total) == (33 - lost, 33)
    assert after.voltage.lowest is not None
    assert buses.vm_pu[~of_area2].min() == after.voltage.lowest.value
    assert after.loss.known < after.loss.total == 32
    text = format_view(watcher.look(GONE_S), summary=after)
    assert f"of 33 buses {33 - lost} known, within 0.9 to 1.1 p.u.: " in text
    assert "its numbers are 200 s old" in text


def test_a_bus_that_two_areas_show_counts_once_and_by_its_fresh_number(solved):
    watcher = watching(solved)
    watcher.take_presence(live_key("run", "area", "area1", FIRST), False)
    seen = {bus for name in ("area2", "area3") for bus in watcher.states[name].buses}
    voltage = summarise(look(watcher, None, 0.0), None).voltage
    assert (voltage.known, voltage.total) == (len(seen), 33)


def test_the_summary_is_that_of_the_power_flow_beside_the_limits_of_the_scenario(solved):
    scenario, flow = solved
    tight = replace(scenario, operating_limits=OperatingLimits(lowest_vm=0.92))
    known, whole = GridTables(tight), results_of_power_flow(flow)
    found = summarise(look(watching(solved), known, 0.0), known)
    assert found.load.p_kw == pytest.approx(whole.areas.load_kw.sum(), rel=1e-9)
    assert found.loss.p_kw == pytest.approx(whole.areas.loss_kw.sum(), rel=1e-9)
    assert found.head.q_kvar == pytest.approx(whole.buses.q_kvar[whole.buses.bus == 1].sum(), rel=1e-9)
    low = whole.buses.bus[whole.buses.vm_pu < 0.92]
    assert found.voltage.outside == len(low) > 0
    assert any(f"; {len(low)} beyond 0.92 to 1.1 p.u.: " in line for line in write_summary(found))
    assert found.voltage.worst[0].at == str(whole.buses.bus[whole.buses.vm_pu.argmin()])
    assert found.current.highest is not None
    assert found.current.highest.value == pytest.approx(max(whole.branches.i_from_a), rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"scan": 2}, "area1 and area2 are of different scans"),
        ({"quality": "stale"}, "the numbers of area2 are old"),
        ({"buses": ()}, "area2 has no estimate"),
        ({"vm": 0.01}, "area1 and area2 differ there"),
    ],
)
def test_the_injection_of_a_boundary_bus_is_absent_with_its_reason(solved, changes: dict[str, Any], reason: str):
    (bus,) = (bus for bus, names in solved[0].partition.boundaries.items() if "area2" in names)
    state, watcher, known = state_of("area2", solved), watching(solved), GridTables(solved[0])
    if "scan" in changes:
        state = replace(state, header=replace(state.header, scan=2, sequence=2))
    elif "vm" in changes:
        state = replace(state, vm=tuple(vm + changes["vm"] for vm in state.vm))
    elif "buses" in changes:
        state = replace(state, **dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va"), ()))
    else:
        state = replace(state, **changes)
    buses = look(watching(solved), known, 0.0).buses
    assert set(buses.injection_problem) == {""}
    watcher.take_state(replace(state, header=replace(state.header, sequence=2)), 0.0)
    buses = look(watcher, known, 0.0).buses
    at = buses.bus.tolist().index(bus)
    assert buses.injection_problem[at] == reason
    assert np.isnan([buses.p_kw[at], buses.q_kvar[at]]).all()


def test_the_past_has_a_gap_where_nothing_fresh_was_there(solved):
    watcher, moments = watching(solved), Moments(GridTables(solved[0]))
    moments.note(watcher, 0.0, 0.0)
    watcher.take_presence(live_key("run", "area", "area2", FIRST), False)
    moments.note(watcher, 1.0, 1.0)
    (bus,) = (bus for bus, names in solved[0].partition.boundaries.items() if "area2" in names)
    inner = next(each for each in watcher.states["area2"].buses if each != bus)
    for kind, name in (("bus", str(inner)), ("area", "area2")):
        columns = moments.history.read(kind, name)["columns"]
        first = columns["vm_pu" if kind == "bus" else "lowest_vm_pu"]
        assert [np.isnan(value) for value in first] == [False, True], kind
    assert not np.isnan(moments.history.read("bus", "1")["columns"]["vm_pu"]).any()
