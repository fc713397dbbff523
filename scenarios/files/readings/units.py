"""The units of readings files: quantities for each unit, its size in p.u. or rad, and limits of the readings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.physical_ranges import ANGLE, POWER, REACTIVE_POWER, VOLTAGE, Range
from dsse_core.grid.quantities import Quantity

_CURRENTS = (Quantity.CURRENT, Quantity.I_REAL, Quantity.I_IMAG)
UNITS: Mapping[str, frozenset[Quantity]] = {
    "pu": frozenset(set(Quantity) - {Quantity.VA}),
    "kv": frozenset({Quantity.VM}),
    "v": frozenset({Quantity.VM}),
    "deg": frozenset({Quantity.VA}),
    "mw": frozenset({Quantity.P}),
    "mvar": frozenset({Quantity.Q}),
    "kw": frozenset({Quantity.P}),
    "kvar": frozenset({Quantity.Q}),
    "a": frozenset(_CURRENTS),
}
"""Unit -> the quantities that may be given in it. Voltages in V and kV are line to line; of a phase to ground."""
WRITTEN_IN = {
    Quantity.VM: "pu",
    Quantity.VA: "deg",
    Quantity.P: "mw",
    Quantity.Q: "mvar",
    **dict.fromkeys(_CURRENTS, "a"),
}


def unit_size(unit: str, meter: Meter, network: Network) -> float:
    """Size of one ``unit`` in p.u. or rad; ampere, V and kV on the base voltage of the meter's bus."""
    return float(sizes_of(unit, [meter], network)[0])


def sizes_of(unit: str, meters: Sequence[Meter], network: Network) -> np.ndarray:
    """``unit_size`` of each of ``meters``, which fit the network, (n,)."""
    table = network.table
    base_kv: np.ndarray = table.base_kv[table.rows.find(read_column(meters, "bus", np.int64))]
    to_ground = base_kv if table.nodes.is_balanced else base_kv / math.sqrt(3)
    sizes = np.ones(len(meters))
    match unit:
        case "mw" | "mvar":
            sizes = 1 / power_bases(meters, network)
        case "kw" | "kvar":
            sizes = 1 / (1000 * power_bases(meters, network))
        case "deg":
            sizes *= math.radians(1)
        case "kv":
            sizes = 1 / to_ground
        case "v":
            sizes = 1 / (1000 * to_ground)
        case "a":
            sizes = math.sqrt(3) * base_kv / network.base_mva / 1000
    return sizes


def power_bases(meters: Sequence[Meter], network: Network) -> np.ndarray:
    """Size of 1 p.u. of power of each of ``meters``, MVA, (n,): with phases a third, of a total one for each phase."""
    if network.table.nodes.is_balanced:  # a row of a file is read in a fraction of the time
        return np.full(len(meters), network.node_mva)
    return network.node_mva * tabulate_meters(network, meters).n_phases


def size_of_range(meter: Meter, network: Network) -> float:
    """Size of 1 p.u. or rad of ``meter``, which fits the network, in the unit of its limits in RANGES."""
    _, size = RANGES[meter.kind.quantity]
    return float(power_bases([meter], network)[0]) if size is None else size


_AT_BASE = "MVA at the base voltage"
RANGES: Mapping[Quantity, tuple[Range, float | None]] = {
    Quantity.VM: (Range(0.0, VOLTAGE.most, VOLTAGE.unit), 1.0),  # a dead voltmeter reads 0
    Quantity.VA: (ANGLE, math.degrees(1)),
    Quantity.CURRENT: (Range(0.0, POWER.most, _AT_BASE), None),
    Quantity.I_REAL: (Range(POWER.least, POWER.most, _AT_BASE), None),
    Quantity.I_IMAG: (Range(POWER.least, POWER.most, _AT_BASE), None),
    Quantity.P: (POWER, None),
    Quantity.Q: (REACTIVE_POWER, None),
}
"""Limits of readings in a unit, and the size of one p.u. or rad in that unit; None: a power base in MVA."""
