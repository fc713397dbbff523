"""What an area has last heard of its neighbours and of its telemetry, and how long ago.

Of each sender the newest (incarnation, sequence) counts, and ages are by the area's own clock, from the moment at
which the newest was last heard, repeats included: what a paused process or a slow link brings late is not young
because it says so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

from agents.messages import (
    BoundaryNews,
    Header,
    LoadMessage,
    TelemetryMessage,
)

FRESH_BEATS = 3  # younger is fresh: everything is repeated at every beat, and two repeats in a row may be lost
PASSED_ON_BEATS = 3.5  # older is not passed on as fresh; the third repeat, which comes just after three beats, may be
OVER_BEATS = 10  # after which a life that is not heard is over

NeighbourNews = LoadMessage | BoundaryNews
M = TypeVar("M", bound=NeighbourNews)


def is_old(header: Header, last: Header, silence_s: float, over_s: float) -> bool:
    """Whether ``last``, not heard for ``silence_s``, is newer: a later word of its life, or of a later life.

    A life that was silent for more than ``over_s`` is over; the clock of the next one may have been set back.
    """
    is_over = header.incarnation != last.incarnation and silence_s > over_s
    return header.order < last.order and not is_over


class Hearing:
    """The newest messages of every kind; ``beat_s``: interval at which they are repeated."""

    def __init__(self, beat_s: float) -> None:
        self.telemetry: TelemetryMessage | None = None
        self.loads: dict[str, LoadMessage] = {}
        self.boundary: dict[str, BoundaryNews] = {}
        self._fresh_s = FRESH_BEATS * beat_s
        self._beat_s = beat_s
        self._over_s = OVER_BEATS * beat_s
        self._spoke_at: dict[tuple[str, str], float] = {}  # when what is kept was last heard, by kind and sender
        self._heard_at: dict[str, float] = {}  # the newest boundary message of each neighbour
        self._telemetry_at = self._scan_since = 0.0

    @property
    def scan(self) -> int:
        """The scan that the area works on; 0 before telemetry."""
        return self.telemetry.header.scan if self.telemetry else 0

    def take(self, message: NeighbourNews, now: float) -> bool:
        """Keep ``message`` if it is the newest of its sender and kind; whether it is, and no repeat."""
        if isinstance(message, LoadMessage):
            return self._keep_newest(self.loads, message, now)
        is_new = self._keep_newest(self.boundary, message, now)
        sender = message.header.sender
        if message.header.order == self.boundary[sender].header.order:
            self._heard_at[sender] = now
            self._renew(message)
        return is_new

    def take_telemetry(self, message: TelemetryMessage, now: float) -> bool:
        """Keep ``message`` if it is newer than what there is; whether it is."""
        last = self.telemetry
        if last is not None and is_old(message.header, last.header, now - self._telemetry_at, self._over_s):
            return False
        self._telemetry_at = now
        if last is not None and message.header.order == last.header.order:
            return False
        if message.header.scan != self.scan:
            self._scan_since = now
        self.telemetry = message
        return True

    def _keep_newest(self, kept: dict[str, M], message: M, now: float) -> bool:
        """Whether ``message`` is newer than what was kept of its sender; then it is kept."""
        sender = message.header.sender
        last = kept.get(sender)
        if last is not None and is_old(
            message.header, last.header, now - self._spoke_at[message.kind, sender], self._over_s
        ):
            return False
        self._spoke_at[message.kind, sender] = now
        is_new = last is None or message.header.order != last.header.order
        if is_new:
            kept[sender] = message
        return is_new

    def _renew(self, message: BoundaryNews) -> None:
        """Under one number nothing changes but whether all is fresh: there the later of two repeats counts."""
        last = self.boundary[message.header.sender]
        if message.header.time > last.header.time:
            header = replace(last.header, time=message.header.time)
            self.boundary[message.header.sender] = replace(last, header=header, fresh=message.fresh)

    def forget_neighbours(self) -> None:
        """As if they had never spoken."""
        for heard in (self.loads, self.boundary, self._heard_at, self._spoke_at):
            heard.clear()

    def telemetry_age(self, now: float) -> float:
        """s since the telemetry was last heard; 0 before the first."""
        return now - self._telemetry_at if self.telemetry else 0.0

    def ages(self, now: float) -> dict[str, float]:
        """Neighbour -> s since its newest boundary message was last heard."""
        return {name: now - at for name, at in sorted(self._heard_at.items())}

    def scans(self) -> dict[str, int]:
        """Neighbour -> the scan of its newest boundary message."""
        return {name: message.header.scan for name, message in sorted(self.boundary.items())}

    def old_sides(self) -> tuple[str, ...]:
        """The neighbours that say that their word rests on something old."""
        return tuple(sorted(name for name, message in self.boundary.items() if not message.fresh))

    def usable(self, now: float) -> dict[str, BoundaryNews]:
        """The boundary messages to be used: of another scan only for a while, until their senders should have ours.

        Later they would pass for knowledge of a state that has moved on. Who is ahead is used as long as he is heard.
        """
        waits = now - self._scan_since < self._fresh_s
        ahead = {name for name, at in self._heard_at.items() if now - at < self._fresh_s}
        return {
            name: m
            for name, m in self.boundary.items()
            if waits or m.header.scan == self.scan or (m.header.scan > self.scan and name in ahead)
        }

    def is_late(self, now: float, beats: float = FRESH_BEATS) -> bool:
        """Whether telemetry has not been heard for ``beats``."""
        return self.telemetry is not None and now >= self._telemetry_at + beats * self._beat_s

    def find_old(self, neighbours: Iterable[str], now: float, beats: float = FRESH_BEATS) -> set[str]:
        """Those of ``neighbours`` whose word is not of this scan, not heard for ``beats``, or rests on what is old."""
        limit = beats * self._beat_s
        return {
            name
            for name in neighbours
            if (m := self.boundary.get(name)) is None
            or not m.fresh
            or m.header.scan != self.scan
            or now >= self._heard_at[name] + limit
        }

    def next_change(self, now: float) -> float:
        """When something that is fresh now will not be, if nothing is heard until then; infinity if nothing is."""
        moments = [*self._heard_at.values(), self._scan_since] + ([self._telemetry_at] if self.telemetry else [])
        limits = (self._fresh_s, PASSED_ON_BEATS * self._beat_s)
        return min([at + limit for at in moments for limit in limits if at + limit > now], default=float("inf"))
