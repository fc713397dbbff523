"""The newest reading of each meter of an area, from any gateway, and which readings are rejected.

Of two readings of a meter the one that was measured later counts. So neither the order nor the number of messages
matters. A rejected reading never replaces an accepted one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from agents.messages.packing import Incarnation, TelemetryMessage
from agents.peers.rejections import find_reading_rejection
from agents.protocol.configuration import Configuration
from dsse_core.grid.measurement import Meter, Source
from dsse_core.reading_rules import ANYBODY, KindRule, allowed_lead_s

INVALID = "marked invalid"  # a reason of rejection
AHEAD = "time in the future"  # another
OUTLIVED = "measured long before its scan"  # another
UNKNOWN, NOT_ITS_METER = OF_THE_SENDER = "unknown meter", "meter of another gateway"  # no meter is to blame for these
Order = tuple[float, str, tuple[Incarnation, int]]
"""Order of the readings of a meter: time of measurement; at equal times gateway, then message."""


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
    which the next snapshot leaves out.
    """

    def __init__(self, content: Configuration) -> None:
        self.newest: dict[str, Reading] = {}
        self.why_rejected: dict[str, str] = {}
        self.rejected: Counter[str] = Counter()
        self.off: frozenset[str] = frozenset()
        self.lead_s = allowed_lead_s(content.scan_s)
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
            if self.is_of_scan(meter, gateway):
                continue
            reading = Reading(value, sigma, (time, gateway, order))
            known = self.newest.get(meter_id)
            is_behind = known is not None and reading.order <= known.order
            if known is not None and is_behind and known.time <= wall + self.lead_s:
                continue  # otherwise the area's clock was set back, and the known reading is of the future
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
