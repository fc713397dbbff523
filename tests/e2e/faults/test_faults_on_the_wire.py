"""Delay, black holes and resets on the link between two routers, and on that of an agent: the system recovers."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.lab.deployment.split import write_area_files
from coordinator.lab.evaluation.comparison import Gap
from coordinator.watch.observe.attachment import attach
from coordinator.watch.observe.run_address import RunAddress
from scenarios.scenario import load_scenario
from tests.support.dsse_command import free_port
from tests.support.system_by_hand import SystemByHand, Watcher
from tests.support.tcp_fault_proxy import TcpFaultProxy
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = pytest.mark.xdist_group("two routers")  # one system for all
RUN = "ieee33"
THERE = ("area2", "area3")  # the neighbours of area 1 and not of each other
GONE = "neighbour area1 is gone"


@pytest.fixture
def echo() -> Iterator[int]:
    """The port of a server that sends back what it receives."""

    def serve(listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = listener.accept()
                threading.Thread(target=answer, args=[link], daemon=True).start()

    def answer(link: socket.socket) -> None:
        with link, contextlib.suppress(OSError):
            while data := link.recv(1000):
                link.sendall(data)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, args=[listener], daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)


def ask(link: socket.socket, text: bytes) -> bytes:
    link.sendall(text)
    return link.recv(1000)


def test_the_proxy_delays_both_ways(echo: int):
    with TcpFaultProxy(echo) as proxy, socket.create_connection(("127.0.0.1", proxy.port)) as link:
        proxy.delay_s = 0.05
        before = time.monotonic()
        assert ask(link, b"late") == b"late"
        assert time.monotonic() - before >= 2 * 0.05


def test_what_falls_into_a_black_hole_arrives_when_it_is_healed(echo: int):
    with TcpFaultProxy(echo) as proxy, socket.create_connection(("127.0.0.1", proxy.port)) as link:
        assert ask(link, b"one") == b"one"
        proxy.black_hole()
        link.settimeout(0.1)
        with pytest.raises(TimeoutError):
            ask(link, b"two")
        with socket.create_connection(("127.0.0.1", proxy.port), DEADLINE_S) as other:
            other.settimeout(0.1)
            with pytest.raises(TimeoutError):
                ask(other, b"three")
        proxy.heal()
        link.settimeout(DEADLINE_S)
        assert link.recv(1000) == b"two"


def test_a_reset_is_felt_and_the_next_connection_passes(echo: int):
    with TcpFaultProxy(echo) as proxy:
        with socket.create_connection(("127.0.0.1", proxy.port)) as link:
            assert ask(link, b"one") == b"one"
            proxy.reset()
            with pytest.raises(ConnectionResetError):
                link.recv(1000)
        with socket.create_connection(("127.0.0.1", proxy.port)) as link:
            assert ask(link, b"two") == b"two"


class TwoRouters(SystemByHand):
    """Router ``here`` with area 1 and the plant; router ``there`` with areas 2 and 3.

    ``between``: what the link of the routers passes; ``to_area3``: what the link of area 3 with its router passes.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        ports = free_port(), free_port()
        self.here, self.there = (f"tcp/127.0.0.1:{port}" for port in ports)
        self.between, self.to_area3 = (TcpFaultProxy(port, seed) for seed, port in enumerate(ports))

    def start_all(self) -> None:
        files = dict(write_area_files(load_scenario(RUN), RUN, [self.here], self.folder / "areas"))
        self.start("here", "router", "--listen", self.here)
        self.start("there", "router", "--listen", self.there, "--connect", f"tcp/127.0.0.1:{self.between.port}")
        self.start("plant", "plant", RUN, "--connect", self.here)
        for area, router in zip(files, (self.here, self.there, f"tcp/127.0.0.1:{self.to_area3.port}"), strict=True):
            self.start(area, "agent", files[area], "--connect", router)

    def replace_plant(self, after: int) -> None:
        """A new plant makes a new scan, above ``after``, with the same readings: the seed is the same."""
        wait_until(lambda: 1000 * time.time() >= after + 1)  # it numbers its scan by the millisecond
        assert self.end("plant") == 0
        self.start("plant", "plant", RUN, "--connect", self.here)


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwoRouters]:
    system = TwoRouters(tmp_path_factory.mktemp("two_routers"))
    with system.between, system.to_area3, system:
        system.start_all()
        yield system
        for name in reversed(list(system.processes)):
            assert system.end(name) == 0, system.read_log(name)


@pytest.fixture
def watcher(system: TwoRouters) -> Iterator[Watcher]:
    """Who sees the system from the side of areas 2 and 3; all agree already."""
    with Watcher(RUN, [system.there]) as watcher:
        assert_at_fixed_point(watcher.wait_for_consensus())
        yield watcher


def assert_agree_on_scan_after(old: int, watcher: Watcher) -> None:
    watcher.wait_until(lambda: all(state.header.scan > old for state in watcher.states.values()))
    assert_at_fixed_point(watcher.wait_for_consensus())


def assert_at_fixed_point(gap: Gap) -> None:
    assert gap.vm_pu is not None
    assert gap.va_deg is not None
    assert gap.vm_pu <= 1e-8
    assert math.radians(gap.va_deg) <= 1e-8


def scan_of(watcher: Watcher) -> int:
    (scan,) = {state.header.scan for state in watcher.states.values()}
    return scan


def test_a_black_hole_between_routers_is_noticed_and_everybody_is_on_the_new_scan_afterwards(
    system: TwoRouters, watcher: Watcher
):
    old = scan_of(watcher)
    system.between.black_hole()
    watcher.wait_until(lambda: all(GONE in watcher.states[area].notes for area in THERE))
    system.replace_plant(after=old)
    with attach(RunAddress([system.here], RUN, DEADLINE_S)) as here:
        wait_until(lambda: (state := here(0.05).state_of("area1")) is not None and state.header.scan > old)
    assert all(watcher.states[area].header.scan == old for area in THERE)
    system.between.heal()
    assert_agree_on_scan_after(old, watcher)


def test_links_that_are_reset_again_and_again_come_back_each_time(system: TwoRouters, watcher: Watcher):
    old = scan_of(watcher)
    for proxy in (system.between, system.to_area3):
        for _ in range(3):
            links = proxy.passed_on
            proxy.reset()
            wait_until(lambda proxy=proxy, links=links: proxy.passed_on > links)
    system.replace_plant(after=old)
    assert_agree_on_scan_after(old, watcher)


def test_areas_agree_over_a_link_that_delays_everything(system: TwoRouters, watcher: Watcher):
    old = scan_of(watcher)
    system.between.delay_s, system.between.jitter_s = 0.15, 0.1
    system.replace_plant(after=old)
    assert_agree_on_scan_after(old, watcher)
    watcher.wait_until(lambda: all(state.notes == () for state in watcher.states.values()))
