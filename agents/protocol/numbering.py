"""The numbering of scans, by telemetry or by clocks, and the readings of the current scan and of later ones.

Where telemetry numbers scans, the scan of a term is the number that the plant gives it plus an *offset*. Each
incarnation of the plant has an offset: 0, or the increment that keeps scan numbers growing when a restarted plant
counts lower, as its clock has been set back. Areas may find different offsets necessary. They send each other their
offsets, and the largest counts for all.

Where clocks number scans, a scan is a tick, a multiple of the time between two of them in UTC. An area enters a tick at
its time by its own clock, or as soon as it learns of it from a neighbour, and takes the newest readings that it has
then. After the first readings of all meters the area waits for no reading: ages are accounted for.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum, auto

from agents.messages.packing import NO_INCARNATION, Incarnation, TelemetryMessage
from agents.peers.orders_and_ages import FRESH_HEARTBEATS, PATIENCE_HEARTBEATS, is_old
from agents.peers.rejections import MOST_COUNTED
from agents.protocol.configuration import Configuration
from agents.protocol.events import Ordered
from agents.protocol.readings import DEADLINE_HEARTBEATS, Readings, ReadingStore, expected_scan_s
from dsse_core.reading_rules import NO_RULE, SCAN_SHARE

MOST_AHEAD = 10  # scans of a neighbour ahead of telemetry that is received; with more, one of them is wrong
MOST_AHEAD_S = 60.0  # by which a neighbour's tick may be ahead of the own clock, beside one tick and ``MOST_AHEAD``
ROUNDING_S = 2e-6  # of a time of day as a floating-point number, doubled: a tick that is due has come
LARGEST_SCAN = 3 * MOST_COUNTED // 4  # that the numbering of a neighbour may lead to; scans go on from there


class TelemetryUpdate(Enum):
    """Use of new telemetry: none, for the scan that waits for it, for a scan under way, for a later one."""

    NONE = auto()
    AWAITED = auto()
    LATE = auto()
    NEXT_SCAN = auto()


class ScanReadings:
    """Readings of the current scan and of later ones, where telemetry numbers scans.

    ``scan``: the current one, 0 before any. ``are_there``: its readings are, or it goes on without them, and then is
    ``stale``. ``store``: the readings that belong to no scan. ``clock_offset``: from monotonic to wall-clock time, s.
    """

    def __init__(self, content: Configuration, now: float, clock_offset: float = 0.0) -> None:
        self.store = ReadingStore(content)
        self.readings = Readings(content, self.store)
        self.clock_offset = clock_offset
        self.scan = 0
        self.are_there = self.stale = False
        self.entered_at = now
        self._rejected: Counter[str] = Counter()  # of readings of scans
        self._heartbeat_s = content.beat_s
        self._deadline_s = SCAN_SHARE * expected_scan_s(content)
        self._may_be_behind_s = max(self.store.lead_s, NO_RULE.leaves_out_s(content.scan_s))
        self._may_be_ahead_s = self.store.lead_s if content.scan_s else float("inf")  # as clocks of neighbours
        self._last: TelemetryMessage | None = None
        self._received_at = now
        self._clock_behind_s = 0.0  # lag of the leader's clock, by its newest message
        self._later: dict[int, TelemetryMessage] = {}
        self._used: TelemetryMessage | None = None  # the message whose readings were last used
        self._takes_anew = False  # as the operator has asked
        self._leader = content.readings.leader
        self._aging = {meter.id for meter in content.meters if content.readings.rule_of(meter.kind).period_s}
        self._offset = 0  # of the incarnation of the plant that was last received
        self._of_neighbours: dict[str, tuple[Incarnation, int]] = {}  # neighbour -> incarnation and offset of its plant

    @property
    def rejected(self) -> Counter[str]:
        """Readings that cannot be used, by reason."""
        return self._rejected + self.store.rejected

    def note_time(self, now: float) -> None:
        """Notes the monotonic time ``now``, where scans depend on it."""

    @property
    def next_tick_at(self) -> float:
        """Monotonic time at which the next scan begins by itself: infinity, as telemetry numbers scans."""
        return float("inf")

    @property
    def lead_s(self) -> float:
        """Lead of the scan over the area's clock, s; 0 where this clock does not number scans."""
        return 0.0

    @property
    def next_scan(self) -> int:
        """The newest later scan with readings; 0 without one."""
        return max((scan for scan in self._later if scan > self.scan), default=0)

    @property
    def are_outdated(self) -> bool:
        """True where other readings of this scan wait for the next term."""
        return self.scan in self._later or self._takes_anew

    def age(self, now: float) -> float:
        """Returns the time since telemetry was last received, s; before the first, since the area's process began."""
        return now - self._received_at

    def is_late(self, now: float, heartbeats: float = FRESH_HEARTBEATS) -> bool:
        """True where no telemetry has been received for ``heartbeats`` intervals."""
        return now >= self._received_at + heartbeats * self._heartbeat_s

    def fresh_until(self, heartbeats: float) -> float:
        """Returns the time from which ``is_late`` holds if no telemetry comes before."""
        return self._received_at + heartbeats * self._heartbeat_s

    def may_enter(self, scan: int, now: float) -> bool:
        """True where a neighbour can be at ``scan``: numbers come from telemetry, and terms never go back.

        An area that receives no telemetry, not yet or no more, accepts any scan up to a fixed limit.
        """
        if self._last is None or self.is_late(now, PATIENCE_HEARTBEATS):
            return scan <= MOST_COUNTED // 2  # the scans after a lie of this size are still accepted
        return scan <= self._last.header.scan + self._offset + MOST_AHEAD

    @property
    def deadline(self) -> float:
        """Time at which the scan goes on without its readings; infinity if they are there.

        With readings of a later scan it is the start of the scan: the plant sends scans in order, so those of this scan
        have been replaced unread.
        """
        if self.are_there or not self.scan:
            return float("inf")
        return self.entered_at + (0.0 if self.next_scan else self._deadline_s)

    @property
    def has_been_read(self) -> bool:
        """True where telemetry has ever been received."""
        return self._last is not None

    def _is_newer(self, message: TelemetryMessage, now: float) -> bool:
        """Notes that telemetry is received; returns whether it is newer than the last."""
        last = self._last
        patience_s = PATIENCE_HEARTBEATS * self._heartbeat_s
        if last is not None and is_old(message.header.order, last.header.order, now - self._received_at, patience_s):
            return False
        is_heard = last is not None and not self.is_late(now)
        self._received_at = now
        if last is not None and message.header.order == last.header.order:
            return False
        behind_s = now + self.clock_offset - message.header.time
        self._clock_behind_s = behind_s if is_heard else min(behind_s, 0.0)  # a scan may have been held for long
        return True

    @property
    def leader_ahead_s(self) -> float:
        """Lead of the clock of the leader, which numbers scans, s; 0 where its readings may be of the present."""
        behind_s = self._clock_behind_s
        return 0.0 if -self._may_be_ahead_s <= behind_s <= self._may_be_behind_s else -behind_s

    def take_at_once(self, message: TelemetryMessage, now: float) -> bool:
        """Uses telemetry at once if it is newer, whatever its scan; returns whether it has used any.

        For asynchronous strategies.
        """
        is_changed = self.store.take(message, now + self.clock_offset)
        if message.header.sender != self._leader:
            return is_changed and self._read_again(now)
        if not self._is_newer(message, now):
            return False
        if message.header.scan != self.scan:
            self.scan, self.entered_at = message.header.scan, now
        self._last = message
        self._read(message, now)
        return True

    def _read_again(self, now: float) -> bool:
        """Takes the newest other readings beside those of the scan in use; returns whether there is such a scan."""
        if self._used is not None:
            self._read(self._used, now)
        return self._used is not None

    def take(self, message: TelemetryMessage, now: float) -> TelemetryUpdate:
        """Keeps telemetry that is newer than the last; returns its use."""
        self.store.take(message, now + self.clock_offset)
        is_operated = self.store.statuses.take(message, now + self.clock_offset) and self.are_there
        update = TelemetryUpdate.NONE
        if message.header.sender == self._leader and self._is_newer(message, now):
            self._renumber(message)
            self._last = message
            update = self._file(message, now)
        if is_operated and update is TelemetryUpdate.NONE:
            self._takes_anew, update = True, TelemetryUpdate.LATE
        return update

    def _renumber(self, message: TelemetryMessage) -> None:
        """Finds the offset of the plant, so that terms never go back.

        A new offset is found for an incarnation that is received for the first time or again, and where the numbers of
        the plant have gone back with its clock. The same holds where they are so far behind the current scan that a
        neighbour must have stated this scan wrongly.
        """
        last, incarnation, number = self._last, message.header.incarnation, message.header.scan
        if last is None or incarnation != last.header.incarnation or number < last.header.scan:
            self._later.clear()  # of former numbers: to enter those scans would leave this one behind
            self._offset = max(
                (offset for its_incarnation, offset in self._of_neighbours.values() if its_incarnation == incarnation),
                default=0,
            )
            if last is not None and number + self._offset < self.scan:
                self._offset = self.scan + self.are_there - number
        if number + self._offset < self.scan - MOST_AHEAD:
            self._offset = self.scan + self.are_there - number

    @property
    def numbering(self) -> tuple[Incarnation, int]:
        """The incarnation of the plant that was last received, and the offset of its scans."""
        return (self._last.header.incarnation, self._offset) if self._last else (NO_INCARNATION, 0)

    def take_numbering(self, name: str, incarnation: Incarnation, offset: int, now: float) -> TelemetryUpdate:
        """Follows neighbour ``name`` where it needs a larger ``offset`` for an ``incarnation`` of the plant."""
        if offset + (self._last.header.scan if self._last else 0) > LARGEST_SCAN:
            return TelemetryUpdate.NONE  # a lie, after which no neighbour would take a message of this area
        self._of_neighbours[name] = incarnation, offset
        if self._last is None or incarnation != self._last.header.incarnation or offset <= self._offset:
            return TelemetryUpdate.NONE
        self._offset = offset
        self._later.clear()  # all other messages are older
        return self._file(self._last, now)

    def _file(self, message: TelemetryMessage, now: float) -> TelemetryUpdate:
        """Keeps the newest readings for their scan; returns their use."""
        scan = message.header.scan + self._offset
        if scan > self.scan:
            self._later[scan] = message
            return TelemetryUpdate.NEXT_SCAN
        if scan < self.scan:
            return TelemetryUpdate.NONE
        if not self.are_there:
            self._read(message, now)
            return TelemetryUpdate.AWAITED
        known = self._later.get(scan, self._used)
        if self.stale or known is None or self._select_scan(message) != self._select_scan(known):
            self._later[scan] = message  # the term under way keeps its readings until the next term
            return TelemetryUpdate.LATE
        return TelemetryUpdate.NONE

    def enter(self, scan: int, now: float) -> None:
        """Begins a term of ``scan``, with the readings that have been received."""
        if scan != self.scan:
            self.scan, self.entered_at, self.are_there, self.stale = scan, now, False, False
        if scan in self._later:
            self._read(self._later.pop(scan), now)
        elif self._takes_anew and self.are_there:
            list(self.readings.take(self._used, now, now + self.clock_offset))  # rejections are counted already
        self._takes_anew = False
        self._later = {later: message for later, message in self._later.items() if later > scan}

    def follow(self, ordered: Ordered) -> bool:
        """Leaves out the meters that the operator has switched off, and sets the switches that the operator has set.

        Returns whether the readings must be taken again for this command; the next term does so.
        """
        off = frozenset(ordered.meters_off)
        is_change = self.store.statuses.follow(ordered.switches) or off != self.store.off
        self.store.off = off
        is_due = (is_change or ordered.scan) and self.are_there
        self._takes_anew |= is_due
        return is_due

    def go_on_without(self, now: float) -> None:
        """Lets the newest readings stand in for those of the scan."""
        if self.next_scan:
            self._read(self._later[self.next_scan], now)
        elif self.store.newest:
            self._rejected.update(self.readings.take(self._used, now, now + self.clock_offset))
        self.are_there = self.stale = True

    def _read(self, message: TelemetryMessage, now: float) -> None:
        self._used = message
        self._rejected.update(self.readings.take(message, now, now + self.clock_offset))
        self.are_there, self.stale = True, False

    def _select_scan(self, message: TelemetryMessage) -> list[tuple[object, ...]]:
        """Returns the readings that belong to the scan of ``message``."""
        columns = message.meters, message.values, message.sigmas, message.valid
        return [reading for reading in zip(*columns, strict=True) if reading[0] not in self._aging]


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
        """Returns the time since the newest reading was measured, s; before the first, since the process began."""
        return max(0.0, now + self.clock_offset - self.store.newest_time) if self.store.newest else super().age(now)

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
        self.store.statuses.take(message, now + self.clock_offset)
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
