"""The last readings of meters that read at intervals, as a gateway holds them between two readings of a meter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dsse_core.grid.measurement import Measurement, MeasurementKind
from dsse_core.reading_rules import KindRule

TimedReadings = tuple[dict[str, tuple[Measurement, ...]], dict[str, float]]
"""Area -> its readings, and meter id -> the time of its reading, s."""


class HeldReadings:
    """Keeps the readings of meters with an interval until the next ones are due.

    ``rules``: kind of meter -> its rule. Intervals begin at multiples of their length, as those of meters in the field.
    """

    def __init__(self, rules: Mapping[MeasurementKind, KindRule]) -> None:
        self._periods = {kind: rule.period_s for kind, rule in rules.items() if rule.period_s}
        self._interval: dict[MeasurementKind, int] = {}  # kind -> number of the interval of its last readings
        self._held: dict[str, dict[str, tuple[Measurement, float]]] = {}

    def take(self, by_area: Mapping[str, Sequence[Measurement]], now: float) -> TimedReadings:
        """Readings at ``now``, s: new ones from ``by_area`` of the meters that are due, the last ones of the others.

        A meter that is due and has no reading in ``by_area`` keeps its last one. A meter without an interval has a
        reading only when ``by_area`` has one.
        """
        interval = {kind: int(now // period_s) for kind, period_s in self._periods.items()}
        due = {kind for kind, number in interval.items() if self._interval.get(kind) != number}
        self._interval = interval
        for area, part in by_area.items():
            held = self._held.get(area, {})
            kept = {meter_id: pair for meter_id, pair in held.items() if pair[0].meter.kind in self._periods}
            fresh = {m.meter.id: m for m in part}
            kept |= {
                meter_id: (m, now)
                for meter_id, m in fresh.items()
                if m.meter.kind not in self._periods or m.meter.kind in due or meter_id not in kept
            }
            self._held[area] = kept
        readings = {area: tuple(m for m, _ in held.values()) for area, held in self._held.items()}
        return readings, {meter_id: at for held in self._held.values() for meter_id, (_, at) in held.items()}
