"""pandapower's measurement table as readings: injections are positive into the network, flows into the branch.

pandapower counts power at a bus as consumption, currents in kA and angles in degrees. Where closed switches fuse
buses, the powers measured at them add up; that is their injection only if all of them are measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.limits import LARGEST_SIGMA
from dsse_core.printable import listed
from scenarios.importers.imported import NO_INFORMATION, Remark, combine_readings, sum_readings

KIND = MeasurementKind
AT_BUS = {"v": KIND.VM, "va": KIND.VA, "p": KIND.P_INJECTION, "q": KIND.Q_INJECTION}
ON_BRANCH = {"p": KIND.P_FLOW, "q": KIND.Q_FLOW, "i": KIND.CURRENT}
SIDES = {"line": ("from", "to"), "trafo": ("hv", "lv")}
FEEDING = ("load", "sgen", "gen", "ext_grid", "motor", "storage", "ward")


@dataclass(frozen=True)
class Conversion:
    """The network as pandapower converted it, and the names of its elements here.

    ``network`` has loads of constant power: the voltage dependence of a load does not matter where it is measured.
    ``sgen``: the static generators, which are out of service in ``net``.

    ``bus_of``: index of a supplied bus -> its bus id here; ``branch_of``: (element type, index) -> branch id;
    ``unloaded``: a metered branch with an open end, as (element type, index) -> the bus of its own at that end.
    ``loops``: the branches that are now shunts, since closed switches join their two ends.
    """

    net: Any
    sgen: Any
    network: Network
    bus_of: dict[int, int]
    branch_of: dict[tuple[str, int], str]
    unloaded: dict[tuple[str, int], int]
    loops: frozenset[tuple[str, int]]


def find_metered_branches(net: Any) -> set[tuple[str, int]]:
    """The lines and transformers that have a measurement, as (element type, index)."""
    table = net.measurement[net.measurement.element_type.isin(SIDES)]
    return {(kind, int(index)) for kind, index in zip(table.element_type, table.element, strict=True)}


def read_measurements(what: str, conversion: Conversion) -> tuple[tuple[Measurement, ...], list[Remark]]:
    """The readings of a converted network, one for each meter, and remarks on the other measurements.

    Raises:
        InvalidInputError: listing every measurement that no meter here can read.
    """
    problems: list[str] = []
    left_out: dict[str, list[int]] = {}
    readings: list[Measurement] = []
    powers: dict[tuple[KIND, int], list[Measurement]] = {}
    for index, row in conversion.net.measurement.iterrows():
        if reason := _find_reason_to_leave_out(conversion, row):
            left_out.setdefault(reason, []).append(index)
        elif not (math.isfinite(row.value) and row.std_dev > 0):
            text = f"value {row.value}, std_dev {row.std_dev}; a finite value and a positive std_dev are expected"
            problems.append(f"measurement {index}: {text}")
        elif isinstance(found := _read(conversion, row), str):
            problems.append(f"measurement {index}: {found}")
        elif found.sigma > LARGEST_SIGMA:
            left_out.setdefault(NO_INFORMATION, []).append(index)
        elif found.meter.kind.of_injection:
            powers.setdefault((found.meter.kind, int(row.element)), []).append(found)
        else:
            readings.append(found)
    sums, sum_problems = _sum_at_fused_buses(conversion, powers)
    if problems or sum_problems:
        raise InvalidInputError(what, [*problems, *sum_problems])
    combined, remarks = combine_readings([*readings, *sums])
    more = [Remark("left out", f"measurement {listed(which)}: {reason}") for reason, which in left_out.items()]
    return combined, [*remarks, *more]


def _find_reason_to_leave_out(conversion: Conversion, row: Any) -> str:
    """The reason for which a measurement contains nothing about the grid; empty if it does contain something."""
    if any(number is None or math.isnan(number) for number in (row.value, row.std_dev)):
        return "without a value or a std_dev"
    element = (row.element_type, row.element if row.element_type == "bus" else int(row.element))
    if element in conversion.loops:
        return "of a branch whose two ends closed switches join"
    is_live = row.element in conversion.bus_of if row.element_type == "bus" else element in conversion.branch_of
    if not is_live and row.element_type in ("bus", *SIDES):
        return "of an element that is out of service or unsupplied"
    return ""


def _read(conversion: Conversion, row: Any) -> Measurement | str:
    """The measurement in p.u. and rad, of the fused bus; a reason as text where no meter here can read it."""
    network, base = conversion.network, conversion.network.base_mva
    if row.element_type == "bus" and (kind := AT_BUS.get(row.measurement_type)):
        meter = Meter(kind, conversion.bus_of[int(row.element)])
        size = {KIND.VM: 1.0, KIND.VA: math.radians(1)}.get(kind, -1 / base)
        return Measurement(meter, row.value * size, row.std_dev * abs(size))
    if row.element_type not in SIDES or (kind := ON_BRANCH.get(row.measurement_type)) is None:
        return f"{row.measurement_type!r} of a {row.element_type} is no kind of meter here"
    element = (row.element_type, int(row.element))
    table, sides = conversion.net[row.element_type], SIDES[row.element_type]
    ends = [int(table.at[row.element, f"{side}_bus"]) for side in sides]
    if row.side not in (*sides, *ends):
        return f"its side is {row.side!r}; a {row.element_type} has {' and '.join(sides)}"
    at = sides.index(row.side) if row.side in sides else ends.index(row.side)
    branch = network.branch(conversion.branch_of[element])
    bus = (branch.from_bus, branch.to_bus)[at]
    size = math.sqrt(3) * network.bus(bus).base_kv / base if kind is KIND.CURRENT else 1 / base
    return Measurement(Meter(kind, bus, branch.id), row.value * size, row.std_dev * size)


def _sum_at_fused_buses(
    conversion: Conversion, powers: dict[tuple[KIND, int], list[Measurement]]
) -> tuple[list[Measurement], list[str]]:
    """The injections of buses here from the powers measured at pandapower's: their sum where several were fused."""
    fed = _find_fed_members(conversion)
    measured: dict[Meter, dict[int, Measurement]] = {}
    for (_, element), of_element in powers.items():
        (mean,), _ = combine_readings(of_element)
        measured.setdefault(mean.meter, {})[element] = mean
    sums, problems = [], []
    for meter, of_buses in measured.items():
        missing = fed.get(meter.bus, set()) - of_buses.keys()
        if missing:
            joined = listed(sorted({meter.bus, *of_buses, *missing}))
            problems.append(
                f"measurements of {meter.id}: closed switches join bus {joined}, but bus {listed(sorted(missing))}, "
                "where something feeds or consumes, is not measured; measure it, or take the measurements out"
            )
        sums.append(sum_readings(meter, [(m.value, m.sigma) for m in of_buses.values()]))
    return sums, problems


def _find_fed_members(conversion: Conversion) -> dict[int, set[int]]:
    """Bus -> the pandapower buses that became it and where something feeds or consumes."""
    fed: dict[int, set[int]] = {}
    for name in FEEDING:
        table = conversion.sgen if name == "sgen" else conversion.net[name]
        for bus in table.bus[table.in_service]:
            if bus in conversion.bus_of:
                fed.setdefault(conversion.bus_of[bus], set()).add(int(bus))
    return fed
