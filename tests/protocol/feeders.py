"""Random radial feeders, cut into random trees of areas, with random meters: small worlds for property tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from agents.area_files.area_file import AreaFile
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.partition import Partition
from dsse_core.link_faults import LinkFaults
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow

KIND = MeasurementKind
LOWEST_VM = 0.94


@dataclass(frozen=True)
class Feeder:
    network: Network
    partition: Partition
    measurements: tuple[Measurement, ...]

    def telemetry(self) -> dict[str, list[Measurement]]:
        area_of = {m.meter.id: self.partition.area_of_meter(m.meter) for m in self.measurements}
        return {a.name: [m for m in self.measurements if area_of[m.meter.id] == a.name] for a in self.partition.areas}

    def area_files(self, loss: float, seed: int, **faults: float) -> list[AreaFile]:
        telemetry = self.telemetry()
        return [
            AreaFile(
                run="sim",
                area=area,
                meters=tuple(m.meter for m in telemetry[area.name]),
                strategy="information",
                endpoints=("tcp/127.0.0.1:7447",),
                links={n.area: LinkFaults(loss=loss, **faults) for n in area.neighbours},
                seed=seed,
            )
            for area in self.partition.areas
        ]


def make_feeder(
    seed: int, n_bus: int, n_area: int, shape: float = 0.5, decades: float = 1.0, dense: float = 0.5
) -> Feeder:
    """A feeder of ``n_bus`` buses in about ``n_area`` areas.

    ``shape``: 0 a star, 1 a chain. ``decades``: over which impedances and sigmas are spread. ``dense``: share of
    voltmeters and flow meters that exist. Injections are measured everywhere, exactly zero at one bus in five.
    """
    rng = np.random.default_rng([seed, n_bus, n_area])
    upstream = [0] + [k - 1 if rng.random() < shape else int(rng.integers(k)) for k in range(1, n_bus)]
    network = load_to(_draw_network(rng, upstream, decades), LOWEST_VM)
    partition = build_partition(network, _draw_areas(rng, upstream, n_area))
    return Feeder(network, partition, _draw_measurements(rng, network, decades, dense))


def make_star(seed: int, n_area: int = 15, *, busbar: bool = False) -> Feeder:
    """A feeder whose areas all meet at bus 2, but for the substation's own; or all of them at its ``busbar``, bus 1."""
    rng = np.random.default_rng(seed)
    centre = 0 if busbar else 1
    upstream = [0, *([] if busbar else [0]), *[centre] * n_area]
    upstream += [int(rng.integers(centre + 1, len(upstream) + k)) for k in range(20)]
    network = load_to(_draw_network(rng, upstream, 1.0), LOWEST_VM)
    areas: dict[str, list[int]] = {} if busbar else {"a1": [1, 2]}
    area_of: dict[int, int] = {}
    for k in range(centre + 1, len(upstream)):
        area_of[k] = k + 1 if upstream[k] == centre else area_of[upstream[k]]
        areas.setdefault(f"a{area_of[k]}", [centre + 1]).append(k + 1)
    return Feeder(network, build_partition(network, areas), _draw_measurements(rng, network, 1.0, 0.5))


def _draw_network(rng: np.random.Generator, upstream: list[int], decades: float) -> Network:
    n = len(upstream)
    z = 0.01 * 10 ** rng.uniform(-decades, 0.0, n)
    transformer = rng.random(n) < 0.1
    branches = tuple(
        Branch(
            f"{upstream[k] + 1}-{k + 1}",
            upstream[k] + 1,
            k + 1,
            r=z[k] * 0.7,
            x=z[k],
            b=0.0 if transformer[k] else 0.001,
            tap=float(rng.uniform(0.95, 1.05)) if transformer[k] else 1.0,
            shift=np.radians(-30.0) if transformer[k] else 0.0,
        )
        for k in range(1, n)
    )
    zero = rng.random(n) < 0.2
    buses = tuple(
        Bus(k + 1, 20.0, p_load=0.0 if zero[k] else p, q_load=0.0 if zero[k] else 0.4 * p)
        for k, p in enumerate(rng.lognormal(0.0, 0.5, n))
    )
    return Network("feeder", 1.0, buses, branches, (Generator(1, Control.SLACK),))


