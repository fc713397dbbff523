"""The readings of scans that clocks number: a scan is a tick, a multiple of the time between two of them in UTC.

An area enters a tick at its time by its own clock, or as soon as it learns of it from a neighbour, and takes the newest
readings that it has then. After the first readings of all meters the area waits for no reading: ages are accounted for.
"""

from __future__ import annotations

from agents.messages.packing import NO_INCARNATION, Incarnation, TelemetryMessage
from agents.protocol.configuration import Configuration
from agents.protocol.readings import DEADLINE_HEARTBEATS
from agents.protocol.scan_readings import MOST_AHEAD, ScanReadings, TelemetryUpdate

MOST_AHEAD_S = 60.0  # by which a neighbour's tick may be ahead of the own clock, beside one tick and ``MOST_AHEAD``
ROUNDING_S = 2e-6  # of a time of day as a floating-point number, doubled: a tick that is due has come


class TickReadings(ScanReadings):
    """Readings of scans that are ticks; see ``ScanReadings``. Telemetry numbers no scans here."""

    def __init__(self, content: Configuration, now: float, clock_offset: float = 0.0) -> None:
        super().__init__(content, now, clock_offset)
        assert content.scan_s is not None  # as the reader of area files makes sure
        self._scan_s = content.scan_s
        self._now = now
        self._ticks_ahead = max(1, int(min(MOST_AHEAD, MOST_AHEAD_S / self._scan_s)))
        self._first_wait_s = min(self._deadline_s, DEADLINE_HEARTBEATS * self._heartbeat_s)
        self._is_received = False
        self._waits_for_term = False

    def note_time(self, now: float) -> None:
        self._now = now

    @property
    def _tick(self) -> int:
        """The tick that has come by the area's clock."""
        return int((self._now + self.clock_offset + ROUNDING_S) // self._scan_s)

    @property
    def next_tick_at(self) -> float:
        return (self._tick + 1) * self._scan_s - self.clock_offset

    @property
    def next_scan(self) -> int:
        return self._tick if self._tick > self.scan else 0

    @property
    def lead_s(self) -> float:
        """Lead of the scan over the area's clock, s: a neighbour's clock is ahead, or this one has been set back."""
        return max(0.0, self.scan * self._scan_s - (self._now + self.clock_offset))

    @property
    def are_outdated(self) -> bool:
        return self._waits_for_term or self._takes_anew

    def age(self, now: float) -> float:
        """Returns the time since the newest reading was measured, s; 0 before the first."""
        return max(0.0, now + self.clock_offset - self.store.newest_time) if self.store.newest else 0.0

    def is_late(self, now: float, heartbeats: float = 0.0) -> bool:
        """Returns False: each reading states its own time."""
        return False

    def fresh_until(self, heartbeats: float) -> float:
        return float("inf")

    def may_enter(self, scan: int, now: float) -> bool:
        return scan <= self._tick + self._ticks_ahead

    @property
    def deadline(self) -> float:
        """Time at which the wait for the first readings of all meters ends; infinity if readings are in use."""
        return float("inf") if self.are_there or not self.scan else self.entered_at + self._first_wait_s

    @property
    def has_been_read(self) -> bool:
        return self._is_received

    @property
    def numbering(self) -> tuple[Incarnation, int]:
        return NO_INCARNATION, 0

    def take_numbering(self, name: str, incarnation: Incarnation, offset: int, now: float) -> TelemetryUpdate:
        return TelemetryUpdate.NONE

    def take_at_once(self, message: TelemetryMessage, now: float) -> bool:
        """Takes the first readings as they come, all others at a tick; for asynchronous strategies."""
        self._is_received = True
        is_changed = self.store.take(message, now + self.clock_offset)
        if is_changed and self.scan and not self.readings.ages.times:
            self._read_newest(now)
            return True
        return False

    def take(self, message: TelemetryMessage, now: float) -> TelemetryUpdate:
        """Keeps newer readings, which wait for the next tick, unless this one has none; returns their use."""
        self._is_received = True
        is_changed = self.store.take(message, now + self.clock_offset)
        if not self.scan:
            return TelemetryUpdate.NONE
        if not self.are_there:
            if not self.store.is_complete:
                return TelemetryUpdate.NONE
            self._read_newest(now)
            return TelemetryUpdate.AWAITED
        if not (is_changed and self.stale):
            return TelemetryUpdate.NONE
        self._waits_for_term = True
        return TelemetryUpdate.LATE

    def enter(self, scan: int, now: float) -> None:
        """Begins a term of ``scan``; a later term of the same scan keeps its readings unless new ones wait for it."""
        if scan != self.scan:
            self.scan, self.entered_at, self.are_there, self.stale = scan, now, False, False
            if self.store.newest:
                self._read_newest(now)
        elif self.are_outdated:
            self._read_newest(now)
        self._takes_anew = False

    def go_on_without(self, now: float) -> None:
        """Goes on with the readings that have been received."""
        self._read_newest(now)

    def _read_newest(self, now: float) -> None:
        self._rejected.update(self.readings.take(None, now, now + self.clock_offset))
        self.are_there, self._waits_for_term = True, False
        self.stale = self.store.has_meters and not self.readings.ages.times
