"""The result of every importer, and the arithmetic that they share: readings combined, open ends folded away."""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, Literal

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.installation import install_command
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Branch, Bus, Control, Network
from dsse_core.grid.physical_ranges import RATING
from dsse_core.limits import LARGEST_SIGMA
from dsse_core.printable import listed
from scenarios.files.network_phases import find_nominal_across

ROUNDING = 1e-13  # share of the largest admittance of an element, below which a sum of some is 0
NO_INFORMATION = f"with a standard deviation above {LARGEST_SIGMA:g} p.u., infinite ones included, which says nothing"


@dataclass(frozen=True, slots=True)
class Remark:
    """A remark for readers of the source: the change, and its place."""

    what: Literal["fused", "changed", "left out", "note"]
    text: str


@dataclass(frozen=True)
class Places:
    """Places of made-up meters: buses with a voltage meter at each phase, branches with P and Q of each phase."""

    buses: tuple[int, ...]
    branches: tuple[str, ...]


@dataclass(frozen=True)
class Imported:
    """A network and the readings of its meters, as another project's file has them; p.u. and rad.

    ``converted``: kind of element -> how many. ``zero_injection``: as in a scenario file. ``substation``: bus of its
    voltage meter, the slack bus if None. ``places``: of made-up meters, of a network with phases. ``files``: texts of
    further files beside the network, by their names.
    """

    network: Network
    data_source: str
    converted: Mapping[str, int]
    remarks: tuple[Remark, ...] = ()
    readings: tuple[Measurement, ...] = ()
    zero_injection: Literal["virtual", "measured"] | tuple[int, ...] = "virtual"
    substation: int | None = None
    places: Places | None = None
    files: Mapping[str, str] = field(default_factory=dict)


def check_extra(module: str, extra: str, what: str) -> None:
    """Raises InvalidInputError where an optional package is not installed; does not import it."""
    if importlib.util.find_spec(module) is None:
        raise _lack(extra, f"no module {module}", what)


