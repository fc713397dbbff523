"""Results go out in kV, kW and A, of each area the newest; a slow or broken sink loses none that is newest."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.packing import StateMessage
from coordinator.field.gateway.results import ResultQueue, SilentAreas, make_result
from coordinator.field.gateway.sinks.json_lines import JsonLinesSettings, JsonLinesSink
from dsse_core.grid.partition import Area
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import results_of_power_flow
from scenarios.scenario import Scenario, load_scenario
from tests.support.shown_states import a_state


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("ieee33")


@pytest.fixture(scope="module")
def areas(scenario: Scenario) -> dict[str, Area]:
    return {area.name: area for area in scenario.partition.areas}


@pytest.fixture(scope="module")
def state(scenario: Scenario) -> StateMessage:
    """What area1 would say of the power flow."""
    flow, area = solve_power_flow(scenario.network), scenario.partition.area("area1")
    buses = tuple(bus.id for bus in area.network.buses)
    rows = [scenario.network.row[bus] for bus in buses]
    sigma = (1e-3,) * len(buses)
    vm, va = tuple(flow.vm[rows].tolist()), tuple(flow.va[rows].tolist())
    return a_state(buses=buses, vm=vm, va=va, sigma_vm=sigma, sigma_va=sigma)


def test_a_result_has_what_flows_in_kw_and_a(scenario: Scenario, areas: dict[str, Area], state: StateMessage) -> None:
    whole = results_of_power_flow(solve_power_flow(scenario.network)).branches
    result = make_result(areas, state)
    assert (result["area"], result["quality"], result["problem"]) == ("area1", "good", "")
    branch = next(row for row in result["branches"] if row["branch"] == "1-2")
    assert branch["p_from_kw"] == pytest.approx(whole.p_from_kw[whole.branch.index("1-2")])
    assert branch["i_from_a"] == pytest.approx(whole.i_from_a[whole.branch.index("1-2")])
    assert result["buses"][0]["vm_kv"] == pytest.approx(12.66 * result["buses"][0]["vm_pu"])
    json.dumps(result, allow_nan=False)


def test_each_number_of_a_result_says_how_good_and_how_old_it_is(areas: dict[str, Area], state: StateMessage) -> None:
    result = make_result(areas, replace(state, quality="stale", telemetry_age=203.5))
    rows = [*result["buses"], *result["branches"]]
    assert {(row["quality"], row["value_age_s"], row["fresh"]) for row in rows} == {("stale", 203.5, False)}
    boundary = [row for row in result["buses"] if row["bus"] in areas["area1"].boundary_buses]
    assert {(row["p_kw"], row["q_kvar"]) for row in boundary} == {(None, None)}  # the state lacks what flows out there
    assert all(row["injection_problem"].startswith("area1 does not know the power into") for row in boundary)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"buses": (), "vm": (), "va": ()}, "no estimate"), ({"buses": (77,), "vm": (1.0,), "va": (0.0,)}, "differ")],
)
def test_a_result_without_an_estimate_says_why(
    areas: dict[str, Area], changes: dict[str, object], problem: str
) -> None:
    result = make_result(areas, a_state(**changes))
    assert problem in result["problem"]
    assert result["buses"] == []


def test_a_stranger_is_named_as_such(areas: dict[str, Area], state: StateMessage) -> None:
    strange = replace(state, header=replace(state.header, sender="nobody"))
    assert "no such area" in make_result(areas, strange)["problem"]


def test_of_an_area_that_falls_silent_one_more_result_says_that_its_numbers_are_old(
    areas: dict[str, Area], state: StateMessage
) -> None:
    silent = SilentAreas("run", areas)
    silent.take(state, 0.0)
    assert not [*silent.find(1.0)]
    (last,) = silent.find(5.0)
    result = make_result(areas, last)
    assert (result["quality"], result["notes"][0]) == ("stale", "has sent nothing for 5.0 s")
    assert {(row["fresh"], row["value_age_s"]) for row in result["buses"]} == {(False, 5.1)}
    assert result["time"] == state.header.time + 5.0
    assert not [*silent.find(9.0)]
    silent.take(replace(state, header=replace(state.header, sequence=2)), 10.0)
    assert not [*silent.find(11.0)]
    assert [each.quality for each in silent.find(60.0)] == ["stale"]


def test_a_slow_sink_gets_the_newest_of_each_area(areas: dict[str, Area], state: StateMessage) -> None:
    async def test() -> ResultQueue:
        queue = ResultQueue(areas)
        for scan in range(1000):
            for area in ("area1", "area2"):
                queue.put(replace(state, header=replace(state.header, sender=area, scan=scan)))
        found = [await anext(queue) for _ in range(2)]
        assert [(result["area"], result["scan"]) for result in found] == [("area1", 999), ("area2", 999)]
        return queue

    assert asyncio.run(test()).superseded == 1998


def test_what_a_broken_sink_had_in_hand_comes_again(areas: dict[str, Area], state: StateMessage) -> None:
    async def test() -> None:
        queue = ResultQueue(areas)
        queue.put(state)
        await anext(queue)
        queue.begin()
        assert (await anext(queue))["area"] == "area1"
        assert queue.written == 0

    asyncio.run(test())


def test_json_lines_are_written_one_by_one(areas: dict[str, Area], state: StateMessage, tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"

    async def test() -> None:
        queue = ResultQueue(areas)
        sink = JsonLinesSink(JsonLinesSettings.model_validate({"path": str(path)}))
        task = asyncio.create_task(sink.write(queue))
        for count in (1, 2):
            queue.put(state)
            async with asyncio.timeout(180.0):
                while not path.exists() or path.read_text().count("\n") < count:
                    await asyncio.sleep(0.005)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(test())
    assert [json.loads(line)["area"] for line in path.read_text().splitlines()] == ["area1", "area1"]
