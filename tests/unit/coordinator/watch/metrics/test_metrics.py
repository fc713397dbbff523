"""What metrics, health and readiness say of a run that is seen, and over HTTP."""

from __future__ import annotations

import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace

import pytest
from prometheus_client.parser import text_string_to_metric_families

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.watch import http_front
from coordinator.watch.http_front import Front
from coordinator.watch.listen import parse_listen
from coordinator.watch.metrics import metrics_page as page_module
from coordinator.watch.metrics.collect import LOOKED_LATELY_S, Observation, RunCollector
from coordinator.watch.metrics.metrics_page import MetricsPage
from coordinator.watch.observe.grid_tables import GridTables
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import load_scenario
from tests.support.shown_states import a_state

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
    now = time.monotonic()
    watcher.take_state(state, now)
    page.show(watcher, now, "")
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


def test_voltages_of_phases_have_the_label_of_their_phase_and_balanced_areas_have_none(page: MetricsPage):
    four = {key: (0.1,) * 4 for key in ("va", "sigma_vm", "sigma_va")}
    nodes = {"buses": (1, 1, 2, 2), "phases": ("a", "b", "a", "b"), "vm": (1.0, 0.97, 0.99, 1.02)}
    page.show(watcher_of_one(**nodes, **four), time.monotonic(), "")
    found = {key[2]: number for key, number in numbers(page).items() if key[0] == "dsse_area_phase_voltage_lowest_pu"}
    assert found == {"a": 0.99, "b": 0.97}
    assert numbers(page)["dsse_area_phase_voltage_highest_pu", "area1", "b"] == 1.02
    page.show(watcher_of_one(), time.monotonic(), "")
    assert not any("phase" in key[0] for key in numbers(page))
    assert "phase_voltage" not in ask(page, "/metrics")[1]


def test_numbers_that_are_not_of_the_present_are_absent_and_counted(page: MetricsPage):
    page.show(watcher_of_one(), time.monotonic(), "")
    found = numbers(page)
    assert (found["dsse_area_fresh", "area1"], found["dsse_area_voltage_lowest_pu", "area1"]) == (1.0, 1.0)
    assert (found["dsse_grid_known", "voltage_pu"], found["dsse_grid_outside_limits", "voltage_pu"]) == (1.0, 0.0)
    page.show(watcher_of_one(quality="stale", vm=(0.8,)), time.monotonic(), "")
    found = numbers(page)
    assert found["dsse_area_fresh", "area1"] == 0.0
    assert ("dsse_area_voltage_lowest_pu", "area1") not in found
    of_voltage = {name: found[f"dsse_grid_{name}", "voltage_pu"] for name in ("numbers", "known", "outside_limits")}
    assert of_voltage == {"numbers": 1.0, "known": 0.0, "outside_limits": 0.0}


def test_with_a_scenario_powers_and_loadings_are_there_beside_its_limits():
    scenario = load_scenario("ieee33", changes={"quality.operating_lowest_vm_pu": 0.92})
    flow, watcher = solve_power_flow(scenario.network), Watcher("run")
    for name, rows in scenario.partition.rows_of_buses.items():
        buses, sigma = tuple(scenario.network.table.bus_id[rows].tolist()), (1e-3,) * len(rows)
        vm, va = tuple(flow.vm[rows].tolist()), tuple(flow.va[rows].tolist())
        state = a_state(buses=buses, vm=vm, va=va, sigma_vm=sigma, sigma_va=sigma)
        watcher.take_presence(f"dsse/v3/run/live/area/{name}/1-00000001", True)
        watcher.take_state(replace(state, header=replace(state.header, sender=name)), 0.0)
    collector = RunCollector(GridTables(scenario))
    collector.sight = Observation(0.0, watcher.look(0.0), watcher, "")
    found = {(s.name, *s.labels.values()): s.value for metric in collector.collect() for s in metric.samples}
    assert found["dsse_grid_power_kw", "loss"] == pytest.approx(1000 * flow.losses.real * scenario.network.base_mva)
    assert found["dsse_grid_outside_limits", "voltage_pu"] == (flow.vm < 0.92).sum() > 0
    assert found["dsse_grid_power_parts_known", "loss"] == found["dsse_grid_power_parts", "loss"] == 32


