"""The intake: keeps the newest reading of each meter, and counts rejected readings by reason."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from coordinator.field.gateway import counts as reasons
from coordinator.field.gateway.counts import Counts
from coordinator.field.gateway.maps.points import Point, number_of
from dsse_core.printable import printable, shortened
from dsse_core.reading_rules import replaces

EARLIEST_S = 946_684_800.0  # 2000-01-01; a device without a clock counts from 1970


@dataclass(frozen=True, slots=True)
class Reading:
    """A reading of a meter: ``value`` and ``sigma`` in p.u. or rad, ``time`` in s since 1970 UTC."""

    value: float
    sigma: float
    time: float
    valid: bool


@dataclass
class Intake:
    """Receiver of a source's readings; keeps for each meter the reading with the newest measurement time.

    ``newest``: area -> meter id -> reading; ``waiting``: area -> ids of meters whose reading is not published yet.
    ``ahead_s``: largest lead of a measurement time over ``clock``, s; ``clock`` is in s since 1970 UTC.
    """

    points: Mapping[str, Point]
    clock: Callable[[], float]
    ahead_s: float = 1.0
    counts: Counts = field(default_factory=Counts)
    on_reading: Callable[[str], None] = lambda _: None
    newest: dict[str, dict[str, Reading]] = field(default_factory=dict)
    waiting: dict[str, set[str]] = field(default_factory=dict)

    def __call__(
        self, address: str, value: object, time: float | None = None, *, valid: bool = True, unit: str | None = None
    ) -> None:
        """See ``Emit``."""
        self.counts.received += 1
        point = self.points.get(address)
        if point is None:
            self._reject(reasons.UNKNOWN, address, "is in no [[reading]] of the map")
            return
        number = point.number_of(value)
        if isinstance(number, str):
            self._reject(number, address, f"{_shown(value)} is no finite number")
            return
        if unit is not None and unit != point.unit:
            self._reject(reasons.WRONG_UNIT, address, f"in {_shown(unit)}, the map says {point.unit}")
            return
        read = point.value_of(number)
        if not point.is_in_range(read):
            shown = f"{read / point.size:g} {point.unit}; meter {point.meter.id} reads "
            limits = f"{point.lowest / point.size:g} to {point.highest / point.size:g} {point.unit}"
            self._reject(reasons.OUT_OF_RANGE, address, shown + limits)
            return
        now = self.clock()
        at = now if time is None else self._time_of(address, time, now)
        if at is not None:
            self._take(point, Reading(read, point.deviation.of(read), at, valid), now, is_stated=time is not None)

    def reject(self, reason: str, detail: str) -> None:
        """See ``Emit``."""
        self.counts.reject(reason, "", printable(detail))

    def take_waiting(self, area: str) -> int:
        """Number of readings of ``area`` published now for the first time; they count as used and wait no longer."""
        count = len(self.waiting.pop(area, ()))
        self.counts.used += count
        return count

    def _time_of(self, address: str, time: object, now: float) -> float | None:
        """The measurement time that the source states, s since 1970 UTC; None where it is rejected."""
        at = number_of(time)
        if isinstance(at, str) or at < EARLIEST_S:
            self._reject(reasons.BAD_TIME, address, f"time {_shown(time)} is no number of seconds since 1970 UTC")
            return None
        if at > now + self.ahead_s:
            self._reject(reasons.AHEAD, address, f"{at - now:.1f} s ahead of the clock of this host")
            return None
        return at

    def _take(self, point: Point, reading: Reading, now: float, is_stated: bool) -> None:
        of_area = self.newest.setdefault(point.area, {})
        last = of_area.get(point.meter.id)
        if last == reading:
            self.counts.superseded += 1  # the same reading again
            return
        order = reading.time, not is_stated  # of two readings of one time by the clock of this host the later counts
        if last is not None and not replaces(order, (last.time, False), now, self.ahead_s):
            if reading.time < last.time:
                age = f"{last.time - reading.time:.3g} s older than the last"
                self._reject(reasons.OLDER, point.address, age)
            else:
                self._reject(reasons.TWICE, point.address, "has another value of the same time, which is kept")
            return
        waiting = self.waiting.setdefault(point.area, set())
        self.counts.superseded += point.meter.id in waiting
        self.counts.invalid += not reading.valid
        waiting.add(point.meter.id)
        of_area[point.meter.id] = reading
        self.on_reading(point.area)

    def _reject(self, reason: str, address: str, detail: str) -> None:
        name = printable(shortened(address, reasons.LONGEST_DETAIL))
        self.counts.reject(reason, name, f"address {name}: {detail}")


def _shown(value: object) -> str:
    return shortened(f"{value!r:.80}" if not isinstance(value, int) else "a number", 80)
