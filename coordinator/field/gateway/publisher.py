"""The publisher: sends the newest readings of each area as one message, soon after a change, and repeats it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from agents.messages.packing import Header, Incarnation, TelemetryMessage, encode
from coordinator.field.gateway.intake import Intake

REPEATS_S = (1.0, 10.0)  # after a change, and then always: a repeat replaces a message that the bus has dropped
RATE = 16 * 2**20  # bytes per second for one area: a larger message delays the next one


@dataclass
class Publisher:
    """Publishes all that ``intake`` has of an area as one message, after a change and at ``repeats_s``.

    A message waits until ``least_interval_s`` has passed since the last one; readings in between are superseded. An
    area has one timer at most: of its waiting change, else of the next repeat.
    ``send``: area -> puts a payload on its key. ``scan_s``: interval of scans, None where there are none.
    """

    run: str
    name: str
    incarnation: Incarnation
    intake: Intake
    send: Mapping[str, Callable[[bytes], None]]
    least_interval_s: float
    scan_s: float | None = None
    repeats_s: Sequence[float] = REPEATS_S
    _loop: asyncio.AbstractEventLoop = field(init=False)
    _sequence: int = 0
    _of_area: dict[str, int] = field(default_factory=dict)  # area -> number of its newest content
    _timers: dict[str, asyncio.TimerHandle] = field(default_factory=dict)
    _repeats: dict[str, asyncio.TimerHandle] = field(default_factory=dict)
    _allowed: dict[str, float] = field(default_factory=dict)  # area -> earliest time of its next message, s

    def start(self) -> None:
        """Begin to publish, in the running loop."""
        self._loop = asyncio.get_running_loop()
        self.intake.on_reading = self.publish_soon

    def publish_soon(self, area: str) -> None:
        """Publish ``area`` as soon as the interval is over, with all readings that arrive until then."""
        if area not in self._timers and area in self.send:
            self._cancel_timers(area)
            wait_s = self._allowed.get(area, 0.0) - self._loop.time()
            self._timers[area] = self._loop.call_later(max(0.0, wait_s), self._publish, area, 0)

    def finish(self) -> None:
        """Publish the changes that wait, and stop all timers."""
        for timer in (*self._timers.values(), *self._repeats.values()):
            timer.cancel()
        for area in list(self._timers):
            self._publish(area, None)

    def _publish(self, area: str, repeats: int | None) -> None:
        """Send the message of ``area``; ``repeats``: index in ``repeats_s`` of the wait before a repeat, None: none."""
        self._cancel_timers(area)
        if self.intake.take_waiting(area):
            self._sequence += 1
            self._of_area[area] = self._sequence
        if area not in self._of_area:
            return
        payload = encode(self.message(area))
        self.send[area](payload)
        self.intake.counts.messages += 1
        interval_s = max(self.least_interval_s, len(payload) / RATE)
        self._allowed[area] = self._loop.time() + interval_s
        if repeats is not None:
            following = min(repeats + 1, len(self.repeats_s) - 1)
            wait_s = max(self.repeats_s[repeats], interval_s)
            self._repeats[area] = self._loop.call_later(wait_s, self._publish, area, following)

    def _cancel_timers(self, area: str) -> None:
        for timers in (self._timers, self._repeats):
            if (timer := timers.pop(area, None)) is not None:
                timer.cancel()

    def message(self, area: str) -> TelemetryMessage:
        """The message with all readings of ``area``, stamped with the current time."""
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


@dataclass
class LeadingPublisher(Publisher):
    """Publisher of the gateway that numbers scans.

    At each multiple of ``scan_s`` in UTC it sends all areas a snapshot of their readings under the number of the scan.
    It repeats this snapshot every ``repeats_s[0]`` until the next scan.
    """

    _scan: int = -1  # number of the scan whose snapshot is sent; none yet
    _messages: dict[str, TelemetryMessage] = field(default_factory=dict)

    def start(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._begin_scan()

    def publish_soon(self, area: str) -> None:
        """Send the snapshot of this scan again, to an area that has just appeared."""
        if area in self._messages:
            self._publish(area, None)

    def finish(self) -> None:
        for timer in self._timers.values():
            timer.cancel()

    def _begin_scan(self) -> None:
        assert self.scan_s is not None  # as the map was checked
        now = time.time()
        scan = int(now // self.scan_s)
        if scan != self._scan:  # else the timer, on the loop's clock, was early by the wall clock
            self._scan = scan
            self._take_snapshot()
            self._repeat()
        self._timers["scan"] = self._loop.call_later((self._scan + 1) * self.scan_s - now, self._begin_scan)

    def _take_snapshot(self) -> None:
        self._sequence += 1
        for area in self.send:
            self.intake.take_waiting(area)
            self._of_area[area] = self._sequence
            message = self.message(area)
            self._messages[area] = replace(message, header=replace(message.header, scan=self._scan))

    def _repeat(self) -> None:
        if (timer := self._timers.pop("repeat", None)) is not None:
            timer.cancel()
        for area in self.send:
            self._publish(area, None)
        self._timers["repeat"] = self._loop.call_later(self.repeats_s[0], self._repeat)

    def _publish(self, area: str, repeats: int | None) -> None:
        message = self._messages[area]
        header = replace(message.header, time=time.time())
        self.send[area](encode(replace(message, header=header)))
        self.intake.counts.messages += 1
