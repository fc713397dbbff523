"""The units of a gateway's map: the kinds of meter of each, and its size in p.u. or rad."""

from __future__ import annotations

from collections.abc import Mapping

from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Network
from scenarios.files.readings.units import RANGES, UNITS, unit_size

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
"""Unit -> the unit of readings files that it is a part or a multiple of. Voltages are line to line."""


def units_of(kind: MeasurementKind) -> tuple[str, ...]:
    """The units that a meter of ``kind`` may be given in."""
    found = tuple(unit for unit, (basic, _) in WRITTEN_AS.items() if kind in UNITS[basic])
    return (*found, RADIAN) if kind is MeasurementKind.VA else found


def size_of(unit: str, meter: Meter, network: Network) -> float:
    """Size of one ``unit`` of ``meter``, p.u. or rad."""
    if unit == RADIAN:
        return 1.0
    basic, times = WRITTEN_AS[unit]
    return times * unit_size(basic, meter, network)


def physical_range(meter: Meter, network: Network) -> tuple[float, float]:
    """The least and the largest value that a meter of this kind can read, p.u. or rad."""
    limits, size = RANGES[meter.kind]
    of_one = network.base_mva if size is None else size
    return limits.least / of_one, limits.most / of_one
