"""Made-up radial medium-voltage feeders of any size, with typical values; docs/how-to/generate.md lists them.

The same arguments give the same network, to the last digit: lengths are whole metres, loads whole watts and vars.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow

BASE_KV = 20.0
BASE_MVA = 10.0
SUBSTATION_VM = 1.02
HIGHEST_LOWEST_VM = 1.0  # above it there is hardly a load
LOWEST_LOWEST_VM = 0.85  # below it the nose of the voltage curve is near
VM_TOLERANCE = 1e-4
MAX_POWER_FLOWS = 20
FREQUENCY_HZ = 50.0

BUSES_OF_A_FEEDER = 2000  # more buses make more feeders, which leave one busbar
TRUNK_KM = (15.0, 25.0)
LENGTH_SPREAD = 0.8  # lognormal, in units of the median
SHORTEST, LONGEST = 0.1, 8.0
TRUNK_SHARE = 0.5  # of the laterals start at the trunk as long as there is room, the others at laterals
BUSES_OF_A_LATERAL = 4  # on average, geometric
ROOM_AT_A_TRUNK_BUS, ROOM_AT_A_LATERAL_BUS = 2, 1  # laterals that may start there
ZERO_INJECTION_SHARE = 0.15
LOAD_SPREAD = 0.8  # lognormal
POWER_FACTORS = (0.90, 0.98)
PV_SHARE = 0.3  # of the load, all PV generators together


@dataclass(frozen=True, slots=True)
class LineType:
    """Per km: ohm, ohm and nF at 50 Hz; ``name`` is that of pandapower's standard type, which the values are from."""

    name: str
    r: float
    x: float
    c: float


TRUNK_TYPES = (
    LineType("NA2XS2Y 1x240 RM/25 12/20 kV", 0.122, 0.112, 304.0),
    LineType("149-AL1/24-ST1A 20.0", 0.194, 0.337, 10.5),
)
LATERAL_TYPES = (
    LineType("94-AL1/15-ST1A 20.0", 0.306, 0.350, 10.0),
    LineType("70-AL1/11-ST1A 20.0", 0.4132, 0.36, 9.7),
)
SUBLATERAL_TYPES = (
    LineType("48-AL1/8-ST1A 20.0", 0.5939, 0.372, 9.5),
    LineType("34-AL1/6-ST1A 20.0", 0.8342, 0.382, 9.15),
)


@dataclass(frozen=True)
class Tree:
    """Shape of the network, shape (n_bus,): ``upstream`` row of each bus, ``level`` of the branch towards it.

    Row 0 is the substation, its own upstream. Level 0 is the trunk of a feeder, 1 a lateral, 2 and more those that
    start at laterals. ``feeder`` numbers the feeders from 0.
    """

    upstream: np.ndarray
    level: np.ndarray
    feeder: np.ndarray

    @property
    def heads(self) -> np.ndarray:
        """Rows of the buses at the far end of the first branch of every trunk and of every lateral of level 1."""
        starts = (self.level == 0) & (self.upstream == 0) | (self.level == 1) & (self.level[self.upstream] == 0)
        starts[0] = False
        return np.flatnonzero(starts)


