"""Strangers, impostors and flooders against a secured system of real processes: kept out, logged, without effect."""

from __future__ import annotations

import json
import math
import shutil
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from agents.security.access import access_of
from coordinator.lab.deployment.certificates import create_keys
from coordinator.lab.deployment.split import write_area_files
from scenarios.scenario import load_scenario
from tests.support.dsse_command import ENVIRONMENT, free_endpoint
from tests.support.expiring import let_expire
from tests.support.impostor import Impostor
from tests.support.stranger import RUN
from tests.support.system_by_hand import SystemByHand, Watcher
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = pytest.mark.xdist_group("secured")  # one system for all
AREAS = ("area1", "area2", "area3")
STRANGER = [sys.executable, "-P", "-m", "tests.support.stranger"]
SEE_REJECTED_MESSAGES = {"RUST_LOG": "warn,zenoh::net::routing::interceptor=trace"}


class Secured(SystemByHand):
    """Router, plant and the three areas of ieee33, with ``keys`` or, for comparison, without."""

    def __init__(
        self, folder: Path, secured: bool = True, environment: Mapping[str, str] = SEE_REJECTED_MESSAGES
    ) -> None:
        super().__init__(folder, environment)
        scenario = load_scenario(RUN)
        self.endpoint = free_endpoint("tls" if secured else "tcp")
        self.files = dict(write_area_files(scenario, RUN, [self.endpoint], folder / "areas"))
        self.keys = folder / "keys" if secured else None
        if self.keys:
            create_keys(self.keys, replace(access_of(scenario.partition, RUN), gateways={"north": ("area1",)}), days=1)
        self.with_keys = ["--keys", self.keys] if self.keys else []

    def start_all(self) -> None:
        self.start("router", "router", "--listen", self.endpoint, *self.with_keys)
        self.start("plant", "plant", RUN, "--connect", self.endpoint, *self.with_keys)
        for area in AREAS:
            self.start_agent(area)

    def start_agent(self, area: str) -> None:
        self.start(area, "agent", self.files[area], *self.with_keys)

    def assert_unharmed(self) -> None:
        """A watcher that comes now sees all areas agree with the centre, and that they had nothing to reject."""
        with Watcher(RUN, [self.endpoint], self.keys) as watcher:
            gap = watcher.wait_for_consensus()
            assert gap.vm_pu is not None
            assert gap.va_deg is not None
            assert gap.vm_pu <= 1e-8
            assert math.radians(gap.va_deg) <= 1e-8
            assert [state.rejected for state in watcher.states.values()] == [{}, {}, {}]


def run_stranger(*arguments: object) -> str:
    done = subprocess.run(
        [*STRANGER, *map(str, arguments)],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=True,
    )
    return done.stdout


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    with Secured(tmp_path_factory.mktemp("secured")) as system:
        system.start_all()
        system.assert_unharmed()
        yield system
        for name in (*AREAS, "plant", "router"):  # nobody has died meanwhile, and everybody ends in order
            assert system.end(name) == 0, system.read_log(name)


@pytest.fixture(autouse=True)
def unharmed(system: Secured) -> Iterator[None]:
    yield
    system.assert_unharmed()


@pytest.fixture
def others(tmp_path: Path) -> Path:
    """Keys with the right names by another authority."""
    create_keys(tmp_path / "others", access_of(load_scenario(RUN).partition, RUN), days=1)
    return tmp_path / "others"


def log_since(system: Secured, before: int) -> str:
    return system.read_log("router")[before:]


def test_an_agent_of_another_authority_is_kept_out_and_reported_why(dsse, system: Secured, others: Path):
    before = len(system.read_log("router"))
    done = dsse("agent", system.files["area3"], "--keys", others, "--wait", "1")
    assert done.returncode == 2
    assert f"{system.endpoint}: its certificate is rejected here" in done.stderr
    assert "Traceback" not in done.stderr
    wait_until(lambda: "received fatal alert" in log_since(system, before))


def test_a_certificate_of_another_authority_is_rejected_even_if_its_owner_believes_the_router(
    dsse, system: Secured, others: Path
):
    shutil.copy(system.keys / "authority.crt", others / "authority.crt")  # type: ignore[operator]
    done = dsse("agent", system.files["area3"], "--keys", others)
    assert done.returncode == 2
    assert "area3.crt: was issued by" in done.stderr
    before = len(system.read_log("router"))
    assert f"it rejects {others / 'area3.crt'}" in run_stranger("connect", system.endpoint, others, "area3")
    wait_until(lambda: "invalid peer certificate" in log_since(system, before))


