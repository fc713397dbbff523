"""What metrics, health and readiness say of a run that is seen, and over HTTP."""

from __future__ import annotations

import json
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace

import pytest
from prometheus_client.parser import text_string_to_metric_families
from shown_states import a_state

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.listen import parse_listen
from coordinator.metrics.collect import LOOKED_LATELY_S
from coordinator.metrics.page import MetricsPage
from coordinator.observe.watch import Watcher
from dsse_core.errors import InvalidInputError

ALIVE, GATEWAY = (
    live_key("run", "area", "area1", Incarnation(1, 1)),
    live_key("run", "gateway", "sub", Incarnation(1, 1)),
)


@pytest.fixture
def page() -> Iterator[MetricsPage]:
    with MetricsPage("127.0.0.1", 0) as page:
        yield page


def ask(page: MetricsPage, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{page.port}{path}", timeout=180.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def numbers(page: MetricsPage) -> dict[tuple[str, ...], float]:
    """(name, labels in the order of their names...) -> value of each sample."""
    families = text_string_to_metric_families(ask(page, "/metrics")[1])
    return {
        (s.name, *(label for _, label in sorted(s.labels.items()))): s.value
        for family in families
        for s in family.samples
    }


def watcher_of_one(**changes: object) -> Watcher:
    watcher = Watcher("run")
    watcher.take_presence(ALIVE, True)
    watcher.take_state(a_state(**changes), time.monotonic())
    return watcher


def test_before_the_bus_is_reached_nothing_is_healthy_or_ready_and_the_reason_is_shown(page: MetricsPage):
    page.show_trouble(time.monotonic(), "cannot reach tcp/192.0.2.7:7447 within 2 s")
    assert ask(page, "/health") == (503, '{"ok": false, "why": ["cannot reach tcp/192.0.2.7:7447 within 2 s"]}\n')
    assert ask(page, "/ready")[0] == 503
    assert numbers(page)["dsse_bus_reachable",] == 0.0


def test_an_area_with_a_fresh_state_is_ready_and_its_numbers_are_there(page: MetricsPage):
    state = a_state(
        buses=(1, 2), vm=(1.0, 0.97), va=(0.0, -0.1), sigma_vm=(0.1, 0.1), sigma_va=(0.1, 0.1), removed=("m1",),
        clock_skews={"area2": 3.1}, oldest_reading=61.0, meters_off=("m2", "m3"), rejected={"not for us": 7}, lost=2,
        objective=4.5, degrees_of_freedom=3,
    )  # fmt: skip
    watcher = Watcher("run")
    watcher.take_presence(ALIVE, True)
    watcher.take_presence(GATEWAY, True)
    watcher.take_state(state, time.monotonic())
    page.show(watcher, time.monotonic(), "")
    assert ask(page, "/health")[0] == ask(page, "/ready")[0] == 200
    found = numbers(page)
    assert found["dsse_area_quality", "area1", "good"] == 1.0
    assert found["dsse_area_quality", "area1", "stale"] == 0.0
    expected = {
        "scan": 1, "oldest_reading_seconds": 61, "removed_meters": 1, "meters_off": 2, "objective": 4.5,
        "degrees_of_freedom": 3, "voltage_lowest_pu": 0.97, "voltage_highest_pu": 1.0, "messages_total": 5,
        "bytes_total": 500, "lost_total": 2, "present": 1, "incarnation_start_seconds": 0.001,
    }  # fmt: skip
    assert {name: found[f"dsse_area_{name}", "area1"] for name in expected} == expected
    assert found["dsse_area_rejected_total", "area1", "not for us"] == 7
    assert found["dsse_area_clock_skew_seconds", "area1", "area2"] == 3.1
    assert found["dsse_process_present", "sub", "gateway"] == found["dsse_gateways_alive",] == 1.0


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"quality": "stale", "notes": ("no telemetry for 9.0 s",)}, "area1 is stale: no telemetry for 9.0 s"),
        (
            {"quality": "none", "buses": (), "vm": (), "va": (), "sigma_vm": (), "sigma_va": ()},
            "area1 has no state yet",
        ),
    ],
)
def test_an_area_without_a_fresh_state_is_not_ready_and_is_named(
    page: MetricsPage, changes: dict[str, object], why: str
):
    page.show(watcher_of_one(**changes), time.monotonic(), "")
    assert ask(page, "/health")[0] == 200
    status, text = ask(page, "/ready")
    assert status == 503
    (reason,) = json.loads(text)["why"]
    assert reason.startswith(why)


def test_an_area_that_was_seen_and_is_gone_is_not_ready_however_good_its_last_state_was(page: MetricsPage):
    watcher = watcher_of_one()
    watcher.take_presence(ALIVE, False)
    page.show(watcher, time.monotonic(), "")
    assert json.loads(ask(page, "/ready")[1]) == {"ok": False, "why": ["area1 is gone"]}
    assert numbers(page)["dsse_area_present", "area1"] == 0.0


def test_a_neighbour_that_was_never_seen_is_missed(page: MetricsPage):
    page.show(watcher_of_one(sent={"area2": (1, 1)}), time.monotonic(), "")
    assert json.loads(ask(page, "/ready")[1])["why"] == ["area2 is gone"]


def test_an_empty_bus_is_not_ready(page: MetricsPage):
    page.show(Watcher("run"), time.monotonic(), "")
    assert json.loads(ask(page, "/ready")[1])["why"] == ["no area has been seen"]


def test_a_picture_that_is_never_renewed_is_no_health(page: MetricsPage):
    page.show(watcher_of_one(), time.monotonic() - LOOKED_LATELY_S - 1, "")
    assert ask(page, "/health")[0] == ask(page, "/ready")[0] == 503


def test_names_from_the_bus_cannot_forge_lines(page: MetricsPage):
    page.show(watcher_of_one(rejected={'x"} 1\nforged 7\n': 1}), time.monotonic(), "")
    assert ("forged",) not in numbers(page)


def test_states_of_a_restarted_area_begin_a_new_incarnation(page: MetricsPage):
    watcher = watcher_of_one()
    later = replace(a_state().header, incarnation=Incarnation(5000, 1))
    watcher.take_state(replace(a_state(messages=1), header=later), time.monotonic() + 10)
    page.show(watcher, time.monotonic(), "")
    found = numbers(page)
    assert (found["dsse_area_incarnation_start_seconds", "area1"], found["dsse_area_messages_total", "area1"]) == (5, 1)


def test_clients_that_ask_nothing_do_not_keep_others_waiting_for_ever(page: MetricsPage):
    page.show(watcher_of_one(), time.monotonic(), "")
    idle = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(8)]
    assert ask(page, "/ready")[0] == 200
    for connection in idle:
        connection.close()


def test_other_pages_are_named_not_there(page: MetricsPage):
    assert ask(page, "/") == (404, "here are /metrics, /health, /ready\n")


def test_a_port_that_is_taken_is_one_clear_error(page: MetricsPage):
    with pytest.raises(InvalidInputError, match=r"cannot listen there.*choose another"):
        MetricsPage("127.0.0.1", page.port)


@pytest.mark.parametrize("text", ["9464", "127.0.0.1", "127.0.0.1:http", ":9464", "127.0.0.1:70000"])
def test_where_to_listen_must_be_a_host_and_a_port(text: str):
    with pytest.raises(InvalidInputError, match="HOST:PORT"):
        parse_listen(text, "127.0.0.1:9464")


def test_hosts_of_both_families_are_read():
    assert parse_listen("[::1]:9464", "") == ("::1", 9464)
    assert parse_listen("127.0.0.1:0", "") == ("127.0.0.1", 0)
