"""Processes of a system are waited for, but not for what they are not to blame for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agents.transport.zenoh_bus import TransportError
from coordinator.lab.process_run import system
from coordinator.lab.process_run.fork_server import Started
from coordinator.lab.process_run.system import System
from scenarios.scenario import load_scenario


class Parent:
    """Starts nothing."""

    def start(self, *order: Any, **log: Any) -> None: ...


class Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(system, "time", clock)
    return clock


def test_the_time_of_the_router_begins_when_its_parent_has_started_it(clock: Clock, tmp_path: Path):
    started_after_s = 3 * system.ROUTER_START_S
    processes = System(Parent(), load_scenario("ieee33"), "run", tmp_path)  # type: ignore[arg-type]

    def wait() -> None:
        clock.now += 1.0
        if clock.now == started_after_s:
            processes.note(Started("router", 1))

    with pytest.raises(TransportError, match=r"the router has not opened tcp/.* within 10 s"):
        processes.start_bus(wait)
    assert clock.now == pytest.approx(started_after_s + system.ROUTER_START_S, abs=2.0)