def load_to(network: Network, lowest: float) -> Network:
    """Scale all loads until the largest voltage drop against the unloaded feeder is ``1 - lowest``.

    Without a load beyond the slack bus nothing drops, and nothing is scaled.
    """
    if not any(b.p_load for b in network.buses if b.id != network.slack.bus):
        return network

    def scaled(factor: float) -> Network:
        buses = tuple(replace(b, p_load=b.p_load * factor, q_load=b.q_load * factor) for b in network.buses)
        return replace(network, buses=buses)

    unloaded = solve_power_flow(scaled(0.0)).vm
    factor = 1e-6
    for _ in range(40):
        drop = float((1 - solve_power_flow(scaled(factor)).vm / unloaded).max())
        if abs(drop - (1 - lowest)) < 0.002:
            break
        factor *= min(10.0, (1 - lowest) / max(drop, 1e-9)) ** 0.9
    return scaled(factor)


def _draw_areas(rng: np.random.Generator, upstream: list[int], n_area: int) -> dict[str, list[int]]:
    """Cut at random buses: the branches below a cut, one or all of them, become areas of their own."""
    n = len(upstream)
    heads = {1} | {int(k) for k in rng.choice(np.arange(1, n), size=min(n_area - 1, n - 1), replace=False)}
    area_of = [0] * n  # of the branch into bus k
    names = {1: 1}
    for k in range(1, n):
        area_of[k] = k if k in heads else (area_of[upstream[k]] or 1)
        names.setdefault(area_of[k], len(names) + 1)
    areas: dict[str, list[int]] = {}
    for k in range(1, n):
        buses = areas.setdefault(f"a{names[area_of[k]]}", [])
        buses += [bus for bus in (upstream[k] + 1, k + 1) if bus not in buses]
    return areas


def _draw_measurements(
    rng: np.random.Generator, network: Network, decades: float, dense: float
) -> tuple[Measurement, ...]:
    flow = solve_power_flow(network)
    sources = {g.bus for g in network.generators}
    zero = {b.id for b in network.buses if b.p_load == 0 and b.id not in sources}
    meters = [Meter(KIND.VM, 1)] + [Meter(KIND.VM, b.id) for b in network.buses[1:] if rng.random() < dense * 0.2]
    for branch in network.branches:
        if rng.random() < dense:
            end = branch.from_bus if rng.random() < 0.5 else branch.to_bus
            meters += [Meter(k, end, branch.id) for k in (KIND.P_FLOW, KIND.Q_FLOW)]
    for bus in network.buses:
        source = Source.VIRTUAL if bus.id in zero else Source.TELEMETERED
        meters += [Meter(k, bus.id, source=source) for k in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    largest = abs(flow.injection).max()
    return tuple(read_with_noise(rng, meter, flow, largest, decades) for meter in meters)


def read_with_noise(
    rng: np.random.Generator, meter: Meter, flow: PowerFlowResult, largest: float, decades: float
) -> Measurement:
    """0.2 % of voltages, 0.001 rad, 1 % of flows, 10 % of injections, up to ``decades`` better."""
    if meter.source is Source.VIRTUAL:
        return Measurement(meter, 0.0, 0.0)
    value = flow.read(meter)
    sigma = {KIND.VM: 0.002, KIND.VA: 0.001}.get(meter.kind)
    if sigma is None:
        sigma = (0.01 if meter.branch else 0.1) * (abs(value) + 0.01 * largest)
    sigma *= 10 ** rng.uniform(-decades, 0.0)
    return Measurement(meter, value + sigma * rng.standard_normal(), sigma)