def generate_feeder(
    n_bus: int, rng: np.random.Generator, *, lowest_vm: float = 0.94, n_pv: int = 0
) -> tuple[Network, Tree]:
    """A radial network of ``n_bus`` buses, bus k in row k - 1, fed at bus 1, loaded to ``lowest_vm`` (p.u.).

    Raises:
        InvalidInputError: fewer than two buses, more PV generators than buses with load, or a voltage out of range.
    """
    problems = []
    if n_bus < 2:
        problems.append(f"{n_bus} buses make no feeder; ask for 2 or more")
    if not LOWEST_LOWEST_VM <= lowest_vm <= HIGHEST_LOWEST_VM:
        problems.append(
            f"a lowest voltage of {lowest_vm} p.u. is out of range; "
            f"ask for {LOWEST_LOWEST_VM} to {HIGHEST_LOWEST_VM} p.u. (the substation holds {SUBSTATION_VM} p.u.)"
        )
    if problems:
        raise InvalidInputError("generated feeder", problems)
    tree = _grow_tree(rng, n_bus)
    branches = _draw_lines(rng, tree)
    load = _draw_loads(rng, n_bus)
    places = np.flatnonzero(load)
    if n_pv > len(places):
        problem = f"{n_pv} PV generators do not fit on {len(places)} buses with load; ask for fewer"
        raise InvalidInputError("generated feeder", [problem])
    pv = np.zeros(n_bus)
    if n_pv:
        share = rng.lognormal(0.0, 0.5, n_pv)
        pv[rng.choice(places, n_pv, replace=False)] = PV_SHARE * load.real.sum() * share / share.sum()
    factor = _find_factor(_build(branches, load, pv), tree, lowest_vm)
    return _build(branches, load * factor, pv * factor), tree


