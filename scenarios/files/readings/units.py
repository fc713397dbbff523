"""The units of readings files: kinds of meter for each unit, its size in p.u. or rad, and limits of the readings."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.grid.physical_ranges import ANGLE, POWER, REACTIVE_POWER, VOLTAGE, Range

KIND = MeasurementKind
UNITS: Mapping[str, frozenset[MeasurementKind]] = {
    "pu": frozenset(kind for kind in KIND if kind is not KIND.VA),
    "kv": frozenset({KIND.VM}),
    "v": frozenset({KIND.VM}),
    "deg": frozenset({KIND.VA}),
    "mw": frozenset({KIND.P_INJECTION, KIND.P_FLOW}),
    "mvar": frozenset({KIND.Q_INJECTION, KIND.Q_FLOW}),
    "kw": frozenset({KIND.P_INJECTION, KIND.P_FLOW}),
    "kvar": frozenset({KIND.Q_INJECTION, KIND.Q_FLOW}),
    "a": frozenset({KIND.CURRENT}),
}
"""Unit -> the kinds of meter that may be given in it. Voltages in V and kV are line to line."""
WRITTEN_IN = {KIND.VM: "pu", KIND.VA: "deg", KIND.CURRENT: "a"} | {
    kind: "mw" if kind in UNITS["mw"] else "mvar" for kind in UNITS["mw"] | UNITS["mvar"]
}


def unit_size(unit: str, meter: Meter, network: Network) -> float:
    """Size of one ``unit`` in p.u. or rad; ampere, V and kV on the base voltage of the meter's bus."""
    return float(sizes_of(unit, np.array(network.bus(meter.bus).base_kv), network.base_mva))


def sizes_of(unit: str, base_kv: np.ndarray, base_mva: float) -> np.ndarray | float:
    """``unit_size`` of meters at buses with ``base_kv`` (n,)."""
    match unit:
        case "mw" | "mvar":
            return 1 / base_mva
        case "kw" | "kvar":
            return 1 / (1000 * base_mva)
        case "deg":
            return math.radians(1)
        case "kv":
            return 1 / base_kv
        case "v":
            return 1 / (1000 * base_kv)
        case "a":
            return math.sqrt(3) * base_kv / base_mva / 1000
        case _:
            return 1.0


RANGES: Mapping[MeasurementKind, tuple[Range, float | None]] = {
    KIND.VM: (Range(0.0, VOLTAGE.most, VOLTAGE.unit), 1.0),  # a dead voltmeter reads 0
    KIND.VA: (ANGLE, math.degrees(1)),
    KIND.CURRENT: (Range(0.0, POWER.most, "MVA at the base voltage"), None),
    KIND.P_INJECTION: (POWER, None),
    KIND.P_FLOW: (POWER, None),
    KIND.Q_INJECTION: (REACTIVE_POWER, None),
    KIND.Q_FLOW: (REACTIVE_POWER, None),
}
"""Kind -> limits of its readings in a unit, and the size of one p.u. or rad in that unit; None: as ``base_mva``."""
