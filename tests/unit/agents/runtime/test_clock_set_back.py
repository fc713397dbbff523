"""The loop of an agent on real threads and the real monotonic clock, while wall clocks are set back by a day."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from agents.messages.keys import all_telemetry, state_key, telemetry_key
from agents.messages.packing import StateMessage, decode
from agents.protocol.events import StopRequested
from agents.runtime.inbox import Inbox
from agents.runtime.loop import run_agent
from agents.runtime.presence import begin_incarnation
from coordinator.lab.deployment.split import area_files
from coordinator.lab.plant.telemetry_messages import make_payloads
from scenarios.scenario import load_scenario
from tests.support.waiting import wait_until

A_DAY_S = 86400
SCENARIO = load_scenario("industrial13")
RUN = "run"


class Bus:
    """Stands in for a session: keeps what is published, and lets a test be everybody else."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.receive: dict[str, Callable[[str, bytes], None]] = {}
        self.declarations = ()

    def publisher(self, key: str) -> Callable[[bytes], None]:
        return lambda payload: self.published.append((key, payload))

    def subscribe(self, keys: str, callback: Callable[[str, bytes], None]) -> None:
        self.receive[keys] = callback

    def watch_presence(self, keys: str, callback: object) -> None:
        pass

    def declare_presence(self, key: str) -> None:
        pass

    def states(self) -> list[StateMessage]:
        own = state_key(RUN, "area1")
        return [
            state
            for key, payload in self.published
            if key == own and isinstance(state := decode(payload), StateMessage)
        ]


@pytest.fixture
def bus() -> Iterator[Bus]:
    """The bus of an agent of area1 that runs."""
    content = replace(area_files(SCENARIO, RUN, ["tcp/127.0.0.1:0"])[0], beat_s=0.02)
    bus, inbox = Bus(), Inbox()
    agent = threading.Thread(target=run_agent, args=(content, bus, inbox))
    agent.start()
    yield bus
    inbox.put("stop", StopRequested("the test is over"))
    agent.join(60.0)
    assert not agent.is_alive()


@pytest.fixture
def set_back(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Sets the wall clock of this host back by a day."""
    now, now_ns = time.time, time.time_ns

    def set_clock() -> None:
        monkeypatch.setattr(time, "time", lambda: now() - A_DAY_S)
        monkeypatch.setattr(time, "time_ns", lambda: now_ns() - A_DAY_S * 10**9)

    return set_clock


def has_scan(bus: Bus, plant: bytes, scan: int) -> bool:
    """Repeat the plant's word; whether area1 has an estimate of ``scan`` by now."""
    key = telemetry_key(RUN, "area1")
    bus.receive[all_telemetry(RUN, "area1")](key, plant)
    states = bus.states()
    return bool(states) and states[-1].header.scan == scan and bool(states[-1].buses)


def test_an_agent_works_with_a_plant_that_was_restarted_with_the_clock_set_back_and_repeats_itself(bus, set_back):
    wait_until(lambda: all_telemetry(RUN, "area1") in bus.receive)
    first = make_payloads(SCENARIO, RUN, begin_incarnation(), 7)["area1"]
    wait_until(lambda: has_scan(bus, first, 7))
    set_back()
    restarted = make_payloads(SCENARIO, RUN, begin_incarnation(), 3)["area1"]
    assert decode(restarted).header.incarnation < decode(first).header.incarnation
    wait_until(lambda: has_scan(bus, restarted, 8))  # a term never goes back: these are the readings of the next one
    seen = len(bus.states())
    wait_until(lambda: len(bus.states()) >= seen + 5)
    times = [state.header.time for state in bus.states()]
    assert times == sorted(times), "an agent's own time never goes back"
    orders = [state.header.order for state in bus.states()]
    assert orders == sorted(orders)
    assert bus.states()[-1].rejected == {}
