"""What the API answers of a network with phases: a row for each node and conductor, and a column of the past."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.watch.observe.watcher import Watcher
from scenarios.scenario import load_scenario
from tests.support.served import Client, client, live, played, wait_for
from tests.support.shown_states import published_by

NETWORK = load_scenario("ieee13").network
NAMES = NETWORK.node_names


@pytest.fixture(scope="module")
def asked() -> Client:
    return client(played("ieee13"))


def names_of(columns: dict[str, Any], key: str) -> list[str]:
    return [f"{thing}.{phase}" for thing, phase in zip(columns[key], columns["phase"], strict=True)]


def test_the_grid_names_the_phases_of_buses_its_nodes_and_its_conductors(asked: Client):
    grid = asked.get("/api/grid").json()
    assert len(grid["buses"]["id"]) == len(NETWORK.buses) == 16
    phases = dict(zip(grid["buses"]["id"], grid["buses"]["phase"], strict=True))
    assert (phases[671], phases[646], phases[684], phases[652]) == ("abc", "bc", "ac", "a")
    assert names_of(grid["nodes"], "bus") == NAMES
    assert len(names_of(grid["conductors"], "branch")) == 38


def test_a_moment_has_numbers_in_the_order_of_nodes_and_conductors(asked: Client):
    grid, now = asked.get("/api/grid").json(), asked.get("/api/now").json()
    rows = {kind: asked.get(f"/api/rows?kind={kind}").json()["rows"] for kind in ("bus", "branch")}
    assert names_of(rows["bus"], "id") == names_of(grid["nodes"], "bus")
    assert names_of(rows["branch"], "id") == names_of(grid["conductors"], "branch")
    np.testing.assert_allclose(now["buses"]["vm_pu"], rows["bus"]["vm_pu"], rtol=0, atol=1e-5)
    assert len(now["branches"]["fresh"]) == len(grid["conductors"]["phase"])
    assert "phase" in now["meters"]
    assert now["summary"]["has_phases"]
    three = {bus.id for bus in NETWORK.buses if len(NETWORK.nodes_at(bus.id)) == 3}
    assert (now["summary"]["voltage"]["total"], now["summary"]["unbalance"]["total"]) == (len(NAMES), len(three))


def test_a_moment_names_of_each_bus_the_node_that_is_nearest_to_a_limit(asked: Client):
    grid, now = asked.get("/api/grid").json(), asked.get("/api/now").json()
    bus, limits = np.array(grid["nodes"]["bus"]), grid["operating_limits"]
    off = abs(np.array(now["buses"]["vm_pu"]) - (limits["lowest_vm_pu"] + limits["highest_vm_pu"]) / 2)
    assert sorted(bus[now["worst_nodes"]].tolist()) == sorted(grid["buses"]["id"])
    assert all(off[row] == max(off[bus == bus[row]]) for row in now["worst_nodes"])


def test_rows_have_kv_to_ground_unbalance_and_the_current_in_the_neutral(asked: Client):
    rows = asked.get("/api/rows?kind=bus&id=671").json()["rows"]
    assert rows["phase"] == ["a", "b", "c"]
    np.testing.assert_allclose(rows["vm_kv"], np.array(rows["vm_pu"]) * 4.16 / np.sqrt(3.0), atol=1e-5)
    v = np.array(rows["vm_pu"]) * np.exp(1j * np.radians(rows["va_deg"]))
    sequences = [abs(v @ np.exp(2j * np.pi / 3 * np.array(turns))) for turns in ((0, 2, 1), (0, 1, 2))]
    np.testing.assert_allclose(rows["unbalance_percent"], 100 * sequences[0] / sequences[1], atol=1e-3)
    branch = asked.get("/api/rows?kind=branch&id=632-670").json()["rows"]
    s = np.array(branch["p_from_kw"]) + 1j * np.array(branch["q_from_kvar"])
    at = asked.get("/api/rows?kind=bus&id=632").json()["rows"]
    i = (s / (np.array(at["vm_kv"]) * np.exp(1j * np.radians(at["va_deg"])))).conj()
    np.testing.assert_allclose(branch["i_from_a"], abs(i), rtol=1e-4)
    np.testing.assert_allclose(branch["neutral_a"], abs(i.sum()), rtol=1e-3)


def test_meters_at_a_bus_or_branch_can_be_asked_for(asked: Client):
    at_bus = asked.get("/api/rows?kind=meter&at=611").json()["rows"]
    assert {*at_bus["id"]} == {"vm@611.c", "p_injection@611.c", "q_injection@611.c"}
    assert {*at_bus["phase"]} == {"c"}
    at_branch = asked.get("/api/rows?kind=meter&at=671-684").json()["rows"]
    assert len(at_branch["id"]) == 4
    assert asked.get("/api/rows?kind=bus&at=611").status_code == 400
    assert asked.get("/api/rows?kind=meter&at=nowhere").json()["rows"]["id"] == []


def test_the_past_has_a_column_for_each_phase_that_a_bus_or_branch_has(asked: Client):
    def columns_of(kind: str, name: str) -> dict[str, Any]:
        columns: dict[str, Any] = asked.get("/api/history", params={"kind": kind, "id": name}).json()["columns"]
        return columns

    found = columns_of("bus", "684")
    quantities = ("vm_pu", "sigma_vm_pu", "va_deg")
    assert found.keys() == {"unbalance_percent", *(f"{name}.{phase}" for name in quantities for phase in "ac")}
    rows = asked.get("/api/rows?kind=bus&id=684").json()["rows"]
    assert [found[f"vm_pu.{phase}"][-1] for phase in "ac"] == pytest.approx(rows["vm_pu"], abs=1e-6)
    assert columns_of("bus", "671")["unbalance_percent"][-1] > 1
    assert columns_of("branch", "645-646").keys() >= {"i_from_a.b", "i_from_a.c", "neutral_a"}


def test_without_a_scenario_a_bus_has_the_phases_of_all_areas_that_see_it():
    watcher, ME = Watcher("run"), Incarnation(1, 1)
    of = {"area1": ((1, "a"), (1, "b"), (1, "c"), (2, "a"), (2, "c")), "area2": ((2, "c"), (3, "c"))}
    for name, nodes in of.items():
        buses, phases = zip(*nodes, strict=True)
        numbers = dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), (0.9,) * len(nodes))
        sent = dict.fromkeys([other for other in of if other != name], (1, 1))
        watcher.take_presence(live_key("run", "area", name, ME), True)
        watcher.take_state(published_by(name, ME, buses=buses, phases=phases, sent=sent, **numbers), 0.0)
    with live(watcher) as source:
        wait_for(lambda: source.newest.number > 1)
        grid, now = (client(source).get(f"/api/{path}").json() for path in ("grid", "now"))
        assert (grid["buses"]["id"], grid["buses"]["phase"]) == ([1, 2, 3], ["abc", "ac", "c"])
        assert names_of(grid["nodes"], "bus") == ["1.a", "1.b", "1.c", "2.a", "2.c", "3.c"]
        assert names_of(now["buses"], "id") == ["1.a", "1.b", "1.c", "2.a", "2.c", "2.c", "3.c"]
        assert now["summary"]["voltage"]["total"] == len(grid["nodes"]["bus"])
