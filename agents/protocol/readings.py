"""The readings of an area: the newest of each meter, the snapshot that a scan works with, and the net load from it.

Of two readings of a meter the one that was measured later counts (``dsse_core/reading_rules.py``). So neither the order
nor the number of messages matters. A rejected reading never replaces an accepted one.

A reading of a scan comes with the message of that scan. All others are the newest of their meters, from any gateway,
and their standard deviations grow with their age. A snapshot is used until the next one is taken.

The stated time of a reading always counts. A reading of a scan must have been measured at most some scans before its
message was made: a scan may be held for long, and its readings do not age meanwhile.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from agents.messages.packing import Incarnation, TelemetryMessage
from agents.peers.rejections import find_reading_rejection
from agents.protocol.configuration import Configuration
from agents.protocol.statuses import Statuses
from dsse_core.exchange.boundary_load import Loads, measured_net_loads, own_net_loads
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.reading_rules import ANYBODY, SCAN_SHARE, KindRule, allowed_lead_s, replaces

INVALID = "marked invalid"  # a reason of rejection
AHEAD = "time in the future"  # another
OUTLIVED = "measured long before its scan"  # another
UNKNOWN, NOT_ITS_METER = OF_THE_SENDER = "unknown meter", "meter of another gateway"  # no meter is to blame for these
Order = tuple[float, str, tuple[Incarnation, int]]
"""Order of the readings of a meter: time of measurement; at equal times gateway, then message."""
DEADLINE_HEARTBEATS = 5  # after which an area goes on without its own readings, where no time between scans is known

Read = dict[str, tuple[Measurement, float]]
"""Meter id -> its reading, and the time of measurement, s since 1970 UTC."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Reading of a meter, p.u. or rad, measured at ``order[0]``, s since 1970 UTC."""

    value: float
    sigma: float
    order: Order

    @property
    def time(self) -> float:
        return self.order[0]

    @property
    def gateway(self) -> str:
        return self.order[1]


class ReadingStore:
    """Newest readings of the meters of an area, without those that belong to a scan.

    ``newest``: meter id -> its newest reading. ``why_rejected``: meter id -> reason for which a newer one was rejected.
    ``rejected``: number of rejected readings, by reason. ``off``: ids of the meters that the operator has switched off,
    which the next snapshot leaves out. ``statuses``: of the switches of the area.
    """

    def __init__(self, content: Configuration) -> None:
        self.newest: dict[str, Reading] = {}
        self.why_rejected: dict[str, str] = {}
        self.rejected: Counter[str] = Counter()
        self.off: frozenset[str] = frozenset()
        self.lead_s = allowed_lead_s(content.scan_s)
        self.statuses = Statuses(content.area.network.switches, content.readings, self.lead_s)
        self._rules = content.readings
        self._all_at_every_scan = not any(rule.period_s for rule in content.readings.kinds.values())
        self._meters = {meter.id: meter for meter in content.meters if meter.source is not Source.VIRTUAL}
        self._taken: dict[str, tuple[Incarnation, int]] = {}  # gateway -> its last message
        self._allowed = {
            name: None if meters == "all" else frozenset(meters) for name, meters in self._rules.gateways.items()
        }

    @property
    def has_meters(self) -> bool:
        """True where the area has a real meter that is not switched off."""
        return bool(self._meters.keys() - self.off)

    @property
    def is_complete(self) -> bool:
        """True where every real meter that is not switched off has a reading."""
        return self.newest.keys() >= self._meters.keys() - self.off

    @property
    def newest_time(self) -> float:
        """Time of measurement of the newest reading, s since 1970 UTC; 0 without one."""
        return max((reading.time for reading in self.newest.values()), default=0.0)

    def rule_of(self, meter: Meter) -> KindRule:
        """Returns the rule for the readings of ``meter``."""
        return self._rules.rule_of(meter.kind)

    def is_of_scan(self, meter: Meter | None, gateway: str) -> bool:
        """True where a reading belongs to the scan of its message; ``meter``: None for an unknown one.

        Such a reading counts in no other scan, and does not age.
        """
        return self._numbers_scans(gateway) and (meter is None or self.rule_of(meter).period_s is None)

    def _numbers_scans(self, gateway: str) -> bool:
        return self._rules.ticks == "gateway" and gateway == self._rules.leader

    def find_rejection(self, meter_id: str, gateway: str, value: float, sigma: float, *, is_valid: bool) -> str:
        """Returns the reason for which a reading cannot be used, whatever its time; empty if it can."""
        meter = self._meters.get(meter_id)
        if meter is None:
            return UNKNOWN
        allowed = self._allowed.get(gateway, self._allowed.get(ANYBODY, frozenset()))
        if allowed is not None and meter_id not in allowed:
            return NOT_ITS_METER
        if not is_valid:
            return INVALID
        if not self.rule_of(meter).holds(value):
            return "reading out of range"
        return find_reading_rejection(value, sigma)

    def take(self, message: TelemetryMessage, wall: float) -> bool:
        """Keeps the readings that are newer than the known ones; returns whether any is kept.

        ``wall``: now, s since 1970. Readings that belong to a scan are left to ``Readings``.
        """
        gateway, order = message.header.sender, message.header.order
        is_repeated, self._taken[gateway] = self._taken.get(gateway) == order, order
        if self._all_at_every_scan and self._numbers_scans(gateway):
            return False  # without a loop over the readings: at rest this message comes at every heartbeat
        is_changed = False
        columns = message.meters, message.values, message.sigmas, message.times, message.valid
        for meter_id, value, sigma, time, is_valid in zip(*columns, strict=True):
            meter = self._meters.get(meter_id)
            if self.is_of_scan(meter, gateway) or meter_id in self.statuses.meters:
                continue
            reading = Reading(value, sigma, (time, gateway, order))
            known = self.newest.get(meter_id)
            if known is not None and not replaces(reading.order, known.order, wall, self.lead_s):
                continue
            reason = self.find_rejection(meter_id, gateway, value, sigma, is_valid=is_valid)
            if not reason and time > wall + self.lead_s:
                reason = AHEAD
            if not reason:
                self.newest[meter_id] = reading
                self.why_rejected.pop(meter_id, None)
                is_changed = True
                continue
            if reason not in OF_THE_SENDER:
                self.why_rejected[meter_id] = reason
            self.rejected[reason] += not is_repeated
        return is_changed


