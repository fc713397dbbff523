"""What a service manager is told of a process, on a socket as systemd has one."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents.runtime.watchdog import COMPILING_US, Watchdog


class Manager:
    """The other end of ``NOTIFY_SOCKET``."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + path[1:] if path.startswith("@") else path)
        self._socket.setblocking(False)

    def received(self) -> list[str]:
        texts = []
        while True:
            try:
                texts.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return texts

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["file", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    made = Manager(str(tmp_path / "notify") if request.param == "file" else f"@dsse-test-{os.getpid()}")
    yield made
    made.close()


def test_a_process_is_ready_when_it_says_so_and_not_when_it_starts(manager: Manager):
    watchdog = Watchdog({"NOTIFY_SOCKET": manager.path})
    assert watchdog.ping(0.0) == float("inf")
    assert manager.received() == []
    watchdog.ready(0.0)
    assert watchdog.ping(100.0) == float("inf")
    assert manager.received() == ["READY=1"]  # the unit has no WatchdogSec: nothing else is said


def test_a_loop_that_goes_round_says_so_four_times_in_the_limit_and_never_more_often(manager: Manager):
    watchdog = Watchdog({"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "20000000", "WATCHDOG_PID": str(os.getpid())})
    watchdog.ready(1000.0)
    waits = [watchdog.ping(now) for now in (1000.0, 1000.1, 1004.0, 1005.0, 1005.1)]
    assert waits == pytest.approx([5.0, 4.9, 1.0, 5.0, 4.9])
    assert manager.received() == ["READY=1", "WATCHDOG=1", "WATCHDOG=1"]


def test_a_loop_that_is_stuck_says_nothing(manager: Manager):
    watchdog = Watchdog({"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "1000"})
    watchdog.ready(0.0)
    watchdog.ping(0.0)
    manager.received()
    assert manager.received() == []  # nobody but the loop speaks: no thread, no timer


def test_compiling_asks_for_patience_and_gives_it_back(manager: Manager):
    watchdog = Watchdog({"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "30000000"})
    watchdog.take_compiling(True, None)
    watchdog.take_compiling(False, None)
    assert manager.received() == [f"EXTEND_TIMEOUT_USEC={COMPILING_US}"]
    watchdog.ready(0.0)
    watchdog.take_compiling(True, None)
    watchdog.take_compiling(False, None)
    assert manager.received() == ["READY=1", f"WATCHDOG_USEC={COMPILING_US}", "WATCHDOG_USEC=30000000"]


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "1000"},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "1000"},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "soon"},
    ],
)
def test_without_a_service_manager_that_listens_nothing_happens(environment: dict[str, str]):
    watchdog = Watchdog(environment)
    watchdog.ready(0.0)
    assert watchdog.ping(1.0) > 0


def test_the_limit_of_another_process_is_not_ours(manager: Manager):
    watchdog = Watchdog({"NOTIFY_SOCKET": manager.path, "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"})
    watchdog.ready(0.0)
    assert watchdog.ping(1.0) == float("inf")
    assert manager.received() == ["READY=1"]
