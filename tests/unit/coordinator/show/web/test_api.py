"""What the API answers: of a run that is played back, and of what only the bus tells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import msgspec.inspect
import pytest
from starlette.applications import Starlette
from starlette.routing import Mount, Route

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.show.web.app import make_app
from coordinator.show.web.openapi import ANSWERS, Problem
from coordinator.watch.http_front import Front
from coordinator.watch.observe.watcher import Watcher
from tests.support.served import client, live, played, wait_for
from tests.support.shown_states import a_state, published_by


def test_the_grid_is_described_in_the_order_of_its_columns():
    grid = client(played()).get("/api/grid").json()
    assert (grid["known"], grid["mode"], len(grid["buses"]["id"])) == (True, "playback", 13)
    assert {len(column) for column in grid["buses"].values()} == {13}
    assert {len(column) for column in grid["branches"].values()} == {12}
    assert grid["buses"]["areas"][grid["buses"]["id"].index(3)] == ["area1", "area2"]


def test_the_last_moment_of_a_run_shows_all_areas_and_every_bus():
    now = client(played()).get("/api/now").json()
    assert {area["quality"] for area in now["view"]["areas"].values()} == {"good"}
    assert len(now["buses"]["vm_pu"]) == 13
    assert all(0.9 < vm < 1.1 for vm in now["buses"]["vm_pu"])
    assert len(now["branches"].get("loading_percent", range(12))) == 12


def test_each_row_says_whether_it_is_fresh_and_a_summary_counts_those_that_are():
    asked = client(played())
    grid, now = asked.get("/api/grid").json(), asked.get("/api/now").json()
    assert now["buses"]["fresh"] == [True] * 13
    assert now["summary"]["voltage"]["known"] == now["summary"]["voltage"]["total"] == 13
    assert now["summary"]["loss"]["p_kw"] > 0
    assert grid["operating_limits"] == {
        **{"lowest_vm_pu": 0.9, "highest_vm_pu": 1.1, "most_loading_percent": 100.0, "most_residual": 3.0},
        "most_unbalance_percent": 3.0,
    }
    first = asked.get("/api/frame/0").json()
    assert first["buses"]["fresh"] == [False] * 13
    assert first["summary"]["voltage"]["known"] == 0
    row = asked.get("/api/rows?kind=bus&id=3").json()["rows"]
    assert (row["quality"], row["fresh"], row["injection_problem"]) == (["good"], [True], [""])
    assert row["value_age_s"][0] >= 0.0


def test_rows_have_what_a_moment_leaves_out():
    asked = client(played())
    grid, now = asked.get("/api/grid").json(), asked.get("/api/now").json()
    for kind, some in (("bus", 3), ("branch", "1-2"), ("meter", "vm@1")):
        found = asked.get("/api/rows", params={"kind": kind, "id": some}).json()
        assert found["rows"]["id"] == [str(some)]
        assert {len(column) for column in found["rows"].values()} == {1}
    buses = asked.get("/api/rows?kind=bus").json()["rows"]
    assert buses["id"] == [str(bus) for bus in grid["buses"]["id"]]
    assert [round(vm, 5) for vm in buses["vm_pu"]] == now["buses"]["vm_pu"]  # of which the moment has no ids
    branches = asked.get("/api/rows?kind=branch").json()["rows"]
    assert branches["id"] == grid["branches"]["id"]
    assert None not in branches["p_from_kw"]
    for kind, names in (("branch", ("p_from_kw", "q_from_kvar")), ("bus", ("vm_pu", "p_kw", "q_kvar"))):
        first = asked.get(f"/api/rows?kind={kind}&frame=0").json()["rows"]
        assert {value for name in names for value in first[name]} == {None}, kind


def test_meters_come_page_by_page_the_worst_first():
    asked = client(played())
    whole = asked.get("/api/rows?kind=meter").json()
    assert whole["total"] == len(whole["rows"]["id"]) == sum(asked.get("/api/now").json()["meter_counts"].values())
    off = [value for value in whole["rows"]["normalised_residual"] if value is not None]
    assert off == sorted(off, reverse=True)
    pages = [asked.get(f"/api/rows?kind=meter&first={k}&count=7").json()["rows"]["id"] for k in range(0, 500, 7)]
    assert [name for page in pages for name in page] == whole["rows"]["id"]


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("kind=area", 400),
        ("", 400),
        ("kind=meter&first=-1", 400),
        ("kind=meter&count=x", 400),
        ("kind=meter&count=٣", 400),
        ("kind=bus&id=" + "x" * 300, 400),
        ("kind=meter&frame=99999999999999999999999", 404),
        ("kind=meter&first=" + "9" * 5000, 200),
        ("kind=bus&id=<script>", 200),
        ("kind=branch&count=0", 200),
    ],
)
def test_a_strange_question_for_rows_has_an_answer(query: str, status: int):
    answer = client(played()).get(f"/api/rows?{query}")
    assert answer.status_code == status
    assert status != 200 or answer.json()["rows"]["id"] == []


def test_frames_go_from_nothing_to_an_estimate_and_show_what_is_lost():
    asked = client(played("ieee33-lossy"))
    times = asked.get("/api/frames").json()["times"]
    assert times == sorted(times)
    frames = [asked.get(f"/api/frame/{k}").json() for k in range(len(times))]
    assert {area["quality"] for area in frames[0]["view"]["areas"].values()} == {"none"}
    assert {area["quality"] for area in frames[-1]["view"]["areas"].values()} == {"good"}
    messages = [m for frame in frames for m in frame["messages"]]
    assert {m["lost"] for m in messages} == {True, False}
    assert all(m["arrived"] is None or m["sent"] < m["arrived"] <= times[-1] for m in messages)
    assert {(m["from"], m["to"]) for m in messages} == {
        ("area1", "area2"),
        ("area2", "area1"),
        ("area1", "area3"),
        ("area3", "area1"),
    }
    assert [frame["number"] for frame in frames] == list(range(len(times)))
    assert frames[3]["events"] == [event for event in frames[-1]["events"] if event["time"] <= times[3]]


def test_the_past_of_each_kind_can_be_asked_for():
    asked = client(played())
    for kind, name in (("bus", "3"), ("branch", "1-2"), ("area", "area1"), ("meter", "vm@1")):
        past = asked.get("/api/history", params={"kind": kind, "id": name}).json()
        assert past["time"] == sorted(past["time"])
        assert {len(column) for column in past["columns"].values()} == {len(past["time"])}
        assert past["time"]


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("kind=bus&id=x", 400),
        ("kind=bus&id=٣", 400),
        ("kind=__class__&id=1", 400),
        ("", 400),
        ("kind=area&id=" + "x" * 300, 400),
        ("kind=bus&id=9999999999", 200),
        ("kind=meter&id=<script>", 200),
    ],
)
def test_a_strange_question_has_an_answer(query: str, status: int):
    answer = client(played()).get(f"/api/history?{query}")
    assert answer.status_code == status
    assert status == 400 or answer.json()["time"] == []


ABSENT = ["/api/frame/100000", "/api/frame/-1", "/api/frame/x", "/static/../app.py", "/static/%2e%2e/app.py", "/a.py"]


@pytest.mark.parametrize("path", ABSENT)
def test_what_is_not_there_is_not_found(path: str):
    assert client(played()).get(path).status_code == 404


def test_the_description_of_the_api_has_every_path():
    described = client(played()).get("/api/openapi.json").json()["paths"]
    app = make_app(played(), Front(())).app
    assert isinstance(app, Starlette)
    served = {route.path for route in app.routes if isinstance(route, Route | Mount)}
    assert set(described) == served - {"/", "/static"}
    assert set(described["/api/frame/{number}"]["get"]["responses"]) == {"200", "401", "403", "404", "421"}


def check_keys(path: str, found: dict[str, Any]) -> None:
    """Checks that an answer has all keys that the description of the API states, and no other."""
    described = msgspec.inspect.type_info(ANSWERS[path])
    if isinstance(described, msgspec.inspect.TypedDictType):
        keys = {field.name: field.required for field in described.fields}
        assert {name for name, is_required in keys.items() if is_required} <= found.keys() <= keys.keys(), path


@pytest.mark.parametrize(("name", "meter"), [("ieee33-lossy", "vm@1"), ("ieee13", "vm@671.a")])
def test_every_answer_has_the_type_that_the_description_of_the_api_states(name: str, meter: str):
    asked = client(played(name))
    paths = {
        "/health": "",
        "/api/grid": "",
        "/api/now": "",
        "/api/history": f"?kind=meter&id={meter}",
        "/api/rows": "?kind=meter",
        "/api/frames": "",
        "/api/frame/{number}": "",
        "/api/openapi.json": "",
    }
    described = asked.get("/api/openapi.json").json()
    for path, query in paths.items():
        body = asked.get(path.replace("{number}", "3") + query).content
        found = msgspec.json.decode(body, type=ANSWERS[path])
        check_keys(path, found)
        schema = described["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"]
        assert schema.get("$ref", f"#/components/schemas/{ANSWERS[path].__name__}").endswith(ANSWERS[path].__name__)
    assert {"Moment", "Grid", "Rows", "Past", "Problem"} <= described["components"]["schemas"].keys()
    assert msgspec.json.decode(asked.get("/api/rows").content, type=Problem)


def test_without_a_scenario_the_page_shows_what_is_on_the_bus():
    watcher = Watcher("run")
    pair = {"va": (0.0, 0.0), "sigma_vm": (0.1, 0.1), "sigma_va": (0.1, 0.1)}
    one = a_state(buses=(1, 2), vm=(1.0, 0.99), sent={"area2": (1, 1)}, **pair)
    other = published_by("area2", Incarnation(1, 1), buses=(2, 3), vm=(0.99, 0.98), sent={"area1": (1, 1)}, **pair)
    for state in (one, other):
        watcher.take_presence(live_key("run", "area", state.header.sender, Incarnation(1, 1)), True)
        watcher.take_state(state, 0.0)
    with live(watcher) as source:
        wait_for(lambda: source.newest.number > 1)
        asked = client(source)
        grid = asked.get("/api/grid").json()
        assert (grid["known"], grid["buses"]["id"], grid["branches"]["id"]) == (False, [1, 2, 3], [])
        assert grid["areas"][0]["neighbours"] == [{"area": "area2", "bus": 2}]
        now = asked.get("/api/now").json()
        assert now["mode"] == "live"
        assert sorted({*now["buses"]["id"]}) == [1, 2, 3]
        assert asked.get("/api/frames").json() == {"times": [], "since": 0.0, "remarks": [], "complete": True}


def test_markup_of_strangers_is_sent_as_text():
    watcher = Watcher("run")
    name = "<img src=x onerror=alert(1)>"
    state = published_by("area1", Incarnation(1, 1), notes=("</script><script>alert(1)</script>",), quality=name)
    watcher.take_state(replace(state, header=replace(state.header, sender=name)), 0.0)
    with live(watcher) as source:
        wait_for(lambda: source.newest.number > 1)
        answer = client(source).get("/api/now")
        assert answer.headers["content-type"] == "application/json"
        assert name in answer.json()["view"]["areas"]
