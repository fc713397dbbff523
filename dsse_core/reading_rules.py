"""Rules for the readings that an area takes, their gateways and ages: the words that scenarios and agents share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from dsse_core.grid.measurement import MeasurementKind
from dsse_core.limits import Seconds

Ticks = Literal["gateway", "clock"]
"""The source of scan numbers: the gateway that leads, or the clock of each area, by UTC."""
MetersOf = tuple[str, ...] | Literal["all"]
"""Ids of the meters for which a gateway may speak."""
LEADER = "plant"
ANYBODY = "*"  # stands for every gateway; no gateway has this name
OLDEST_INTERVALS = 5  # after which a reading is left out, unless the rule of its kind says otherwise
OVERDUE_INTERVALS = 2  # after which it is overdue
SCAN_SHARE = 1 / 4  # of the time between two scans: wait for readings; no two clocks may be farther apart
LEAST_LEAD_S = 1.0  # by which a reading may be ahead of its receiver's clock, or ``SCAN_SHARE``, if that is more


@dataclass(frozen=True, slots=True)
class KindRule:
    """The rule for the readings of one kind of meter, s, p.u. and rad."""

    period_s: Seconds | None = None
    """Interval of these meters; None: they read at every scan, and their readings do not age."""
    aging_s: Seconds | None = None
    """Age at which the variance has doubled, only with a period; None: the period."""
    oldest_s: Seconds | None = None
    """Age beyond which readings are left out; None: ``OLDEST_INTERVALS`` periods or scans, whichever is longer."""
    lowest: float | None = None
    """Readings below are out of range."""
    highest: float | None = None
    """Readings above are out of range."""

    def interval_s(self, scan_s: float | None) -> float:
        """Time between two readings that are used, s: the period, or ``scan_s`` if longer; 0 where neither is known."""
        return max(self.period_s or 0.0, scan_s or 0.0)

    def leaves_out_s(self, scan_s: float | None) -> float:
        """The age beyond which a reading is left out, s; infinity without ``oldest_s`` where no interval is known."""
        if self.oldest_s is not None:
            return self.oldest_s
        return OLDEST_INTERVALS * self.interval_s(scan_s) or math.inf

    def overdue_s(self, scan_s: float | None) -> float:
        """The age beyond which a reading is overdue, s; infinity where no interval is known.

        One reading may be lost, and the scan that uses the last reading lasts until the next scan.
        """
        return OVERDUE_INTERVALS * self.interval_s(scan_s) + (scan_s or 0.0) or math.inf

    def grown(self, sigma: float, age_s: float) -> float:
        """Standard deviation of a reading at ``age_s``: ``sigma sqrt(1 + age / aging)``; ``sigma`` without aging."""
        aging_s = self.aging_s or self.period_s
        return sigma * math.sqrt(1.0 + age_s / aging_s) if aging_s and age_s > 0 else sigma

    def holds(self, value: float) -> bool:
        """True where ``value`` lies in the range or at its ends."""
        return (self.lowest is None or value >= self.lowest) and (self.highest is None or value <= self.highest)


NO_RULE = KindRule()


def allowed_lead_s(scan_s: float | None) -> float:
    """Longest time by which a reading may be ahead of its receiver's clock, s; ``scan_s``: time between scans, s."""
    return max(LEAST_LEAD_S, SCAN_SHARE * (scan_s or 0.0))


AnyOrder = TypeVar("AnyOrder", bound=tuple[Any, ...])
"""Order of the readings of a meter: the time of measurement, s since 1970, then what orders readings of one time."""


def replaces(order: AnyOrder, known: AnyOrder, now: float, lead_s: float) -> bool:
    """True where a reading replaces the ``known`` one of its meter: of two readings the one measured later counts.

    A known reading that lies more than ``lead_s`` after ``now`` gives way to any: its receiver's clock was set back.
    """
    return order > known or known[0] > now + lead_s


@dataclass(frozen=True, slots=True)
class ReadingRules:
    """Rules for the readings of an area: the source of scan numbers, the gateways of its meters, the rules by kind.

    Args:
        ticks: "gateway": gateway ``leader`` numbers scans. "clock": a scan begins at each multiple of ``scan_s``, UTC.
        gateways: name -> its meters; the name ``ANYBODY`` stands for every gateway.
        kinds: kind of meter -> its rule; a kind that is not there has ``NO_RULE``.
    """

    ticks: Ticks = "gateway"
    leader: str = LEADER
    gateways: Mapping[str, MetersOf] = field(default_factory=lambda: {LEADER: "all"})
    kinds: Mapping[MeasurementKind, KindRule] = field(default_factory=dict)

    def rule_of(self, kind: MeasurementKind) -> KindRule:
        """The rule for readings of ``kind``."""
        return self.kinds.get(kind, NO_RULE)

    def meters_of(self, gateway: str) -> MetersOf:
        """The meters for which ``gateway`` may speak; of a gateway without entry those of ``ANYBODY``, else none."""
        return self.gateways.get(gateway, self.gateways.get(ANYBODY, ()))

    @property
    def follow_clocks(self) -> bool:
        """True where the rules depend on the time of day: scans begin by the clock, or readings have a period."""
        return self.ticks == "clock" or any(rule.period_s for rule in self.kinds.values())


DEFAULT_RULES = ReadingRules()