def test_all_ages_grow_while_an_area_is_silent():
    watcher = Watcher("run")
    ages_s = {"telemetry_age": 2.0, "ages": {"area2": 3.0}, "oldest_reading": 61.0}
    watcher.take_state(a_state(**ages_s, clock_skews={"area2": 3.1}), 0.0)
    collector = RunCollector()
    collector.sight = Observation(5.0, watcher.look(5.0), watcher, "")
    found = {sample.name: sample.value for metric in collector.collect() for sample in metric.samples}
    ages = {"state_age": 5.0, "telemetry_age": 7.0, "neighbour_age": 8.0, "oldest_reading": 66.0}
    assert {name: found[f"dsse_area_{name}_seconds"] for name in ages} == ages
    assert "dsse_area_clock_skew_seconds" not in found  # it has no age


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


def test_two_hundred_slow_connections_keep_nobody_waiting(page: MetricsPage, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(page_module, "REQUEST_S", 600.0)  # it is not their time that is up
    page.show(watcher_of_one(), time.monotonic(), "")
    with ExitStack() as opened:
        slow = []
        for _ in range(http_front.MOST_READERS + 20):
            slow.append(opened.enter_context(socket.create_connection(("127.0.0.1", page.port), timeout=180.0)))
            slow[-1].sendall(b"GET /metrics HTTP/1.1\r\nHost: 127")
        for path in ("/ready", "/health", "/metrics"):
            assert ask(page, path)[0] == 200
        assert all(is_over(link) for link in slow[:20]), "the connection that is silent longest gives way"
        slow[-1].sendall(f".0.0.1:{page.port}\r\n\r\n".encode())
        assert slow[-1].recv(15) == b"HTTP/1.1 200 OK", "a slow request is answered once it is whole"


def is_over(link: socket.socket) -> bool:
    """True once the server has closed it; waits for that."""
    try:
        return link.recv(1) == b""
    except ConnectionResetError:
        return True


def test_a_connection_without_a_whole_request_ends_when_its_time_is_up(
    page: MetricsPage, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(page_module, "REQUEST_S", 0.05)
    for begin in (b"", b"GET /metrics HTTP/1.1\r\n"):
        with socket.create_connection(("127.0.0.1", page.port), timeout=180.0) as link:
            link.sendall(begin)
            assert is_over(link)


def test_a_reader_that_takes_nothing_is_closed(page: MetricsPage, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(page_module, "PATIENCE_S", 0.05)
    monkeypatch.setattr(page_module, "generate_latest", lambda registry: b"x" * 2**25)
    with socket.create_connection(("127.0.0.1", page.port), timeout=180.0) as link:
        link.sendall(f"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
        time_is_up = threading.Event()
        page._loop.call_soon_threadsafe(page._loop.call_later, 1.0, time_is_up.set)
        assert time_is_up.wait(180.0)
        taken = 0
        with suppress(ConnectionResetError):
            while piece := link.recv(2**20):
                taken += len(piece)
    assert taken < 2**25


def raw(page: MetricsPage, request: str) -> str:
    with socket.create_connection(("127.0.0.1", page.port), timeout=180.0) as link:
        link.sendall(request.encode())
        taken = b""
        with suppress(ConnectionResetError):
            while piece := link.recv(2**16):
                taken += piece
    return taken.decode()


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1:9", "127.0.0.1", "[::1]:8080"])
def test_metrics_that_are_asked_for_under_another_name_are_not_shown(page: MetricsPage, host: str):
    page.show(watcher_of_one(), time.monotonic(), "")
    answer = raw(page, f"GET /metrics HTTP/1.1\r\nHost: {host}\r\n\r\n")
    assert answer.startswith("HTTP/1.1 421 ")
    assert "dsse_" not in answer


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        ("GET /metrics HTTP/1.1\r\n", 421),  # no host
        ("GET /metrics HTTP/1.1\r\nHost: HERE\r\nHost: HERE\r\n", 421),
        ("GET /metrics HTTP/1.1\r\nHost: HERE\r\nOrigin: https://evil.example\r\n", 403),
        ("POST /metrics HTTP/1.1\r\nHost: HERE\r\n", 405),
        ("GET /metrics HTTP/1.1\r\nHost: HERE\r\nContent-Length: 5\r\n", 400),
        ("GET /metrics HTTP/1.1\r\nHost: HERE\r\nTransfer-Encoding: chunked\r\n", 400),
        ("GET /metrics\r\n", 400),
        ("GET /metrics HTTP/1.1\r\nHost : HERE\r\n", 400),
        ("GET /metrics HTTP/1.1\r\nHost: HERE\r\n folded\r\n", 400),
        ("\x16\x03\x01\r\n", 400),
        ("GET /metrics HTTP/1.0\r\nHost: localhost:PORT\r\n", 200),
        ("HEAD /metrics HTTP/1.1\r\nHost: HERE\r\n", 200),
    ],
)
def test_a_request_is_answered_or_refused_and_the_next_one_is_answered(page: MetricsPage, lines: str, status: int):
    page.show(watcher_of_one(), time.monotonic(), "")
    here = f"127.0.0.1:{page.port}"
    answer = raw(page, f"{lines.replace('HERE', here).replace('PORT', str(page.port))}\r\n")
    assert answer.startswith(f"HTTP/1.1 {status} ")
    assert ("dsse_" in answer) == (status == 200 and not lines.startswith("HEAD"))
    assert ask(page, "/health")[0] == 200


def test_a_head_without_end_is_cut_off(page: MetricsPage):
    assert raw(page, "GET / HTTP/1.1\r\nHost: " + "x" * 20_000) == ""


@pytest.mark.parametrize(
    ("host", "is_own"),
    [
        ("192.0.2.7:9464", True),
        ("192.0.2.7", True),
        ("[2001:db8::1]:9464", True),
        ("feeder1.example:9464", True),
        ("FEEDER1.example:9464", True),
        ("evil.example:9464", False),
        ("192.0.2.7.evil.example:9464", False),
        ("", False),
    ],
)
def test_beyond_loopback_a_host_is_asked_for_by_address_or_by_a_given_name(host: str, is_own: bool):
    front = Front.of("0.0.0.0", 9464, ["feeder1.example"], by_address=True)
    assert (front.find_rejection("GET", [("host", host)]) is None) == is_own


def test_other_pages_are_named_not_there(page: MetricsPage):
    assert ask(page, "/") == (404, "here are /metrics, /health, /ready\n")


def test_a_port_that_is_taken_is_one_clear_error(page: MetricsPage):
    with pytest.raises(InvalidInputError, match=r"cannot listen there.*choose another"):
        MetricsPage("127.0.0.1", page.port)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("9464", "the host is missing"),
        ("127.0.0.1", "the port is missing"),
        ("127.0.0.1:http", "the port is 'http'"),
        (":9464", "the host is missing"),
        ("127.0.0.1:70000", "the port is '70000'"),
        ("tcp/127.0.0.1:80", "'tcp/' is too much"),
        ("http://127.0.0.1:80", "'http://' is too much"),
        ("::1:80", "an IPv6 address stands in brackets"),
    ],
)
def test_of_a_place_to_listen_the_error_says_first_what_is_wrong(text: str, wrong: str):
    with pytest.raises(InvalidInputError) as error:
        parse_listen(text, "127.0.0.1:9464")
    assert error.value.problems[0].startswith(wrong)
    assert error.value.problems[0].endswith("HOST:PORT looks like 127.0.0.1:9464")


def test_hosts_of_both_families_are_read():
    assert parse_listen("[::1]:9464", "") == ("::1", 9464)
    assert parse_listen("127.0.0.1:0", "") == ("127.0.0.1", 0)
