"""Gateways that are wrong as a whole, found over several scans from all other data of the area."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agents.protocol.readings import Readings
from dsse_core.exchange.area_estimation import FAILURES
from dsse_core.exchange.gateway_mistakes import MISTAKES, THRESHOLD, GatewayTest, add_up
from dsse_core.grid.partition import Area
from dsse_core.grid.switches import keep_in_service
from dsse_core.linear.boundary_information import BoundaryInformation


class GatewayWatch:
    """Watch on the gateways of an area. ``mistaken``: gateway -> likely mistake in all its power readings, in words."""

    def __init__(self, area: Area) -> None:
        self.mistaken: Mapping[str, str] = {}
        self._area, self._test = area, GatewayTest(area)
        self._sums: dict[str, dict[float, float]] = {}  # gateway -> factor of a mistake -> evidence of scans
        self._times: dict[str, Mapping[str, float]] = {}  # gateway -> when the powers that count last were measured
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
        """Counts the evidence of ``scan`` once; ``area``: with its switches as in that scan. Evidence by other statuses
        of switches counts no more, and none counts unless all of the area ``is_fed``: without supply powers are noise.

        ``known``: state of the area and information of its neighbours. A gateway counts again when all its powers have
        been measured again: evidence of one reading counts once.
        """
        if area is not self._area:
            self._area, self._test = area, GatewayTest(area)
            self._sums, self._times, self.mistaken = {}, {}, {}
        if scan == self._scan:
            return
        self._scan = scan
        powers = {m.meter.id for m in readings.measurements if m.meter.kind.of_power}
        for gateway in self._sums.keys() - readings.senders.keys():
            del self._sums[gateway], self._times[gateway]
        for gateway, meters in readings.senders.items():
            times = {meter: readings.ages.times[meter] for meter in meters if meter in powers}
            if is_fed and times and not times.items() & self._times.get(gateway, {}).items():
                self._times[gateway] = times
                self._count(gateway, readings, times, known)
        likeliest = {gateway: max(sums, key=sums.__getitem__) for gateway, sums in self._sums.items()}
        self.mistaken = {
            gateway: MISTAKES[factor]
            for gateway, factor in likeliest.items()
            if self._sums[gateway][factor] > THRESHOLD
        }

    def _count(
        self,
        gateway: str,
        readings: Readings,
        meters: Mapping[str, float],
        known: tuple[np.ndarray, Mapping[str, BoundaryInformation]] | None,
    ) -> None:
        x, received = known or (None, {})
        in_use = keep_in_service(self._area.network, readings.measurements)
        try:
            found = self._test.weigh(in_use, meters, x, received)
        except FAILURES:  # absurd readings, which other checks note
            found = {}
        former = self._sums.get(gateway, {})
        self._sums[gateway] = {factor: add_up(former.get(factor, 0.0), found.get(factor, 0.0)) for factor in MISTAKES}
