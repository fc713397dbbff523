"""Random feeders of mixed phases, with legs between phases, banks and regulators, their areas and readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.primitives import Side, build_centre_tapped, build_line
from tests.support.phases import DELTA, KIND, WYE, bank, coupled_line, meter_injections, solve

SOURCE = 650
LATERALS = {"abc": ("abc", "abc", "abc", "ab", "bc", "ac", "a", "b", "c"), "ab": ("ab", "a", "b")} | {
    "bc": ("bc", "b", "c"), "ac": ("ac", "a", "c"), "a": ("a",), "b": ("b",), "c": ("c",)
}  # fmt: skip
LEGS = {"abc": ("ab", "bc", "ac"), "ab": ("ab",), "bc": ("bc",), "ac": ("ac",)}
NEW_AREA = 0.3  # share of branches with which another area begins


def make_random_feeder(rng: np.random.Generator) -> tuple[Network, dict[str, list[int]]]:
    """A tree of 6 to 18 buses below a source, and the buses of its areas."""
    phases, area = {SOURCE: "abc"}, {SOURCE: "area0"}
    areas: dict[str, list[int]] = {"area0": [SOURCE]}
    branches: list[Branch] = []
    for bus in range(1, int(rng.integers(6, 19))):
        above = int(rng.choice([*phases]))
        phases[bus] = str(rng.choice(LATERALS[phases[above]]))
        branches.append(_draw_branch(rng, (above, bus), phases[bus]))
        area[bus] = area[above]
        if rng.random() < NEW_AREA and len(areas[area[above]]) > 1:
            area[bus] = f"area{len(areas)}"
            areas[area[bus]] = [above]
        areas[area[bus]].append(bus)
    loads = [load for bus in phases if bus != SOURCE for load in _draw_loads(rng, bus, phases[bus])]
    buses = tuple(Bus(bus, 4.16, phases=of_bus) for bus, of_bus in phases.items())
    return Network("random", 5.0, buses, tuple(branches), (Generator(SOURCE, Control.SLACK),), tuple(loads)), areas


def _draw_branch(rng: np.random.Generator, ends: tuple[int, int], phases: str) -> Branch:
    name, kind = f"{ends[0]}-{ends[1]}", rng.random()
    if phases == "abc" and kind < 0.15:
        return bank(name, ends, DELTA)
    if phases == "abc" and kind < 0.3:
        return bank(name, ends, WYE, tuple(rng.uniform(0.98, 1.04, 3)))
    return coupled_line(name, ends, phases, float(rng.uniform(0.05, 0.4)))


def _draw_loads(rng: np.random.Generator, bus: int, phases: str) -> list[Load]:
    """Legs to ground, or between phases, or none."""
    kind = rng.random()
    legs = [*LEGS.get(phases, ())] if kind < 0.35 else list_phases(phases) if kind < 0.8 else []
    return [Load(bus, leg, complex(*rng.uniform(0.01, 0.06, 2))) for leg in legs if rng.random() < 0.8]


def make_large_feeder(rng: np.random.Generator, n_lateral: int) -> Network:
    """A trunk of three phases with a lateral of one phase at each bus, whose houses have centre-tapped transformers.

    18 nodes for each lateral; a regulator stands half-way.
    """
    phases, branches, loads = {SOURCE: "abc"}, list[Branch](), list[Load]()

    def add(above: int, of_bus: str, join: Callable[[str, tuple[int, int]], Branch]) -> int:
        bus = SOURCE + len(phases)
        phases[bus] = of_bus
        branches.append(join(f"{above}-{bus}", (above, bus)))
        return bus

    def hang(phase: str) -> Callable[[str, tuple[int, int]], Branch]:
        kva, halves = float(rng.choice([10, 15, 25, 50])), Side("s1s2", ("s1", "s2"), (1.0,))
        unit = build_centre_tapped(Side(phase, (phase,), (1.0,)), halves, (0.012 + 0.02j) * 5000 / 3 / kva)
        return lambda name, ends: Branch(name, *ends, r=1.0, x=1.0, primitive=unit)

    def drop(name: str, ends: tuple[int, int]) -> Branch:
        z = np.array([[1.0 + 0.7j, 0.4 + 0.5j], [0.4 + 0.5j, 1.0 + 0.7j]]) * rng.uniform(0.3, 1.5)
        return Branch(name, *ends, r=1.0, x=1.0, primitive=build_line("s1s2", z))

    at = SOURCE
    for k in range(n_lateral):
        line = partial(coupled_line, phases="abc", length=float(rng.uniform(0.005, 0.03)))
        at = add(at, "abc", partial(bank, high=WYE, taps=(1.02, 1.0, 1.03)) if k == n_lateral // 2 else line)
        phase, pole = str(rng.choice(list("abc"))), at
        for _ in range(3):
            pole = add(pole, phase, partial(coupled_line, phases=phase, length=float(rng.uniform(0.02, 0.1))))
            house = add(add(pole, "s1s2", hang(phase)), "s1s2", drop)
            loads += [Load(house, half, complex(*rng.uniform(2e-4, 2e-3, 2))) for half in ("s1", "s2")]
    buses = tuple(Bus(bus, 12.47 if "s" not in of_bus else 0.208, phases=of_bus) for bus, of_bus in phases.items())
    return Network("large", 5.0, buses, tuple(branches), (Generator(SOURCE, Control.SLACK),), tuple(loads))


def read_random_meters(rng: np.random.Generator, network: Network, decades: float) -> list[Measurement]:
    """Noisy readings of injections, of the source, and of a share of all flows, totals, voltages and currents."""
    meters = [meter for bus in network.buses if bus.id != SOURCE for meter in meter_injections(network, bus)]
    meters += [Meter(KIND.VM, SOURCE, phases=p) for p in "abc"]
    for branch in network.branches:
        assert branch.primitive is not None
        ends = ((branch.from_bus, branch.primitive.from_phases), (branch.to_bus, branch.primitive.to_phases))
        bus, phases = ends[int(rng.integers(2))]
        kinds = [(KIND.P_FLOW, KIND.Q_FLOW), (KIND.CURRENT,)][int(rng.random() < 0.3)]
        if rng.random() < 0.4:
            names = list_phases(phases) if kinds[0] is KIND.CURRENT or rng.random() < 0.7 else [""]
            meters += [Meter(kind, bus, branch.id, phases=p) for p in names for kind in kinds]
    for bus in network.buses[1:]:
        if rng.random() < 0.4:
            names = LEGS.get(bus.phases, ()) if rng.random() < 0.3 else list_phases(bus.phases)
            meters += [Meter(KIND.VM, bus.id, phases=p) for p in names]
    z = build_measurement_model(network, build_admittance(network), meters).predict(solve(network))
    is_real = np.array([meter.source is not Source.VIRTUAL for meter in meters])
    sigma = np.where(is_real, 1e-4 * 10 ** rng.uniform(0, decades, len(z)), 0.0)
    z = np.where(is_real, z + sigma * rng.standard_normal(len(z)), 0.0)
    return [Measurement(m, *of) for m, *of in zip(meters, z.tolist(), sigma.tolist(), strict=True)]


def make_wrong(rng: np.random.Generator, readings: list[Measurement]) -> list[Measurement]:
    """``readings`` with one that is 15 to 40 standard deviations off."""
    real = [k for k, m in enumerate(readings) if m.sigma > 0]
    k = int(rng.choice(real))
    off = readings[k].sigma * rng.uniform(15, 40) * rng.choice([-1, 1])
    wrong = replace(readings[k], value=readings[k].value + float(off))
    return [*readings[:k], wrong, *readings[k + 1 :]]
