"""Points: the meter behind an address of a source, its unit, and the conversion of raw values to p.u. or rad."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from coordinator.field.gateway.counts import BAD_TYPE, NOT_FINITE
from coordinator.field.gateway.maps.map_tables import ReadingTable
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.grid.switches import READ_AS, STATUS, name_status_meter
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.readings.units import RANGES, UNITS, size_of_range, unit_size
from scenarios.meters import SigmaRule
from scenarios.scenario import Scenario

RADIAN = "rad"
WRITTEN_AS: Mapping[str, tuple[str, float]] = {
    "pu": ("pu", 1.0),
    "kV": ("kv", 1.0),
    "V": ("kv", 1e-3),
    "MW": ("mw", 1.0),
    "kW": ("mw", 1e-3),
    "W": ("mw", 1e-6),
    "Mvar": ("mvar", 1.0),
    "kvar": ("mvar", 1e-3),
    "var": ("mvar", 1e-6),
    "kA": ("a", 1e3),
    "A": ("a", 1.0),
    "deg": ("deg", 1.0),
}
"""Unit -> the unit of readings files that it is a part or a multiple of; voltages as there."""


def units_of(kind: MeasurementKind) -> tuple[str, ...]:
    """The units that a meter of ``kind`` may be given in."""
    found = tuple(unit for unit, (basic, _) in WRITTEN_AS.items() if kind.quantity in UNITS[basic])
    return (*found, RADIAN) if "deg" in found else found


def size_of(unit: str, meter: Meter, network: Network) -> float:
    """Size of one ``unit`` of ``meter``, p.u. or rad."""
    if unit == RADIAN:
        return 1.0
    basic, times = WRITTEN_AS[unit]
    return times * unit_size(basic, meter, network)


def physical_range(meter: Meter, network: Network) -> tuple[float, float]:
    """The least and the largest value that a meter of this kind can read, p.u. or rad."""
    limits, _ = RANGES[meter.kind.quantity]
    of_one = size_of_range(meter, network)
    return limits.least / of_one, limits.most / of_one


@dataclass(frozen=True, slots=True)
class Deviation:
    """Standard deviation of a reading, p.u. or rad: ``relative`` to its size, at least ``least``."""

    relative: float
    least: float

    def of(self, value: float) -> float:
        return max(self.relative * abs(value), self.least)


@dataclass(frozen=True, slots=True)
class SwitchStatus:
    """The status of ``switch``, in the place of a meter: it reads 0 open, 1 closed, anything else unknown."""

    switch: str

    @property
    def id(self) -> str:
        """The id of the readings."""
        return name_status_meter(self.switch)


@dataclass(frozen=True, slots=True)
class Point:
    """The ``meter`` of ``area`` at ``address``. It reads ``sign (factor raw + offset)`` in ``unit``.
    ``size``: one ``unit`` in p.u. or rad. ``lowest``, ``highest``: p.u. or rad; a value beyond them is no reading.
    """

    address: str
    meter: Meter | SwitchStatus
    area: str
    unit: str
    size: float
    factor: float
    offset: float
    deviation: Deviation
    lowest: float
    highest: float

    def number_of(self, raw: object) -> float | str:
        """``raw`` as a finite number, see ``number_of``; a status may be a word, or yes and no."""
        if isinstance(self.meter, SwitchStatus):
            raw = READ_AS.get(raw.strip().lower(), raw) if isinstance(raw, str) else raw
            raw = float(raw) if isinstance(raw, bool) else raw
        return number_of(raw)

    def value_of(self, raw: float) -> float:
        """The reading of a raw value, p.u. or rad."""
        return (self.factor * raw + self.offset) * self.size

    def is_in_range(self, value: float) -> bool:
        """True where the meter can read ``value``, p.u. or rad."""
        return self.lowest <= value <= self.highest


def make_point(table: ReadingTable, meter: Meter | SwitchStatus, area: str, scenario: Scenario) -> Point:
    """The point of a ``[[reading]]`` without problems; one without a sigma gets that of the scenario."""
    if isinstance(meter, SwitchStatus):
        factors = table.sign * table.factor, table.sign * table.offset
        return Point(table.address, meter, area, table.unit, 1.0, *factors, Deviation(0.0, 0.0), -math.inf, math.inf)
    size = size_of(table.unit, meter, scenario.network)
    lowest, highest = physical_range(meter, scenario.network)
    allowed = scenario.reading_rules[area].rule_of(meter.kind)
    lowest = lowest if allowed.lowest is None else max(lowest, allowed.lowest)
    highest = highest if allowed.highest is None else min(highest, allowed.highest)
    if table.lowest is not None:
        lowest = max(lowest, table.lowest * size)
    if table.highest is not None:
        highest = min(highest, table.highest * size)
    return Point(
        address=table.address,
        meter=meter,
        area=area,
        unit=table.unit,
        size=size,
        factor=table.sign * table.factor,
        offset=table.sign * table.offset,
        deviation=_deviation_of(table, meter, size, scenario.sigma_rule),
        lowest=lowest,
        highest=highest,
    )


def find_point_problems(
    table: ReadingTable, wrong: frozenset[str], meter: Meter | SwitchStatus, network: Network, rule: SigmaRule
) -> Iterator[str]:
    """The problems of a ``[[reading]]`` with its meter, as texts; the values of its ``wrong`` keys are not known."""
    if isinstance(meter, SwitchStatus):
        if "unit" not in wrong and table.unit != STATUS:
            yield f"unit is {table.unit}; {meter.id} is the status of a switch: give unit = 'status'"
        for key in ("sigma", "sigma_percent", "lowest", "highest"):
            if getattr(table, key) is not None:
                yield f"{key} is of no use to {meter.id}, the status of a switch; remove it"
        return
    if "unit" in wrong:
        return
    allowed = units_of(meter.kind)
    if table.unit not in allowed:
        yield f"unit is {table.unit}; meter {meter.id} reads {' or '.join(allowed)}"
        return
    size = size_of(table.unit, meter, network)
    lowest, highest = (limit / size for limit in physical_range(meter, network))
    for key in ("lowest", "highest"):
        limit = getattr(table, key)
        if limit is not None and not lowest <= limit <= highest:
            yield f"{key} is {limit:g} {table.unit}; meter {meter.id} reads {lowest:g} to {highest:g} {table.unit}"
    if "sigma" in wrong:
        return
    if table.sigma is None and not rule.relative.keys() | rule.absolute.keys() >= {meter.kind}:
        yield f"sigma is missing, and the scenario states none for {meter.kind}; give it in {table.unit}"
    elif not SMALLEST_SIGMA <= (least := _deviation_of(table, meter, size, rule).least) <= LARGEST_SIGMA:
        yield (
            f"the least sigma is {least / size:g} {table.unit}, {least:.3g} in p.u. or rad; it must lie between "
            f"{SMALLEST_SIGMA:g} and {LARGEST_SIGMA:g}; give a sigma in {table.unit}"
        )


def _deviation_of(table: ReadingTable, meter: Meter, size: float, rule: SigmaRule) -> Deviation:
    if table.sigma is not None:
        return Deviation((table.sigma_percent or 0.0) / 100, table.sigma * size)
    if meter.kind in rule.absolute:
        return Deviation(0.0, rule.absolute[meter.kind])
    return Deviation(rule.relative.get(meter.kind, 0.0), rule.floor)


def number_of(raw: object) -> float | str:
    """``raw`` as a finite number; otherwise the reason under which it is counted as rejected."""
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        return BAD_TYPE
    try:
        value = float(raw)
    except OverflowError:
        return NOT_FINITE
    return value if math.isfinite(value) else NOT_FINITE
