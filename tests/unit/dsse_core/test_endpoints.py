"""Endpoints are read by us before Zenoh sees them, wherever they come from."""

from __future__ import annotations

from pathlib import Path

import pytest

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.transport import zenoh_bus
from agents.transport.zenoh_bus import Router, Session
from coordinator.lab.deployment.split import area_files
from dsse_core.endpoints import check_endpoints, find_endpoint_problem
from dsse_core.errors import InvalidInputError
from scenarios.scenario import load_scenario

NONE = [
    "",
    "garbage",
    "tcp",
    "tcp/",
    "tcp/:7447",
    "tcp/127.0.0.1",
    "tcp/127.0.0.1:",
    "tcp/127.0.0.1:0",
    "tcp/127.0.0.1:65536",
    "tcp/127.0.0.1:99999999999999999999",
    "tcp/127.0.0.1:-1",
    "tcp/127.0.0.1:٣",
    "tcp/127.0.0.1:7447#iface=lo",
    "tcp/127.0.0.1:7447?prio=1",
    "tls/127.0.0.1:7447#root_ca_certificate=x",
    "tcp/256.1.1.1:7447",
    "tcp/1.2.3:7447",
    "tcp/::1:7447",
    "tcp/[::1:7447",
    "tcp/[127.0.0.1]:7447",
    "tcp/[::1%]:7447",
    "tcp/host name:7447",
    "tcp/host\n:7447",
    "tcp/-host:7447",
    "tcp/host..example:7447",
    "tcp/user@host:7447",
    "tcp//dev/null:7447",
    f"tcp/{'x' * 300}:7447",
    "udp/127.0.0.1:7447",
    "ws/127.0.0.1:7447",
    "unixsock-stream//tmp/x",
    "serial//dev/ttyS0",
    "TCP/127.0.0.1:7447",
    " tcp/127.0.0.1:7447",
    "tcp/127.0.0.1:7447 ",
]
ENDPOINTS = [
    "tcp/127.0.0.1:7447",
    "tls/host-b.example:7447",
    "tcp/localhost:1",
    "tcp/grid_a.example.:65535",
    "tcp/[::1]:7447",
    "tcp/[fe80::1%eth0]:7447",
    "tcp/0.0.0.0:7447",
    "tcp/1host:7447",
]


@pytest.mark.parametrize("endpoint", NONE)
def test_what_is_no_endpoint_is_one_line_that_names_it(endpoint: str) -> None:
    problem = find_endpoint_problem(endpoint)
    assert problem
    assert problem.isprintable()
    assert len(problem) < 250


@pytest.mark.parametrize("endpoint", ENDPOINTS)
def test_an_endpoint_is_one_for_both_sides(endpoint: str) -> None:
    assert not find_endpoint_problem(endpoint)
    assert not find_endpoint_problem(endpoint, listens=True)


def test_port_0_is_for_listening_only() -> None:
    assert "port 0 is for listening" in find_endpoint_problem("tcp/127.0.0.1:0")
    assert not find_endpoint_problem("tcp/[::%eth0]:0", listens=True)


def test_all_of_several_are_named_at_once() -> None:
    with pytest.raises(InvalidInputError) as caught:
        check_endpoints("--connect", ["garbage", "tcp/127.0.0.1:7447", "tcp/x"])
    assert len(caught.value.problems) == 2


@pytest.mark.parametrize("endpoint", ["garbage", "tcp/", "tcp/127.0.0.1:7447#x"])
def test_zenoh_never_sees_what_is_no_endpoint(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_bus, "_open", lambda config: pytest.fail("Zenoh sees it"))
    for opening in (
        lambda: Session.connect([endpoint]),
        lambda: Session.join([endpoint], direct=True),
        lambda: Session.meet(["tcp/127.0.0.1:1"], [endpoint]),
        lambda: Router.listen([endpoint]),
        lambda: Router.listen(["tcp/127.0.0.1:0"], None, [endpoint]),
    ):
        with pytest.raises(InvalidInputError, match="endpoint"):
            opening()


def test_those_of_an_area_file_are_checked_when_it_is_read(tmp_path: Path) -> None:
    content = area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447", "garbage"])[0]
    save_area_file(tmp_path / "a.toml", content)
    with pytest.raises(InvalidInputError) as caught:
        load_area_file(tmp_path / "a.toml")
    (problem,) = caught.value.problems
    assert problem.startswith("endpoints[2]: 'garbage' is no endpoint")