def test_an_agent_without_a_certificate_is_kept_out(dsse, system: Secured):
    done = dsse("agent", system.files["area3"])
    assert done.returncode == 2
    assert f"{system.endpoint} needs a certificate and a private key; give their folder with --keys" in done.stderr
    before = len(system.read_log("router"))
    plain = system.endpoint.replace("tls/", "tcp/")
    done = dsse("agent", system.files["area3"], "--connect", plain, "--wait", "1")
    assert done.returncode == 2
    assert f"cannot reach {plain}" in done.stderr
    wait_until(lambda: "corrupt message" in log_since(system, before))


def test_a_link_with_tls_but_without_a_certificate_is_rejected(system: Secured):
    before = len(system.read_log("router"))
    context = ssl.create_default_context(cafile=str(system.keys / "authority.crt"))  # type: ignore[operator]
    host, port = system.endpoint.removeprefix("tls/").split(":")
    with (
        socket.create_connection((host, int(port)), DEADLINE_S) as plain,
        pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"),
        context.wrap_socket(plain, server_hostname=host) as link,
    ):
        link.recv(1)
    wait_until(lambda: "peer sent no certificates" in log_since(system, before))


def test_an_agent_with_an_expired_certificate_is_kept_out(dsse, system: Secured, tmp_path: Path):
    old = tmp_path / "old"
    shutil.copytree(system.keys, old)  # type: ignore[arg-type]
    let_expire(old, "area3", in_s=-3600.0)
    done = dsse("agent", system.files["area3"], "--keys", old)
    assert done.returncode == 2
    assert f"{old / 'area3.crt'}: expired at " in done.stderr
    before = len(system.read_log("router"))
    assert f"it rejects {old / 'area3.crt'}: certificate expired" in run_stranger(
        "connect", system.endpoint, old, "area3"
    )
    wait_until(lambda: "certificate expired" in log_since(system, before))


def test_an_agent_with_another_areas_certificate_is_rejected_by_its_own_check(dsse, system: Secured, tmp_path: Path):
    swapped = tmp_path / "swapped"
    shutil.copytree(system.keys, swapped)  # type: ignore[arg-type]
    for ending in ("crt", "key"):
        shutil.copy(swapped / f"area2.{ending}", swapped / f"area3.{ending}")
    done = dsse("agent", system.files["area3"], "--keys", swapped)
    assert done.returncode == 2
    assert "area3.crt: is the certificate of 'area2', and 'area3' is needed" in done.stderr


def test_who_has_one_areas_key_can_neither_speak_for_others_nor_listen_to_them(system: Secured):
    before = len(system.read_log("router"))
    reported = json.loads(run_stranger("lie", system.endpoint, system.keys, "area2"))
    assert reported["received"], "what is meant for its own area it may receive"
    assert all(key.endswith("/area2") for key in reported["received"])
    allowed = tuple(f"dsse/v3/{RUN}/live/area/{name}/" for name in ("area1", "area2"))  # a neighbour, and itself
    assert all(key.startswith(allowed) for key in reported["seen"])

    def are_rejected() -> bool:
        rejected = [line for line in log_since(system, before).splitlines() if "is unauthorized to Put" in line]
        spoken_on = ("telemetry/area1/plant", "area/area3/information/area1", "area/area1/state")
        return all(any(key in line for line in rejected) for key in spoken_on)

    wait_until(are_rejected)


@pytest.mark.parametrize(
    ("thief", "published_on"),
    [
        ("gateway-north", ("telemetry/area2/north", "telemetry/area1/plant", "telemetry/area1/south")),
        ("gateway-north", ("area/area1/state", "area/area1/readings", "area/area1/up/area2", "command/area1")),
        ("operator", ("telemetry/area1/plant", "telemetry/area1/operator", "area/area1/state", "clock")),
        ("watcher", ("command/area1", "telemetry/area1/plant", "area/area1/state", "clock")),
        ("coordinator", ("command/area1", "command/plant")),
        ("area2", ("command/area1", "command/area2", "telemetry/area1/north", "area/area1/readings")),
        ("plant", ("command/area1", "telemetry/area1/north")),
    ],
)
def test_who_has_stolen_a_key_can_do_what_its_owner_may_and_nothing_else(
    system: Secured, thief: str, published_on: tuple[str, ...]
):
    before = len(system.read_log("router"))
    keys = [f"dsse/v3/{RUN}/{key}" for key in published_on]
    with Impostor.calling([system.endpoint], system.keys, thief) as liar:
        puts = liar.publish(keys, b"lie")

        def are_rejected() -> bool:
            for put in puts:
                put()
            lines = [line for line in log_since(system, before).splitlines() if "is unauthorized to Put" in line]
            return all(any(key in line for line in lines) for key in keys)

        wait_until(are_rejected)