def _grow_tree(rng: np.random.Generator, n_bus: int) -> Tree:
    """A trunk of about 2 sqrt(n) buses for each feeder, then laterals at random buses until all buses are there."""
    upstream, level, feeder = [0], [0], [0]

    def grow(start: int, length: int, its_level: int, number: int) -> list[int]:
        """A row of ``length`` buses that leaves ``start``."""
        row = range(len(upstream), len(upstream) + length)
        upstream.extend([start, *row[:-1]])
        level.extend([its_level] * length)
        feeder.extend([number] * length)
        return list(row)

    n_feeder = -(-(n_bus - 1) // BUSES_OF_A_FEEDER)
    for number in range(n_feeder):
        left = (n_bus - 1) // n_feeder + (number < (n_bus - 1) % n_feeder)
        trunk = grow(0, min(left, max(1, round(2 * math.sqrt(left)))), 0, number)
        left -= len(trunk)
        on_trunk, on_laterals = trunk * ROOM_AT_A_TRUNK_BUS, list[int]()
        while left:
            to_trunk = not on_laterals or (bool(on_trunk) and rng.random() < TRUNK_SHARE)
            start = _take(rng, on_trunk if to_trunk else on_laterals)
            length = min(left, int(rng.geometric(1 / BUSES_OF_A_LATERAL)))
            on_laterals += grow(start, length, level[start] + 1, number) * ROOM_AT_A_LATERAL_BUS
            left -= length
    return Tree(np.array(upstream), np.array(level), np.array(feeder))


def _take(rng: np.random.Generator, places: list[int]) -> int:
    """Remove a random one of ``places``."""
    k = int(rng.integers(len(places)))
    places[k], places[-1] = places[-1], places[k]
    return places.pop()


def _draw_lines(rng: np.random.Generator, tree: Tree) -> tuple[Branch, ...]:
    """One line type for each trunk; lengths in whole metres, those of a feeder stretched together to its trunk's."""
    n_bus = len(tree.upstream)
    length = np.clip(rng.lognormal(0.0, LENGTH_SPREAD, n_bus), SHORTEST, LONGEST)
    trunk_length = np.bincount(tree.feeder[1:], np.where(tree.level == 0, length, 0.0)[1:])
    n_feeder = len(trunk_length)
    km = np.round(length * (rng.uniform(*TRUNK_KM, n_feeder) / trunk_length)[tree.feeder], 3)
    trunk_type = rng.integers(len(TRUNK_TYPES), size=n_feeder)
    lateral_type = rng.integers(2, size=n_bus)
    z_base = BASE_KV**2 / BASE_MVA
    branches = []
    for k in range(1, n_bus):
        line = (
            TRUNK_TYPES[trunk_type[tree.feeder[k]]],
            LATERAL_TYPES[lateral_type[k]],
            SUBLATERAL_TYPES[lateral_type[k]],
        )[min(int(tree.level[k]), 2)]
        b = 2 * math.pi * FREQUENCY_HZ * line.c * 1e-9 * km[k] * z_base
        ends = int(tree.upstream[k]) + 1, k + 1
        branches.append(
            Branch(f"{ends[0]}-{ends[1]}", *ends, float(km[k] * line.r / z_base), float(km[k] * line.x / z_base), b)
        )
    return tuple(branches)


def _draw_loads(rng: np.random.Generator, n_bus: int) -> np.ndarray:
    """Complex loads (n_bus,) up to a common factor; none at the substation and at the zero-injection buses."""
    p = rng.lognormal(0.0, LOAD_SPREAD, n_bus)
    p[rng.random(n_bus) < ZERO_INJECTION_SHARE] = 0.0
    p[0] = 0.0
    if not p.any():
        p[-1] = 1.0
    power_factor = rng.uniform(*POWER_FACTORS, n_bus)
    load: np.ndarray = p * (1 + 1j * np.tan(np.arccos(power_factor)))
    return load


def _build(branches: tuple[Branch, ...], load: np.ndarray, pv: np.ndarray) -> Network:
    """The network with ``load`` (complex, p.u.) and PV production ``pv`` (p.u.), rounded to 1 W and 1 var."""
    p, q, pv = (np.round(power * BASE_MVA, 6) / BASE_MVA for power in (load.real, load.imag, pv))
    buses = tuple(Bus(k + 1, BASE_KV, p_load=float(p[k]), q_load=float(q[k])) for k in range(len(load)))
    sources = [Generator(1, Control.SLACK, vm=SUBSTATION_VM)]
    sources += [Generator(int(k) + 1, Control.POWER, p=float(pv[k])) for k in np.flatnonzero(pv)]
    return Network(f"feeder{len(load)}", BASE_MVA, buses, branches, tuple(sources))


def _find_factor(network: Network, tree: Tree, lowest_vm: float) -> float:
    """Factor of loads and PV for ``lowest_vm``, to 6 digits: secant steps from the drop without losses.

    Raises:
        InvalidInputError: the power flow finds no such load.
    """
    s = {bus.id: network.scheduled_injection(bus.id) for bus in network.buses}
    factor = (SUBSTATION_VM - lowest_vm) / _drop_without_losses(network, tree)
    tried = [(0.0, SUBSTATION_VM)]
    for _ in range(MAX_POWER_FLOWS):
        extra = {bus: (1 - factor) * injection for bus, injection in s.items()}
        try:
            vm = float(solve_power_flow(network, extra_load=extra).vm.min())
        except PowerFlowDivergedError:
            factor = (factor + tried[-1][0]) / 2
            continue
        if abs(vm - lowest_vm) < VM_TOLERANCE / 2:
            return float(f"{factor:.6g}")
        tried.append((factor, vm))
        (f0, vm0), (f1, vm1) = tried[-2:]
        factor = f1 + (lowest_vm - vm1) * (f1 - f0) / (vm1 - vm0)
    problem = f"no load was found that brings the lowest voltage to {lowest_vm} p.u.; ask for a higher one"
    raise InvalidInputError("generated feeder", [problem])


def _drop_without_losses(network: Network, tree: Tree) -> float:
    """Largest drop of voltage, p.u.: the sum of (r p + x q) / vm over the branches on the way."""
    n_bus = len(network.buses)
    s = np.array([-network.scheduled_injection(bus.id) for bus in network.buses])
    for k in range(n_bus - 1, 0, -1):  # downstream buses have higher rows
        s[tree.upstream[k]] += s[k]
    drop = np.zeros(n_bus)
    for k, branch in enumerate(network.branches, 1):
        drop[k] = drop[tree.upstream[k]] + (branch.r * s[k].real + branch.x * s[k].imag) / SUBSTATION_VM
    return float(drop.max())
