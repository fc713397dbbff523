"""Random grids of every kind that the estimators know: loops in areas, transformers, shunts, all kinds of meters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from feeders import Feeder, load_to, read_with_noise

from dsse_core.grid.biconnected import find_blocks
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.generate.cutting import cut_into

KIND = MeasurementKind


@dataclass(frozen=True)
class MeterShares:
    """Of buses and branches, which share has a meter of that kind."""

    voltage: float = 0.1
    angle: float = 0.0
    flow: float = 0.6
    current: float = 0.0
    injection: float = 1.0
    boundary_injection: float = 1.0


def make_grid(
    seed: int,
    n_bus: int,
    n_area: int,
    chain: float,
    decades: float,
    loops: int,
    transformers: float,
    short: float | None,
    slack_at_root: bool,
    shares: MeterShares,
) -> Feeder:
    """A grid of ``n_bus`` buses in at most ``n_area`` areas.

    ``chain``: 0 a star, 1 a chain. ``decades``: over which impedances and sigmas are spread. ``transformers``: share
    of branches. ``short``: impedance of one branch, p.u. One bus in four injects exactly nothing.
    """
    rng = np.random.default_rng(seed)
    network = _draw_network(rng, n_bus, chain, decades, loops, transformers, short, slack_at_root)
    partition = build_partition(network, cut_into(network, max(1, min(n_area, len(find_blocks(network))))))
    flow = solve_power_flow(network)
    meters = _draw_meters(rng, network, set(partition.boundaries), shares)
    largest = abs(flow.injection).max()
    return Feeder(network, partition, tuple(read_with_noise(rng, m, flow, largest, decades) for m in meters))


def _draw_network(
    rng: np.random.Generator,
    n: int,
    chain: float,
    decades: float,
    loops: int,
    transformers: float,
    short: float | None,
    slack_at_root: bool,
) -> Network:
    upstream = [0, *(k - 1 if rng.random() < chain else int(rng.integers(k)) for k in range(1, n))]
    z = 0.01 * 10 ** rng.uniform(-decades, 0, n)
    if short is not None:
        z[rng.integers(1, n)] = short
    transformer = rng.random(n) < transformers
    branches = []
    for k in range(1, n):
        ends = (upstream[k] + 1, k + 1) if rng.random() < 0.7 else (k + 1, upstream[k] + 1)
        tap, shift = 1.0, 0.0
        if transformer[k]:
            tap, shift = float(rng.uniform(0.95, 1.05)), float(np.radians(rng.choice([-30, 30, 0, 150])))
        b = 0.0 if transformer[k] else 0.001
        branches.append(Branch(f"{ends[0]}-{ends[1]}", *ends, r=z[k] * 0.7, x=z[k], b=b, tap=tap, shift=shift))
    for k in rng.permutation(np.arange(1, n))[:loops]:
        grandparent = upstream[upstream[k]]
        if grandparent not in (k, upstream[k]) and not (transformer[k] or transformer[upstream[k]]):
            branches.append(Branch(f"loop{k}", grandparent + 1, int(k) + 1, r=0.007, x=0.01, b=0.001))
    zero = rng.random(n) < 0.25
    shunt = np.where(rng.random(n) < 0.15, rng.uniform(0, 0.01, n), 0.0)
    p = np.where(zero, 0.0, rng.lognormal(0, 0.5, n))
    buses = tuple(Bus(k + 1, 20.0, p[k], 0.4 * p[k], g_shunt=shunt[k] / 10, b_shunt=shunt[k]) for k in range(n))
    slack = 1 if slack_at_root else int(rng.integers(1, n + 1))
    generators = (Generator(slack, Control.SLACK, va=float(rng.choice([0, 0.3]))),)
    return load_to(Network("grid", 1.0, buses, tuple(branches), generators), float(rng.choice([0.9, 0.94, 0.98])))


def _draw_meters(rng: np.random.Generator, network: Network, boundary: set[int], shares: MeterShares) -> list[Meter]:
    slack = network.slack.bus
    meters = [Meter(KIND.VM, slack)]
    for bus in network.buses:
        if bus.id != slack and rng.random() < shares.voltage:
            meters.append(Meter(KIND.VM, bus.id))
        if rng.random() < shares.angle:
            meters.append(Meter(KIND.VA, bus.id))
        exact = bus.p_load == 0 and bus.id != slack
        source = Source.VIRTUAL if exact else Source.TELEMETERED
        if exact or rng.random() < (shares.boundary_injection if bus.id in boundary else shares.injection):
            meters += [Meter(kind, bus.id, source=source) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    for branch in network.branches:
        end = branch.from_bus if rng.random() < 0.5 else branch.to_bus
        if rng.random() < shares.flow:
            meters += [Meter(kind, end, branch.id) for kind in (KIND.P_FLOW, KIND.Q_FLOW)]
        if rng.random() < shares.current:
            meters.append(Meter(KIND.CURRENT, end, branch.id))
    return meters


def with_gross_errors(rng: np.random.Generator, feeder: Feeder) -> Feeder:
    """One to three errors of 8 to 50 sigma, often at boundary buses."""
    measurements = list(feeder.measurements)
    real = [k for k, m in enumerate(measurements) if m.meter.source is not Source.VIRTUAL]
    boundary = [k for k in real if measurements[k].meter.bus in feeder.partition.boundaries]
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.choice(boundary if boundary and rng.random() < 0.4 else real))
        m = measurements[k]
        measurements[k] = replace(m, value=m.value + float(rng.choice([-1, 1]) * rng.uniform(8, 50)) * m.sigma)
    return replace(feeder, measurements=tuple(measurements))