def expected_scan_s(content: Configuration) -> float:
    """Returns the time between two scans, s.

    Where it is not known: the time of which ``SCAN_SHARE`` lasts ``DEADLINE_HEARTBEATS``.
    """
    return content.scan_s or DEADLINE_HEARTBEATS / SCAN_SHARE * content.beat_s


@dataclass(frozen=True)
class Ages:
    """Ages of the readings of one snapshot, and the times at which they become overdue.

    ``taken_at``: moment of the area's clock to which the ages count, s since 1970. ``times``: meter id -> time of its
    reading, s since 1970 UTC. ``overdue_at``: meter id, of the meters with an interval -> time at which its reading
    becomes overdue, by the monotonic clock: setting a clock makes no reading younger. ``n_with_interval``: number of
    meters with an interval. ``mistimed_share``: share of the readings of the scan that are not used, as their time is
    not that of the scan.
    """

    taken_at: float = 0.0
    times: Mapping[str, float] = field(default_factory=dict)
    overdue_at: Mapping[str, float] = field(default_factory=dict)
    n_with_interval: int = 0
    mistimed_share: float = 0.0

    @cached_property
    def _overdue_times(self) -> list[float]:
        return sorted(self.overdue_at.values())

    @cached_property
    def oldest_s(self) -> float:
        """Age of the oldest reading when the snapshot was taken, s; 0 without one."""
        return max(0.0, self.taken_at - min(self.times.values(), default=self.taken_at))

    def find_overdue(self, now: float) -> list[str]:
        """Returns the ids of the meters whose readings are overdue at monotonic time ``now``."""
        if not bisect_right(self._overdue_times, now):
            return []
        return [meter_id for meter_id, at in self.overdue_at.items() if at <= now]

    def overdue_share(self, now: float) -> float:
        """Returns the share of the meters with an interval whose reading is missing or overdue, or
        ``mistimed_share`` if that is larger.
        """
        if not self.n_with_interval:
            return self.mistimed_share
        in_time = (len(self._overdue_times) - bisect_right(self._overdue_times, now)) / self.n_with_interval
        return max(1 - in_time, self.mistimed_share)

    def next_overdue(self, now: float) -> float:
        """Returns the monotonic time at which the next reading becomes overdue; infinity if none does."""
        k = bisect_right(self._overdue_times, now)
        return self._overdue_times[k] if k < len(self._overdue_times) else math.inf