def test_without_keys_the_same_stranger_receives_and_moves_the_whole_grid(tmp_path: Path):
    with Secured(tmp_path, secured=False) as plain:
        plain.start_all()
        with Watcher(RUN, [plain.endpoint]) as watcher:
            watcher.wait_for_consensus()
            reported = json.loads(run_stranger("lie", plain.endpoint))
            assert any("/telemetry/area1" in key for key in reported["received"])
            watcher.wait_until(lambda: all(s.header.scan == reported["scan"] for s in watcher.states.values()))
            # what area9 has sent, who is no neighbour of anybody, and what is no message
            watcher.wait_until(lambda: {"unknown sender", "damaged"} <= watcher.states["area1"].rejected.keys())


@contextmanager
def flooding(how: str, system: Secured) -> Iterator[None]:
    """Inside the block a stranger floods the router, which has rejected it some times already."""
    before = len(system.read_log("router"))
    flooder = subprocess.Popen([*STRANGER, how, system.endpoint], env=ENVIRONMENT)
    try:
        wait_until(lambda: log_since(system, before).count("zenoh_link_tls") > 10)
        yield
        assert flooder.poll() is None
    finally:
        flooder.kill()
        flooder.wait()


@pytest.mark.long
def test_an_area_that_is_killed_comes_back_while_a_stranger_floods_the_port(system: Secured):
    with flooding("flood", system):
        system.end("area3", signal.SIGKILL)
        system.start_agent("area3")
        system.assert_unharmed()


def test_a_flood_that_keeps_new_links_waiting_does_not_touch_those_that_are_there(tmp_path: Path):
    with Secured(tmp_path) as flooded:
        flooded.start_all()
        with Watcher(RUN, [flooded.endpoint], flooded.keys) as watcher:
            watcher.wait_for_consensus()
            with flooding("flood-wildly", flooded):
                before = {area: state.messages for area, state in watcher.states.items()}
                watcher.wait_until(lambda: all(watcher.states[a].messages > before[a] + 20 for a in AREAS))
                gap = watcher.wait_for_consensus()
                assert max(gap.vm_pu, math.radians(gap.va_deg)) <= 1e-8


@pytest.mark.long
def test_who_has_one_areas_key_and_shouts_for_others_does_not_keep_a_restarted_area_from_agreeing(tmp_path: Path):
    with Secured(tmp_path, environment={}) as system:
        system.start_all()
        shout = [*STRANGER, "shout", system.endpoint, str(system.keys), "area2"]
        with (
            Watcher(RUN, [system.endpoint], system.keys) as watcher,
            subprocess.Popen(shout, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as shouter,
        ):
            try:
                assert shouter.stdout is not None
                assert shouter.stdout.readline() == "shouting\n"
                watcher.wait_for_consensus()
                system.end("area3", signal.SIGKILL)
                watcher.wait_until(lambda: "area3 is not on the bus" in watcher.obstacles())
                system.start_agent("area3")
                watcher.wait_for_consensus()
                system.assert_unharmed()
                assert shouter.poll() is None
            finally:
                shouter.kill()


def test_a_secured_run_ends_with_the_verdict_of_any_other_and_leaves_no_private_key(
    dsse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setitem(ENVIRONMENT, "TMPDIR", str(tmp_path / "temporary"))
    done = dsse("run", "industrial13", "--secure", "--no-plots", "--quiet", "--out", "out", "--timeout", DEADLINE_S)
    assert done.returncode == 0, done.stderr
    verdict = json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]
    assert max(verdict["gap_vm_pu"], math.radians(verdict["gap_va_deg"])) <= 1e-8
    assert (tmp_path / "out" / "logs" / "router.endpoints").read_text().startswith("tls/")
    assert not list((tmp_path / "out").rglob("*.key"))
    assert not list((tmp_path / "temporary").rglob("*"))


def test_keys_of_another_scenario_start_no_run(dsse, system: Secured):
    done = dsse("run", "industrial13", "--keys", system.keys)
    assert done.returncode == 2
    assert "area area1 has neighbours area2, area3 there, area2 in the scenario" in done.stderr
