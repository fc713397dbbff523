"""Gateways that are wrong as a whole, found over several scans from all other data of the area."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from agents.protocol.readings import Readings
from dsse_core.exchange.area_estimation import FAILURES
from dsse_core.exchange.gateway_mistakes import MISTAKES, THRESHOLD, GatewayTest, add_up
from dsse_core.grid.partition import Area
from dsse_core.grid.switches import keep_in_service
from dsse_core.linear.boundary_information import BoundaryInformation


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Evidence on a gateway. ``sums``: factor of a mistake -> that of scans; ``times``: power meter that counts -> when
    it was read.
    """

    sums: Mapping[float, float] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)


class GatewayWatch:
    """Watch on the gateways of an area. ``mistaken``: gateway -> likely mistake in all its power readings, in words."""

    def __init__(self, area: Area) -> None:
        self.mistaken: Mapping[str, str] = {}
        self._area, self._test = area, GatewayTest(area)
        self._found: Mapping[str, _Evidence] = {}
        self._before: Mapping[str, _Evidence] = {}  # this scan
        self._scan = 0

    def weigh(
        self,
        scan: int,
        area: Area,
        readings: Readings,
        known: tuple[np.ndarray, Mapping[str, BoundaryInformation]] | None,
        *,
        is_fed: bool = True,
    ) -> None:
        """Counts the evidence of ``scan``, of which an end replaces the end before; ``area``: with its switches as in
        that end. Evidence by other statuses of switches counts no more, and none unless all of the area ``is_fed``:
        without supply powers are noise, and it was the same by wrong statuses if they were known late.

        ``known``: state of the area and information of its neighbours. A gateway counts again when all its powers have
        been measured again: evidence of one reading counts once.
        """
        if area is not self._area or not is_fed:
            self._found = self._before = {}
        if area is not self._area:
            self._area, self._test = area, GatewayTest(area)
        if scan != self._scan:
            self._scan, self._before = scan, self._found
        powers = {m.meter.id for m in readings.measurements if m.meter.kind.of_power}
        found = {}
        for gateway, meters in readings.senders.items():
            times = {meter: readings.ages.times[meter] for meter in meters if meter in powers}
            before = self._before.get(gateway, _Evidence())
            counts = is_fed and times and not times.items() & before.times.items()
            found[gateway] = self._add(before, readings, times, known) if counts else before
        self._found = found
        likeliest = {gateway: max(e.sums, key=e.sums.__getitem__) for gateway, e in found.items() if e.sums}
        self.mistaken = {
            gateway: MISTAKES[factor]
            for gateway, factor in likeliest.items()
            if found[gateway].sums[factor] > THRESHOLD
        }

    def _add(
        self,
        before: _Evidence,
        readings: Readings,
        times: Mapping[str, float],
        known: tuple[np.ndarray, Mapping[str, BoundaryInformation]] | None,
    ) -> _Evidence:
        x, received = known or (None, {})
        in_use = keep_in_service(self._area.network, readings.measurements)
        try:
            found = self._test.weigh(in_use, times, x, received)
        except FAILURES:  # absurd readings, which other checks note
            found = {}
        return _Evidence(
            {factor: add_up(before.sums.get(factor, 0.0), found.get(factor, 0.0)) for factor in MISTAKES}, times
        )
