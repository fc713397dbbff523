"""What goes onto the bus: snapshots, no more often than allowed, and repeated; scans of a gateway that leads."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from agents.messages.packing import Incarnation, TelemetryMessage, decode
from coordinator.field.gateway.intake import Intake
from coordinator.field.gateway.maps.map_file import GatewayMap
from coordinator.field.gateway.publisher import LeadingPublisher, Publisher

DEADLINE_S = 180.0


def make(
    content: GatewayMap, cls: type[Publisher] = Publisher, **options: object
) -> tuple[Intake, Publisher, list[TelemetryMessage]]:
    """In a running loop: an intake, its publisher, and what it sends."""
    sent: list[TelemetryMessage] = []

    def send(payload: bytes) -> None:
        message = decode(payload)
        assert isinstance(message, TelemetryMessage)
        sent.append(message)

    intake = Intake(content.points, time.time)
    settings = {"least_interval_s": 0.01, "scan_s": 0.5, "repeats_s": (0.02, 0.03)} | options
    publisher = cls("r", "north", Incarnation(1, 2), intake, {"area1": send}, **settings)  # type: ignore[arg-type]
    publisher.start()
    return intake, publisher, sent


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not holds():
            await asyncio.sleep(0.005)


def test_a_message_is_a_snapshot_of_all_that_was_read(two_meters: GatewayMap) -> None:
    async def test() -> list[TelemetryMessage]:
        intake, publisher, sent = make(two_meters)
        intake("U1", 12.66, 1.7e9)
        await until(lambda: len(sent) >= 1)
        intake("P1", 100.0, valid=False)
        await until(lambda: sent[-1].header.sequence == 2)
        publisher.finish()
        return sent

    sent = asyncio.run(test())
    first, last = sent[0], sent[-1]
    assert (first.area, first.meters, first.times, first.valid) == ("area1", ("vm@1",), (1.7e9,), (True,))
    assert (first.header.run, first.header.sender, first.header.sequence) == ("r", "north", 1)
    assert last.meters == ("vm@1", "p_flow@1:1-2")
    assert last.valid == (True, False)


def test_a_flood_is_few_messages_with_the_newest_of_all_meters(two_meters: GatewayMap) -> None:
    async def test() -> tuple[Intake, list[TelemetryMessage]]:
        intake, publisher, sent = make(two_meters, least_interval_s=1000.0, repeats_s=(1000.0,))
        intake("P1", 100.0)
        await until(lambda: len(sent) == 1)
        for k in range(10_000):
            intake("U1", 12.0 + k / 1e5)
            if not k % 100:
                await asyncio.sleep(0)
        publisher.finish()
        return intake, sent

    intake, sent = asyncio.run(test())
    assert len(sent) == 2 == intake.counts.messages
    assert sent[-1].values[sent[-1].meters.index("vm@1")] == pytest.approx(12.09999 / 12.66)
    assert intake.counts.used == 2
    assert intake.counts.superseded == 9_999


def test_the_same_is_sent_again_for_who_has_missed_it(two_meters: GatewayMap) -> None:
    async def test() -> list[TelemetryMessage]:
        intake, publisher, sent = make(two_meters)
        publisher.publish_soon("area1")  # an area is there before any reading
        publisher.publish_soon("area2")
        intake("U1", 12.66)
        await until(lambda: len(sent) >= 4)
        publisher.finish()
        return sent

    sent = asyncio.run(test())
    assert {message.header.sequence for message in sent} == {1}
    assert {message.values for message in sent} == {sent[0].values}


def test_an_area_that_appears_gets_what_there_is(two_meters: GatewayMap) -> None:
    async def test() -> list[TelemetryMessage]:
        intake, publisher, sent = make(two_meters, repeats_s=(1000.0,))
        intake("U1", 12.66)
        await until(lambda: len(sent) == 1)
        publisher.publish_soon("area1")
        await until(lambda: len(sent) == 2)
        publisher.finish()
        return sent

    assert [message.header.sequence for message in asyncio.run(test())] == [1, 1]


def test_of_a_gateway_that_leads_all_messages_of_a_scan_say_the_same(two_meters: GatewayMap) -> None:
    async def test() -> list[TelemetryMessage]:
        intake, publisher, sent = make(two_meters, LeadingPublisher, scan_s=0.1, repeats_s=(0.01,))
        value = 12.0
        of_scan: Counter[int] = Counter()
        while len(of_scan) < 3 or max(of_scan.values()) < 2:
            of_scan = Counter(message.header.scan for message in sent)
            intake("U1", value := value + 1e-4)
            publisher.publish_soon("area1")
            await asyncio.sleep(0.005)
        publisher.finish()
        return sent

    by_scan: dict[int, list[TelemetryMessage]] = {}
    for message in asyncio.run(test()):
        by_scan.setdefault(message.header.scan, []).append(message)
    assert max(map(len, by_scan.values())) > 1
    for messages in by_scan.values():
        assert len({(message.header.sequence, message.values) for message in messages}) == 1


@dataclass
class Timer:
    at: float
    call: Callable[[], None]
    cancelled: bool = False

    def cancel(self) -> None:
        self.cancelled = True


@dataclass
class Timeline:
    """The part of a loop that a publisher uses, on a time that only ``run_until`` moves."""

    now: float = 0.0
    timers: list[Timer] = field(default_factory=list)

    def time(self) -> float:
        return self.now

    def call_later(self, wait_s: float, call: Callable[..., None], *args: object) -> Timer:
        self.timers.append(Timer(self.now + wait_s, lambda: call(*args)))
        return self.timers[-1]

    def pending(self) -> list[Timer]:
        return sorted((timer for timer in self.timers if not timer.cancelled), key=lambda timer: timer.at)

    def run_until(self, end: float) -> None:
        while (pending := self.pending()) and pending[0].at <= end:
            self.timers.remove(pending[0])
            self.now = max(self.now, pending[0].at)
            pending[0].call()
        self.now = end


@pytest.fixture
def timeline(monkeypatch: pytest.MonkeyPatch) -> Timeline:
    found = Timeline()
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: found)
    return found


def test_neither_a_change_nor_a_repeat_is_sent_before_the_least_interval_is_over(
    two_meters: GatewayMap, timeline: Timeline
) -> None:
    intake, _, sent = make(two_meters, least_interval_s=5.0, repeats_s=(1.0, 10.0))
    times: list[float] = []
    for end in range(40):
        timeline.run_until(end)
        if end in (1, 3, 9):
            intake("U1", 12.6 + end / 100)
            timeline.run_until(end)
        times += [timeline.now] * (len(sent) - len(times))
        assert len(timeline.pending()) <= 1
    assert times == [1, 6, 11, 16, 26, 36]  # the last three are repeats
    assert [message.header.sequence for message in sent] == [1, 2, 3, 3, 3, 3]


def test_a_scan_is_published_once_although_the_wall_clock_is_slower_than_the_loop(
    two_meters: GatewayMap, timeline: Timeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time", lambda: 100.1 + 0.8 * timeline.now)
    _, _, sent = make(two_meters, LeadingPublisher, scan_s=0.5, repeats_s=(1000.0,))
    timeline.run_until(2.2)
    assert [message.header.scan for message in sent] == [200, 201, 202, 203]


def test_all_areas_get_a_scan_under_one_number_although_it_ends_meanwhile(
    two_meters: GatewayMap, timeline: Timeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter((100.4, *(100.6 for _ in range(100))))
    monkeypatch.setattr(time, "time", lambda: next(clock))
    _, _, sent = make(two_meters, LeadingPublisher, scan_s=0.5, repeats_s=(1000.0,))
    timeline.run_until(0.15)
    assert [message.header.scan for message in sent] == [200, 201]