class Readings:
    """Snapshot of the readings in use.

    ``measurements``: in use, virtual ones included; ``ages``: of these readings. ``unread``: ids of the meters without
    a reading. ``invalid``: ids of the meters whose reading is marked as invalid by its source. ``too_old``: ids of the
    meters whose reading is left out for its age. ``why_rejected``: meter id -> reason for which its newest reading is
    rejected. ``mistimed``: ids of the meters whose only reading has an impossible time. ``senders``: gateway -> ids of
    the meters whose readings in use it has sent.
    """

    def __init__(self, content: Configuration, store: ReadingStore) -> None:
        self._content = content
        self._store = store
        self._meters = {meter.id: meter for meter in content.meters}
        self._virtual = {
            meter_id: Measurement(m, 0.0, 0.0) for meter_id, m in self._meters.items() if m.source is Source.VIRTUAL
        }
        self.measurements: tuple[Measurement, ...] = tuple(self._virtual.values())
        self.unread = [meter_id for meter_id in self._meters if meter_id not in self._virtual]
        self.invalid: list[str] = []
        self.too_old: list[str] = []
        self.mistimed: frozenset[str] = frozenset()
        self.senders: dict[str, list[str]] = {}
        self.why_rejected: dict[str, str] = {}
        self.ages = Ages()
        self._expected_scan_s = expected_scan_s(content)
        by_clock = content.readings.ticks == "clock"
        self._overdue_s = {
            meter_id: rule.overdue_s(content.scan_s)  # of the meters that have an interval
            for meter_id, meter in self._meters.items()
            if meter_id not in self._virtual and ((rule := store.rule_of(meter)).period_s is not None or by_clock)
        }
        self._mistimed_share = 0.0
        self._net_loads: Loads | None = None  # of these measurements, computed when first used

    def take(self, message: TelemetryMessage | None, now: float, wall: float) -> Iterator[str]:
        """Takes a snapshot: the readings of a scan, and the newest of all others.

        Yields the reason for each reading of the scan that is rejected.

        ``message``: of the scan, None without one. ``now``: monotonic time, ``wall``: s since 1970.
        """
        self.invalid, self.too_old, self.senders = [], [], {}
        self.why_rejected = {k: reason for k, reason in self._store.why_rejected.items() if k not in self._store.off}
        read: Read = {}
        self._mistimed_share = 0.0
        if message is not None:
            yield from self._take_scan(message, read)
        self._take_newest(read, wall)
        self.invalid += [k for k, why in self.why_rejected.items() if why == INVALID and k not in read]
        self.mistimed = frozenset(k for k, why in self.why_rejected.items() if why in (AHEAD, OUTLIVED)) - read.keys()
        left_out = {*self.invalid, *self.too_old, *self.why_rejected}
        known = read.keys() | self._virtual.keys() | self._store.off | left_out
        self.measurements = (*(measurement for measurement, _ in read.values()), *self._virtual.values())
        self.unread = [meter_id for meter_id in self._meters if meter_id not in known]
        self.ages = self._find_ages({meter_id: time for meter_id, (_, time) in read.items()}, now, wall)
        self._net_loads = None

    def _take_scan(self, message: TelemetryMessage, read: Read) -> Iterator[str]:
        """Puts the readings that belong to the scan of ``message`` into ``read``; yields the reasons of rejection."""
        gateway, store, n_mistimed = message.header.sender, self._store, 0
        columns = message.meters, message.values, message.sigmas, message.times, message.valid
        for meter_id, value, sigma, time, is_valid in zip(*columns, strict=True):
            meter = self._meters.get(meter_id)
            if meter_id in store.off or (meter is not None and not store.is_of_scan(meter, gateway)):
                continue
            if meter_id in store.statuses.meters:
                continue
            if reason := store.find_rejection(meter_id, gateway, value, sigma, is_valid=is_valid):
                if reason == INVALID:
                    self.invalid.append(meter_id)
                yield reason
            elif meter is not None and (reason := self._find_mistiming(meter, message.header.time - time)):
                self.why_rejected[meter_id], n_mistimed = reason, n_mistimed + 1
                yield reason
            elif meter is not None:
                read[meter_id] = Measurement(meter, value, sigma), time
        self.senders[gateway] = list(read)
        self._mistimed_share = n_mistimed / (n_mistimed + len(read)) if n_mistimed else 0.0

    def _find_mistiming(self, meter: Meter, age_s: float) -> str:
        """Returns the reason for which a reading does not belong to its scan; empty if it does.

        ``age_s``: age of the reading when the message of the scan was made.
        """
        lead_s = self._store.lead_s
        if age_s < -lead_s:
            return AHEAD
        return OUTLIVED if age_s > max(lead_s, self._store.rule_of(meter).leaves_out_s(self._expected_scan_s)) else ""

    def _take_newest(self, read: Read, wall: float) -> None:
        """Puts the newest readings that are young enough into ``read``, with standard deviations grown with age."""
        store, scan_s = self._store, self._content.scan_s
        for meter_id, meter in self._meters.items() if store.newest else ():
            reading = store.newest.get(meter_id)
            if reading is None or meter_id in read or meter_id in store.off:
                continue
            rule, age = store.rule_of(meter), wall - reading.time
            sigma = rule.grown(reading.sigma, age)
            if age < -store.lead_s:
                self.why_rejected[meter_id] = AHEAD  # the clock of the area has been set back
            elif age > rule.leaves_out_s(scan_s) or find_reading_rejection(reading.value, sigma):
                self.too_old.append(meter_id)
            else:
                read[meter_id] = Measurement(meter, reading.value, sigma), reading.time
                self.senders.setdefault(reading.gateway, []).append(meter_id)

    def _find_ages(self, times: Mapping[str, float], now: float, wall: float) -> Ages:
        overdue_s = {k: limit for k, limit in self._overdue_s.items() if k not in self._store.off}
        overdue_at = {
            meter_id: now + limit - max(0.0, wall - times[meter_id])
            for meter_id, limit in overdue_s.items()
            if meter_id in times
        }
        return Ages(wall, times, overdue_at, len(overdue_s), self._mistimed_share)

    @property
    def net_loads(self) -> Loads:
        """Net loads that the area owns; generation by these readings or as scheduled, as the area file chooses."""
        if self._net_loads is None:
            telemetered = self._content.generation == "telemetered"
            measured = measured_net_loads(self._content.area, self.measurements) if telemetered else {}
            self._net_loads = own_net_loads(self._content.area, measured)
        return self._net_loads
