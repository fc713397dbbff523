"""The publisher: the newest readings of each area as one message, soon after they change and again now and then."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from agents.messages.packing import Header, Incarnation, TelemetryMessage, encode
from coordinator.gateway.intake import Intake

REPEATS_S = (1.0, 10.0)  # after a change, and then for ever: what the bus had no room for, an area gets by this
RATE = 16 * 2**20  # bytes per second for one area: what a message is larger, the next one is later


@dataclass
class Publisher:
    """Publishes, at most one message of an area in ``least_interval_s``, what ``intake`` has of it: a snapshot.

    A flood of readings makes no flood of messages: those in between are superseded. ``send``: area -> puts a payload
    on its key. ``scan_s``: interval of scans, None where there are none.
    """

    run: str
    name: str
    incarnation: Incarnation
    intake: Intake
    send: Mapping[str, Callable[[bytes], None]]
    least_interval_s: float
    scan_s: float | None = None
    _loop: asyncio.AbstractEventLoop = field(init=False)
    _sequence: int = 0
    _of_area: dict[str, int] = field(default_factory=dict)  # area -> number of its newest content
    _timers: dict[str, asyncio.TimerHandle] = field(default_factory=dict)
    _repeats: dict[str, asyncio.TimerHandle] = field(default_factory=dict)
    _allowed: dict[str, float] = field(default_factory=dict)  # area -> when the next message may go

    def start(self) -> None:
        """In a running loop."""
        self._loop = asyncio.get_running_loop()
        self.intake.on_reading = self.publish_soon

    def publish_soon(self, area: str) -> None:
        """As soon as the interval is over; what comes until then goes with it."""
        if area not in self._timers and area in self.send:
            wait_s = self._allowed.get(area, 0.0) - self._loop.time()
            self._timers[area] = self._loop.call_later(max(0.0, wait_s), self._publish, area, 0)

    def finish(self, areas: Iterable[str] = ()) -> None:
        """Publish what waits, and nothing any more."""
        for timer in (*self._timers.values(), *self._repeats.values()):
            timer.cancel()
        for area in list(self._timers):
            self._publish(area, None)
        for timer in self._repeats.values():
            timer.cancel()

    def _publish(self, area: str, repeats: int | None) -> None:
        """``repeats``: of REPEATS_S the one that follows; None: none."""
        self._timers.pop(area, None)
        if (last := self._repeats.pop(area, None)) is not None:
            last.cancel()
        if self.intake.take_waiting(area):
            self._sequence += 1
            self._of_area[area] = self._sequence
        if area not in self._of_area:
            return
        payload = encode(self.message(area))
        self.send[area](payload)
        self.intake.counts.messages += 1
        self._allowed[area] = self._loop.time() + max(self.least_interval_s, len(payload) / RATE)
        if repeats is not None:
            following = min(repeats + 1, len(REPEATS_S) - 1)
            self._repeats[area] = self._loop.call_later(REPEATS_S[repeats], self._publish, area, following)

    def message(self, area: str) -> TelemetryMessage:
        """All that is known of ``area``, with the time of now."""
        readings = self.intake.newest.get(area, {})
        now = time.time()
        number = self._of_area.get(area, 0)
        header = Header(
            run=self.run,
            sender=self.name,
            incarnation=self.incarnation,
            scan=int(now / self.scan_s) if self.scan_s else number,
            sequence=number,
            time=now,
        )
        return TelemetryMessage(
            header,
            area,
            meters=tuple(readings),
            values=tuple(reading.value for reading in readings.values()),
            sigmas=tuple(reading.sigma for reading in readings.values()),
            times=tuple(reading.time for reading in readings.values()),
            valid=tuple(reading.valid for reading in readings.values()),
        )
