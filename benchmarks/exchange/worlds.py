"""The grids of ``python -m benchmarks.exchange``, each with the readings of three scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.fault_histories.history import World, draw_meters, read_meters
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.partition import Partition
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.generate.cutting import cut_into
from scenarios.generate.feeder import generate_feeder
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

SCANS = 3
SHIPPED_AREAS = 3  # of ieee33
DRIFT = 0.1  # of every load from scan to scan, standard deviation
AREA_BRANCHES = 2  # of each area in a row
DROP = 0.05  # p.u., of the voltage along a row, without losses
EXACT = 1e-11  # step at which the centralised estimate stops, p.u. and rad


def draw_feeder(seed: int, areas: int | None = None) -> World:
    """A random feeder of 8 to 60 buses in 3 to 12 areas, or in ``areas`` areas."""
    rng = np.random.default_rng([14, seed])
    n_bus = int(rng.integers(8, 61))
    n_area = areas or int(rng.integers(3, min(13, n_bus // 2)))
    network, _ = generate_feeder(max(n_bus, 3 * n_area), rng, lowest_vm=float(rng.uniform(0.92, 0.98)))
    return _draw_scans(rng, network, build_partition(network, cut_into(network, n_area)))


def draw_row(n_area: int) -> World:
    """Areas of two branches in a row, with readings of which none is removed as bad data."""
    worlds = (_draw_row(n_area, seed) for seed in range(100))
    return next(world for world in worlds if not any(report.removed for report in world.central))


def _draw_row(n_area: int, seed: int) -> World:
    rng = np.random.default_rng([14, n_area, seed])
    network = _draw_row_of_buses(rng, AREA_BRANCHES * n_area + 1)
    areas = {f"area{k + 1}": list(range(AREA_BRANCHES * k + 1, AREA_BRANCHES * (k + 1) + 2)) for k in range(n_area)}
    return _draw_scans(rng, network, build_partition(network, areas))


def read_ieee33(areas: int = SHIPPED_AREAS) -> World:
    """The shipped scenario, in ``areas`` areas."""
    scenario = load_scenario("ieee33", changes={"areas": {"count": areas}} if areas != SHIPPED_AREAS else {})
    telemetry = [make_telemetry(scenario, scan) for scan in range(1, SCANS + 1)]
    central = [process_bad_data(scenario.network, list(t.union), tolerance=EXACT) for t in telemetry]
    by_area = [{name: list(readings) for name, readings in t.by_area.items()} for t in telemetry]
    return World(scenario.network, scenario.partition, tuple(by_area), tuple(central))


def _draw_row_of_buses(rng: np.random.Generator, n_bus: int) -> Network:
    load = np.where(rng.random(n_bus) < 0.2, 0.0, rng.lognormal(0.0, 0.5, n_bus))
    load[[0, -1]] = 0.0, 1.0
    z = rng.lognormal(0.0, 0.3, n_bus - 1)
    flow = np.cumsum(load[::-1])[::-1][1:]  # into bus k + 1 of branch k
    load *= DROP / float((z * (0.01 + 0.4 * 0.01) * flow).sum())
    buses = tuple(Bus(k + 1, 20.0, p_load=float(p), q_load=0.4 * float(p)) for k, p in enumerate(load))
    branches = tuple(
        Branch(f"{k + 1}-{k + 2}", k + 1, k + 2, r=0.01 * float(size), x=0.01 * float(size)) for k, size in enumerate(z)
    )
    return Network(f"{n_bus} buses in a row", 1.0, buses, branches, (Generator(1, Control.SLACK),))


def _draw_scans(rng: np.random.Generator, network: Network, partition: Partition) -> World:
    meters = draw_meters(rng, network)
    telemetry, central = [], []
    for scan in range(SCANS):
        flow = solve_power_flow(network if scan == 0 else _with_other_loads(rng, network))
        readings = read_meters(rng, meters, flow)
        central.append(process_bad_data(network, readings, tolerance=EXACT))
        telemetry.append(_divide(partition, meters, readings))
    return World(network, partition, tuple(telemetry), tuple(central))


def _divide(
    partition: Partition, meters: Sequence[Meter], readings: Sequence[Measurement]
) -> dict[str, list[Measurement]]:
    by_area: dict[str, list[Measurement]] = {area.name: [] for area in partition.areas}
    for meter, reading in zip(meters, readings, strict=True):
        by_area[partition.area_of_meter(meter)].append(reading)
    return by_area


def _with_other_loads(rng: np.random.Generator, network: Network) -> Network:
    factors = 1 + DRIFT * rng.standard_normal((len(network.buses), 2))
    buses = [
        replace(bus, p_load=bus.p_load * float(p), q_load=bus.q_load * float(q))
        for bus, (p, q) in zip(network.buses, factors, strict=True)
    ]
    return replace(network, buses=tuple(buses))
