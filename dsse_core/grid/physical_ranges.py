"""Ranges of the numbers of a network: far beyond any grid, far below where arithmetic loses its digits.

They are checked for every network that comes from a file, of this or of another project.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsse_core.grid.columns import read_given
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import BALANCED, share_of_power
from dsse_core.limits import LARGEST_BUS


@dataclass(frozen=True, slots=True)
class Range:
    """From ``least`` to ``most``, in ``unit``."""

    least: float
    most: float
    unit: str

    def find_problem(self, of: str, value: float) -> Iterator[str]:
        """The problem, as text, that ``value`` of the quantity ``of`` lies outside; nothing where it lies inside."""
        if not self.least <= value <= self.most:
            unit = f" {self.unit}" if self.unit else ""
            yield f"{of} is {value:g}{unit}; it must lie between {self.least:g} and {self.most:g}{unit}; correct it"

    def holds(self, values: np.ndarray) -> bool:
        """True where all ``values`` lie inside."""
        return bool(((values >= self.least) & (values <= self.most)).all())


BASE_POWER = Range(1e-6, 1e6, "MVA")
BASE_VOLTAGE = Range(1e-3, 1e4, "kV")
POWER = Range(-1e6, 1e6, "MW")  # all of Europe takes half of it
REACTIVE_POWER = Range(-1e6, 1e6, "Mvar")
IMPEDANCE = Range(-1e9, 1e9, "p.u.")
ADMITTANCE = Range(-1e6, 1e6, "p.u.")
PORT_ADMITTANCE = Range(-1e9, 1e9, "p.u.")  # of a branch with phases: the inverse of an impedance is among them
LOAD_CURRENT = Range(0.0, 1e6, "A")  # of a leg, at the base voltage to ground; electrodes of furnaces carry a tenth
EXPONENT = Range(-10.0, 10.0, "")  # of a load's voltage
TAP = Range(1e-2, 1e2, "")
TAP_OF_WINDING = Range(0.5, 2.0, "times the nominal turns")
PERCENT = Range(0.0, 100.0, "%")  # of a bank: impedance, losses and current without load, of the rated ones
RATING = Range(1e-9, 1e9, "MVA")  # of a branch; other projects write 99999 kA for no limit
ANGLE = Range(-720.0, 720.0, "degrees")
VOLTAGE = Range(0.1, 10.0, "p.u.")


def find_range_problems(network: Network) -> Iterator[str]:
    """A problem for each number of ``network`` that no grid has, with the bus or branch, the value and the range."""
    yield from find_base_problems(network.base_mva, {})
    if _lie_within_ranges(network):
        return
    for bus in network.buses:
        yield from _of_bus(bus, network.base_mva * share_of_power(bus.phases))
    for branch in network.branches:
        yield from _of_branch(branch, network.base_mva)
    phases = {bus.id: bus.phases for bus in network.buses}
    for generator in network.generators:
        yield from _of_source(generator, network.base_mva * share_of_power(phases[generator.bus]))
    for load in network.loads:
        yield from _of_load(load, network.node_mva, network.bus(load.bus).base_kv)
    for shunt in network.shunts:
        at = f"shunt at bus {shunt.bus}, {shunt.phases}"
        yield from PORT_ADMITTANCE.find_problem(f"{at}: conductance", shunt.y.real)
        yield from PORT_ADMITTANCE.find_problem(f"{at}: susceptance", shunt.y.imag)


def find_base_problems(base_mva: float, base_kv: Mapping[int, float]) -> Iterator[str]:
    """A problem for each base, by which other numbers are divided, that no grid has; ``base_kv``: bus -> base, kV."""
    yield from BASE_POWER.find_problem("base_mva", base_mva)
    if not BASE_VOLTAGE.holds(np.array([*base_kv.values()])):
        for bus, kv in base_kv.items():
            yield from BASE_VOLTAGE.find_problem(f"bus {bus}: base voltage", kv)


def _lie_within_ranges(network: Network) -> bool:
    """True where all numbers of buses, branches, sources and loads are inside; no texts are made."""
    table, base, loads = network.table, network.base_mva, network.loads
    at_bus, of_branch = base * _find_shares(table.phases), base * _find_shares(table.branch_phases[0])
    sources = network.generators
    produced = np.array([complex(g.p, g.q) for g in sources]) * at_bus[[network.row[g.bus] for g in sources]]
    holding = [g for g in sources if g.control is not Control.POWER]
    drawn = np.array([load.s for load in loads], dtype=complex) * network.node_mva
    checked: list[tuple[Range, np.ndarray]] = [
        (BASE_VOLTAGE, table.base_kv),
        (TAP, table.tap),
        (ANGLE, np.degrees(table.shift)),
        (VOLTAGE, np.array([g.vm for g in holding])),
        (ANGLE, np.degrees(np.array([g.va for g in holding]))),
        (EXPONENT, np.array([load.exponents for load in loads])),
        (LOAD_CURRENT, _find_current(abs(drawn), table.base_kv[[network.row[load.bus] for load in loads]])),
    ]
    for power in (table.load * at_bus, table.shunt * at_bus, produced, drawn):
        checked += [(POWER, power.real), (REACTIVE_POWER, power.imag)]
    of_ports = (p.y.ravel() for p in table.primitives.values())
    ports = np.concatenate([np.array([shunt.y for shunt in network.shunts], dtype=complex), *of_ports])
    for limits, values in ((IMPEDANCE, table.series), (ADMITTANCE, table.charging), (PORT_ADMITTANCE, ports)):
        checked += [(limits, values.real), (limits, values.imag)]
    for key in ("i_max", "s_max"):
        given = zip(read_given(network.branches, key), of_branch.tolist(), strict=False)
        checked.append((RATING, np.array([rating * size for rating, size in given if rating is not None])))
    is_bus = (table.bus_id >= -LARGEST_BUS) & (table.bus_id <= LARGEST_BUS)
    return bool(is_bus.all()) and all(limits.holds(values) for limits, values in checked)


def _find_shares(phases: np.ndarray) -> np.ndarray:
    """``share_of_power`` of sets of phases."""
    return np.where(phases == BALANCED, 1.0, np.bitwise_count(phases) / 3)


def _of_bus(bus: Bus, base: float) -> Iterator[str]:
    of = f"bus {bus.id}"
    if not abs(bus.id) <= LARGEST_BUS:
        yield f"bus {str(bus.id)[:20]}...: a number of a bus lies within {LARGEST_BUS:g} of 0; give it another"
        return
    yield from BASE_VOLTAGE.find_problem(f"{of}: base voltage", bus.base_kv)
    yield from POWER.find_problem(f"{of}: active load", bus.p_load * base)
    yield from REACTIVE_POWER.find_problem(f"{of}: reactive load", bus.q_load * base)
    yield from POWER.find_problem(f"{of}: conductance of the shunt", bus.g_shunt * base)
    yield from REACTIVE_POWER.find_problem(f"{of}: susceptance of the shunt", bus.b_shunt * base)


def _of_branch(branch: Branch, base: float) -> Iterator[str]:
    of = f"branch {branch.id}"
    yield from IMPEDANCE.find_problem(f"{of}: r", branch.r)
    yield from IMPEDANCE.find_problem(f"{of}: x", branch.x)
    yield from ADMITTANCE.find_problem(f"{of}: b", branch.b)
    yield from ADMITTANCE.find_problem(f"{of}: g", branch.g)
    yield from TAP.find_problem(f"{of}: tap", branch.tap)
    yield from ANGLE.find_problem(f"{of}: phase shift", math.degrees(branch.shift))
    if branch.primitive is not None:
        for part in (np.real, np.imag):
            largest = max(part(branch.primitive.y).flat, key=abs, default=0.0)
            yield from PORT_ADMITTANCE.find_problem(f"{of}: admittance over its ports", float(largest))
        base *= share_of_power(branch.primitive.from_phases)
    for rating in (branch.i_max, branch.s_max):
        if rating is not None:
            yield from RATING.find_problem(f"{of}: rating", rating * base)


def _find_current(mva: Any, base_kv: Any) -> Any:
    """The current, A, of the apparent power ``mva`` at the base voltage to ground."""
    return 1000 * math.sqrt(3) * mva / base_kv


def _of_load(load: Load, base: float, base_kv: float) -> Iterator[str]:
    of = f"load at bus {load.bus}, {load.phases}"
    yield from POWER.find_problem(f"{of}: active power", load.s.real * base)
    yield from REACTIVE_POWER.find_problem(f"{of}: reactive power", load.s.imag * base)
    yield from LOAD_CURRENT.find_problem(f"{of}: current at {base_kv:g} kV", _find_current(abs(load.s) * base, base_kv))
    for exponent in load.exponents:
        yield from EXPONENT.find_problem(f"{of}: exponent", exponent)


def _of_source(generator: Generator, base: float) -> Iterator[str]:
    of = f"source at bus {generator.bus}"
    yield from POWER.find_problem(f"{of}: active power", generator.p * base)
    yield from REACTIVE_POWER.find_problem(f"{of}: reactive power", generator.q * base)
    if generator.control is not Control.POWER:
        yield from VOLTAGE.find_problem(f"{of}: voltage", generator.vm)
        yield from ANGLE.find_problem(f"{of}: angle", math.degrees(generator.va))
