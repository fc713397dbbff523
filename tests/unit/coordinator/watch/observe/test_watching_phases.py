"""Networks with phases as a watcher shows them: a row a node, and sentences that name it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation, StateMessage
from agents.protocol.quality import EstimateLimits
from agents.strategies.interface import Estimate
from coordinator.field.gateway.results import make_result
from coordinator.watch.observe.area_flows import make_area_flows
from coordinator.watch.observe.causes import find_causes
from coordinator.watch.observe.grid_tables import GridTables, find_tables
from coordinator.watch.observe.notes import read_notes
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.view_json import describe_summary
from coordinator.watch.observe.view_text import format_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.grid.boundary import Kind
from dsse_core.results.results import results_of_power_flow
from dsse_core.results.state import find_state
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.shown_states import published_by

SCENARIO = load_scenario("ieee13")
PARTITION, NETWORK = SCENARIO.partition, SCENARIO.network
FLOW = make_telemetry(SCENARIO).truth
KNOWN = GridTables(SCENARIO)
FIRST = Incarnation(1, 1)


def state_of(name: str, **changes: Any) -> StateMessage:
    """The state that an area would publish of the true voltages, its nodes in another order."""
    assert FLOW is not None
    own, rows = PARTITION.area(name).network, PARTITION.rows_of_nodes[name][::-1]
    numbers = {
        "vm": FLOW.vm[rows],
        "va": FLOW.va[rows],
        "sigma_vm": 1e-3 * FLOW.vm[rows],
        "sigma_va": 0 * FLOW.vm[rows],
    }
    listed = {key: tuple(values.tolist()) for key, values in numbers.items()}
    nodes = {"buses": own.node_buses[::-1], "phases": own.node_phases[::-1]}
    neighbours = [neighbour.area for neighbour in PARTITION.area(name).neighbours]
    heard = {"sent": dict.fromkeys(neighbours, (1, 1)), "ages": dict.fromkeys(neighbours, 0.1)}
    return published_by(name, FIRST, **(listed | nodes | heard | changes))


def watch(*states: StateMessage) -> Watcher:
    watcher = Watcher("run", frozenset(area.name for area in PARTITION.areas))
    for state in states:
        watcher.take_presence(live_key("run", "area", state.header.sender, FIRST), True)
        watcher.take_state(state, 0.0)
    return watcher


@pytest.fixture(scope="module")
def all_good() -> Watcher:
    return watch(*(state_of(area.name) for area in PARTITION.areas))


def test_tables_of_a_watcher_are_those_of_the_power_flow_node_by_node(all_good: Watcher) -> None:
    assert FLOW is not None
    found, expected = find_tables(all_good, all_good.look(0.1), KNOWN), results_of_power_flow(FLOW)
    assert found.branches is not None
    assert found.buses.phase == expected.buses.phase
    np.testing.assert_allclose(found.buses.vm_kv, expected.buses.vm_kv)
    np.testing.assert_allclose(found.buses.p_kw, expected.buses.p_kw, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.branches.neutral_a, expected.branches.neutral_a, rtol=0, atol=1e-6)
    plain = find_tables(all_good, all_good.look(0.1), None).buses
    seen = sum(area.network.n_nodes for area in PARTITION.areas)
    assert (len(plain), {*plain.phase}) == (seen, {"a", "b", "c"})


def test_the_summary_counts_nodes_and_conductors_and_causes_name_them(all_good: Watcher) -> None:
    view = all_good.look(0.1)
    tables = find_tables(all_good, view, KNOWN)
    summary = summarise(tables, KNOWN)
    assert summary.voltage.total == NETWORK.n_nodes
    assert summary.voltage.lowest is not None
    lowest = int(np.argmin(tables.buses.vm_pu))
    assert summary.voltage.lowest.at == NETWORK.node_names[lowest]
    assert describe_summary(summary)["has_phases"]
    three = {bus.id for bus in NETWORK.buses if len(NETWORK.nodes_at(bus.id)) == 3}
    assert (summary.unbalance.known, summary.unbalance.total) == (len(three), len(three))
    assert summary.unbalance.highest is not None
    assert summary.unbalance.highest.value == pytest.approx(np.nanmax(tables.buses.unbalance_percent))
    loss = np.nansum(results_of_power_flow(FLOW).branches.loss_kw) if FLOW else 0.0
    assert summary.loss.p_kw == pytest.approx(loss)
    limits = replace(summary.limits, lowest_vm=summary.voltage.lowest.value + 1e-6)
    strict = summarise(tables, GridTables(replace(SCENARIO, operating_limits=limits)))
    (cause,) = [cause for cause in find_causes(view, 0.1, summary=strict) if cause.kind == "low voltage"]
    assert f"bus {NETWORK.node_names[lowest]} is at" in str(cause)
    assert cause.buses == (int(tables.buses.bus[lowest]),)
    most = summary.unbalance.highest.value - 1e-6
    uneven = summarise(
        tables, GridTables(replace(SCENARIO, operating_limits=replace(summary.limits, most_unbalance_percent=most)))
    )
    (cause,) = [cause for cause in find_causes(view, 0.1, summary=uneven) if cause.kind == "unbalance"]
    assert f"the unbalance of bus {summary.unbalance.highest.at} is {most:.2f} %" in str(cause)
    assert f"; above {most:g} %: {summary.unbalance.highest.at}\n" in format_view(view, [tables.buses], [], uneven)
    text = format_view(view, [tables.buses], [], summary)
    assert f"{NETWORK.n_nodes} nodes" in text
    assert f"% at bus {summary.unbalance.highest.at}" in text
    assert f"\n{NETWORK.node_names[lowest]} " in text


def test_a_branch_beyond_its_rating_is_named_with_the_phase_and_marked_by_its_id(all_good: Watcher) -> None:
    rated = tuple(replace(b, i_max=0.01) if b.id == "671-684" else b for b in NETWORK.branches)
    network = replace(NETWORK, branches=rated)
    known = GridTables(replace(SCENARIO, network=network, partition=replace(PARTITION, network=network)))
    view = all_good.look(0.1)
    causes = find_causes(view, 0.1, summary=summarise(find_tables(all_good, view, known), known))
    (cause,) = [cause for cause in causes if cause.kind == "loading"]
    assert "branch 671-684." in str(cause)
    assert cause.branches == ("671-684",)


def test_areas_that_disagree_do_so_at_a_node() -> None:
    one, other = (state_of(name) for name in ("area1", "area2"))
    bus, phase = next(node for node in one.nodes if node in other.nodes and node[1] == "b")
    vm = list(other.vm)
    vm[other.row_of(bus, phase)] += 0.01
    watcher = watch(one, replace(other, vm=tuple(vm)), state_of("area3"))
    (cause,) = [
        cause for cause in find_causes(watcher.look(0.1), 0.1, with_magnitudes=True) if cause.kind == "mismatch"
    ]
    assert f"at bus {bus}.{phase} by 0.01 p.u." in str(cause)
    assert cause.buses == (bus,)
    tables = find_tables(watcher, watcher.look(0.1), KNOWN)
    unknown = tables.buses.bus[np.array(tables.buses.injection_problem) == "area1 and area2 differ there"]
    assert {*unknown.tolist()} == {bus}


def test_a_voltage_out_of_its_band_is_said_and_read_with_its_node() -> None:
    network = PARTITION.area("area2").network
    vm = np.ones(network.n_nodes)
    vm[network.node(671, "c")] = 0.4
    zeros = np.zeros(network.n_nodes)
    estimate = Estimate(
        vm=vm,
        va=zeros,
        sigma_vm=zeros,
        sigma_va=zeros,
        referenced=True,
        objective=0.0,
        degrees_of_freedom=0,
        removed=(),
    )
    (finding,) = EstimateLimits(StateLimits(), network, ()).find_breaches(estimate)
    assert finding.note.endswith("at bus 671.c")
    (noted,) = read_notes([finding.note], [], None, 0.0)
    assert (noted.kind, noted.parts["buses"]) == ("band", "671.c")


def test_a_state_of_other_nodes_is_refused_by_node() -> None:
    state = state_of("area2")
    fewer = {key: getattr(state, key)[1:] for key in ("buses", "phases", "vm", "va", "sigma_vm", "sigma_va")}
    with pytest.raises(InvalidInputError, match=r"differ in bus [0-9]+\.[abc];"):
        make_area_flows(PARTITION.area("area2"), replace(state, **fewer))


def test_an_area_that_knows_the_powers_into_its_children_has_the_injection_of_each_node() -> None:
    assert FLOW is not None
    area, into = PARTITION.area("area1"), []
    for power in area.powers_into_children:
        child, rows = PARTITION.area(power.area).network, PARTITION.rows_of_nodes[power.area]
        alone = find_state(child, FLOW.vm[rows], FLOW.va[rows]).injection[child.node(power.bus, power.phase)]
        into.append(alone.real if power.kind is Kind.P else alone.imag)
    buses, _ = make_area_flows(area, state_of("area1", into_children=tuple(into)))
    rows, whole = PARTITION.rows_of_nodes["area1"], results_of_power_flow(FLOW).buses
    assert area.boundary_buses
    assert not any(buses.injection_problem)
    np.testing.assert_allclose(buses.p_kw, whole.p_kw[rows], rtol=0, atol=1e-6)
    np.testing.assert_allclose(buses.q_kvar, whole.q_kvar[rows], rtol=0, atol=1e-6)


def test_results_of_a_gateway_name_the_phase_of_each_row() -> None:
    result = make_result({area.name: area for area in PARTITION.areas}, state_of("area2"))
    network = PARTITION.area("area2").network
    assert [(row["bus"], row["phase"]) for row in result["buses"]] == list(network.nodes)
    neutral = {row["phase"]: row["neutral_a"] for row in result["branches"] if row["branch"] == "632-670"}
    assert neutral == dict.fromkeys("abc", pytest.approx(215.7, abs=0.1))
    unbalance = [row["unbalance_percent"] for row in result["buses"] if row["bus"] == 671]
    assert unbalance == [pytest.approx(1.92, abs=0.01)] * 3