def load_extra(module: str, extra: str, what: str) -> ModuleType:
    """Import an optional package.

    Raises:
        InvalidInputError: it is not installed; says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise _lack(extra, str(error), what) from None


def _lack(extra: str, error: str, what: str) -> InvalidInputError:
    problem = f"reading it needs the package {extra} ({error}); install it: {install_command(extra)}"
    return InvalidInputError(what, [problem])


def rating(mva: float, base_mva: float) -> float | None:
    """A rating in p.u., None where the source has none: it writes 0, nan, or more than any branch may carry."""
    known = RATING.least <= mva <= RATING.most
    return mva / base_mva if known else None


def current_rating(ka: float, from_kv: float, to_kv: float, base_mva: float) -> dict[str, Any]:
    """``i_max`` of a branch that may carry ``ka`` at its from end; between two voltages ``s_max``, as a file has it."""
    return {"i_max" if from_kv == to_kv else "s_max": rating(math.sqrt(3.0) * from_kv * ka, base_mva)}


def combine_readings(readings: Iterable[Measurement]) -> tuple[tuple[Measurement, ...], tuple[Remark, ...]]:
    """One reading for each meter: several of one quantity become their weighted mean, which every WLS takes alike.

    The mean of readings with standard deviations sigma_k has the weights 1 / sigma_k^2 and the standard deviation
    ``1 / sqrt(sum 1 / sigma_k^2)``.
    """
    by_meter: dict[str, list[Measurement]] = {}
    for m in readings:
        by_meter.setdefault(m.meter.id, []).append(m)
    combined, remarks = [], []
    for meter_id, of_meter in by_meter.items():
        weights = [m.sigma**-2 for m in of_meter]
        mean = sum(w * m.value for w, m in zip(weights, of_meter, strict=True)) / sum(weights)
        combined.append(
            of_meter[0] if len(of_meter) == 1 else Measurement(of_meter[0].meter, mean, sum(weights) ** -0.5)
        )
        if len(of_meter) > 1:
            remarks.append(Remark("changed", f"{len(of_meter)} readings of {meter_id}: their weighted mean"))
    return tuple(combined), tuple(remarks)


def sum_readings(meter: Meter, readings: Sequence[tuple[float, float]]) -> Measurement:
    """The reading of a sum whose terms (value, sigma) are measured independently."""
    return Measurement(meter, sum(v for v, _ in readings), math.sqrt(sum(s**2 for _, s in readings)))


def loop_shunt(branch: Branch) -> complex:
    """Draw of a branch with both ends at one bus, as an admittance in p.u.: the sum of its four."""
    ends = (Bus(branch.from_bus, 1.0), Bus(branch.from_bus + 1, 1.0))
    apart = replace(branch, to_bus=branch.from_bus + 1, in_service=True)
    return complex(build_admittance(Network("loop", 1.0, ends, (apart,))).ybus.toarray().sum())


def open_end_shunt(branch: Branch, connected: int) -> complex:
    """Draw of a branch at bus ``connected`` with its other end open, as an admittance in p.u.

    With the open end eliminated: ``y = y_cc - y_co y_oc / y_oo``.
    """
    ends = (Bus(branch.from_bus, 1.0), Bus(branch.to_bus, 1.0))
    y = build_admittance(Network("open end", 1.0, ends, (replace(branch, in_service=True),))).ybus.toarray()
    c = 0 if branch.from_bus == connected else 1
    return complex(y[c, c] - y[c, 1 - c] * y[1 - c, c] / y[1 - c, 1 - c])


def add_shunts(bus: Bus, shunts: Iterable[complex]) -> Bus:
    """``bus`` with admittances added to its shunt."""
    total = sum(shunts, complex(0.0))
    return replace(bus, g_shunt=bus.g_shunt + total.real, b_shunt=bus.b_shunt + total.imag)


def find_places(network: Network, head: int, regulators: Sequence[Branch] = ()) -> Places:
    """Meters at the head, at ``regulators``, and at some ends of a feeder with phases."""
    there = {bus.id for bus in network.buses}
    slack = network.slack
    assert slack is not None
    first = head if head in there else slack.bus
    flows = [branch.id for branch in network.branches_at[slack.bus]] + [branch.id for branch in regulators]
    ends = [
        bus for bus, branches in network.branches_at.items() if len(branches) == 1 and bus not in (first, slack.bus)
    ]
    some = ends[:: max(1, len(ends) // max(2, len(network.buses) // 50))]
    buses = dict.fromkeys([first, *(branch.to_bus for branch in regulators), *some])
    return Places(tuple(buses), tuple(dict.fromkeys(flows)))


def list_shunt_legs(bus: int, phases: Sequence[str], y: np.ndarray) -> Iterator[Load]:
    """Legs of constant impedance that the shunt ``y`` between ``phases`` of a bus is, p.u."""
    small, to_ground, n = ROUNDING * abs(y).max(initial=0.0), y.sum(axis=1), len(y)
    ends = [(phases[k], "", to_ground[k]) for k in range(n)]
    ends += [(phases[k], phases[m], -y[k, m]) for k in range(n) for m in range(k + 1, n)]
    for one, other, of_leg in ends:
        if abs(of_leg) > small:
            s = complex(of_leg).conjugate() * find_nominal_across(one + other) ** 2
            yield Load(bus, one + other, s, (2.0, 2.0))


def leave_out_islands(network: Network) -> tuple[Network, list[Remark]]:
    """``network`` without the buses that no closed branch joins to its slack, and remarks on the parts left out.

    Raises:
        InvalidInputError: a source that holds a voltage stands in such an island, so that it may be meant to live.
    """
    assert network.slack is not None
    dead = set(network.find_unreached_buses(network.slack.bus))
    if not dead:
        return network, []
    holding = sorted({g.bus for g in network.generators if g.bus in dead and g.control is Control.VOLTAGE})
    if holding:
        problem = (
            f"no closed branch joins bus {listed(sorted(dead))} to the substation, bus {network.slack.bus}, but the "
            f"source at bus {listed(holding)} holds a voltage there; import each island by itself, or take it out"
        )
        raise InvalidInputError(f"network {network.name!r}", [problem])
    return without_buses(network, dead, "no closed branch joins them to the substation")


def without_buses(network: Network, gone: Collection[int], reason: str) -> tuple[Network, list[Remark]]:
    """``network`` without some buses and all that ends or stands there, and a remark that says so."""
    load = network.base_mva * sum(bus.p_load for bus in network.buses if bus.id in gone)
    load += network.node_mva * sum(load.s.real for load in network.loads if load.bus in gone)
    sources = sum(g.bus in gone for g in network.generators)
    branches = tuple(b for b in network.branches if b.from_bus not in gone and b.to_bus not in gone)
    text = (
        f"{'buses' if len(gone) > 1 else 'bus'} {listed(sorted(gone))} with {load:g} MW of load, {sources} sources and "
        f"{len(network.branches) - len(branches)} branches: {reason}"
    )
    rest = replace(
        network,
        buses=tuple(bus for bus in network.buses if bus.id not in gone),
        branches=branches,
        generators=tuple(g for g in network.generators if g.bus not in gone),
        loads=tuple(load for load in network.loads if load.bus not in gone),
        shunts=tuple(shunt for shunt in network.shunts if shunt.bus not in gone),
    )
    return rest, [Remark("left out", text)]


def fuse(buses: Iterable[int], joined: Iterable[tuple[int, int]]) -> dict[int, int]:
    """Bus -> the smallest bus that closed switches or links join it to, itself included."""
    root = {bus: bus for bus in buses}

    def find(bus: int) -> int:
        while root[bus] != bus:
            root[bus] = root[root[bus]]
            bus = root[bus]
        return bus

    for one, other in joined:
        a, b = sorted((find(one), find(other)))
        root[b] = a
    return {bus: find(bus) for bus in root}


def fused_remarks(representative: Mapping[int, int], by: str) -> list[Remark]:
    """One remark for each group of buses that became one."""
    groups: dict[int, list[int]] = {}
    for bus, root in representative.items():
        if bus != root:
            groups.setdefault(root, []).append(bus)
    return [Remark("fused", f"bus {listed(group)} into bus {root}, joined by {by}") for root, group in groups.items()]


def find_source_problems(
    sources: Sequence[tuple[str, int]], island_of: Mapping[int, int], how_to_split: str
) -> Iterator[str]:
    """Problems of a grid without exactly one substation; for several islands, how to make a grid of each.

    ``sources``: of those that hold voltage and angle, the name and the bus. ``island_of``: bus -> any mark of its
    island; a source at a bus without island is left out.
    """
    islands: dict[int, list[str]] = {}
    for name, bus in sources:
        if bus in island_of:
            islands.setdefault(island_of[bus], []).append(f"{name} at bus {bus}")
    if not islands:
        yield "no source in service holds voltage and angle; exactly one must, the substation"
    for names in islands.values():
        if len(names) > 1:
            yield f"{listed(names)} feed one island; exactly one of them may hold voltage and angle, the substation"
    if len(islands) > 1:
        yield f"{len(islands)} islands have a substation each; import them one by one: {how_to_split}"
        for mark, names in islands.items():
            buses = [bus for bus, of in island_of.items() if of == mark]
            yield f"the island of {listed(names)}: bus {listed(sorted(buses))}"
