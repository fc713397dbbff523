"""The readings that areas have used in their current scan, the reference of a verdict on that scan.

Only the areas know them where readings age, or clocks number scans: they may differ from the plant's newest.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from agents.messages.packing import ReadingsMessage, StateMessage
from coordinator.watch.observe.switches import find_statuses
from dsse_core.grid.columns import take_items
from dsse_core.grid.measurement import Measurement, Source
from dsse_core.grid.meter_table import list_ids, read_meters_of
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry


class UsedReadings:
    """The newest readings that each area has published; not needed where readings do not age."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._is_needed = scenario.renew_s is not None
        self._meters = {meter.id: meter for meter in scenario.meters} if self._is_needed else {}
        self._virtual = [meter for meter in self._meters.values() if meter.source is Source.VIRTUAL]
        self._newest: dict[str, ReadingsMessage] = {}
        self.operated_at = 0.0  # when a switch, or the status that is read of it, last changed, s since 1970

    def take(self, message: ReadingsMessage) -> None:
        """Keep the readings that an area has published, if they are newer than its last."""
        known = self._newest.get(message.header.sender)
        if self._is_needed and (known is None or message.header.order > known.header.order):
            self._newest[message.header.sender] = message

    def find_missing(self, states: Mapping[str, StateMessage]) -> Iterator[str]:
        """Sentences on areas whose readings for the scan in ``states`` are missing for a verdict."""
        for name, state in sorted(states.items()) if self._is_needed else ():
            used = self._newest.get(name)
            if used is None or (used.header.incarnation, used.header.scan, used.taken_at) != (
                state.header.incarnation,
                state.header.scan,
                state.taken_at,
            ):
                yield f"which readings {name} has used in scan {state.header.scan} is not known yet"
            elif max(used.times, default=math.inf) < self.operated_at:
                yield f"{name} has used no reading since a switch was operated"

    def put_into(self, telemetry: Telemetry, states: Mapping[str, StateMessage]) -> Telemetry:
        """``telemetry`` with the readings used in ``states``; if readings do not age, without meters that are off, or
        that stand at a switch that is open.
        """
        if not self._is_needed:
            off = {meter_id for state in states.values() for meter_id in state.meters_off}
            return _without(telemetry, off | self._find_left_out(states))
        by_area = {area.name: self._readings_of(area.name) for area in self._scenario.partition.areas}
        virtual = tuple(Measurement(meter, 0.0, 0.0) for meter in self._virtual)
        union = tuple(m for part in by_area.values() for m in part)
        used = replace(telemetry, by_area=by_area, union=(*union, *virtual))
        return _without(used, self._find_left_out(states))

    def _find_left_out(self, states: Mapping[str, StateMessage]) -> set[str]:
        """Ids of the meters at switches that are open in ``states``."""
        operated = self._scenario.operated(find_statuses(self._scenario.partition, states))
        if operated is self._scenario:
            return set()
        return {*list_ids(self._scenario.meters)} - {*list_ids(operated.meters)}

    def _readings_of(self, area: str) -> tuple[Measurement, ...]:
        used = self._newest.get(area)
        if used is None:
            return ()
        columns = zip(used.meters, used.values, used.sigmas, strict=True)
        return tuple(Measurement(self._meters[k], value, sigma) for k, value, sigma in columns if k in self._meters)


def _without(telemetry: Telemetry, off: Collection[str]) -> Telemetry:
    """``telemetry`` without the readings of meters that are ``off``."""
    if not off:
        return telemetry
    by_area = {name: _take_on(part, off) for name, part in telemetry.by_area.items()}
    return replace(telemetry, by_area=by_area, union=_take_on(telemetry.union, off))


def _take_on(readings: Sequence[Measurement], off: Collection[str]) -> Sequence[Measurement]:
    ids = list_ids(read_meters_of(readings))
    return take_items(readings, np.flatnonzero([meter_id not in off for meter_id in ids]))
