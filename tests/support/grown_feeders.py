"""Feeders of mixed phases that grow at random, with regulators, delta-wye banks, and loads to ground and in delta."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.radial_order import walk_graph
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.phases import DELTA, WYE, bank, coupled_line

KIND = MeasurementKind
SOURCE = 1
EXACT = 1e-9  # p.u.; a smaller power is none


def grow_feeder(seed: int, n_bus: int, *, load: float = 0.3) -> Network:
    """A radial feeder of ``n_bus`` buses; ``load``: of all buses together, p.u."""
    rng, phases, branches = np.random.default_rng(seed), {SOURCE: "abc"}, list[Branch]()
    for bus in range(SOURCE + 1, SOURCE + n_bus):
        up = int(rng.integers(max(SOURCE, bus - 8), bus))
        above, k = phases[up], int(rng.integers(1, len(phases[up]) + 1))
        is_as_above = bus < SOURCE + 3 or rng.random() < 0.95
        phases[bus] = above if is_as_above else "".join(sorted(rng.choice(list(above), k, replace=False)))
        ends, name, draw = (up, bus), f"{up}-{bus}", rng.random()
        if phases[bus] == "abc" and draw < 0.1:
            windings = DELTA if draw < 0.05 else WYE
            branches.append(bank(name, ends, windings, tuple(rng.uniform(0.98, 1.02, 3))))
        else:
            length = 0.1 if up == SOURCE else float(10 ** rng.uniform(-3.0, -0.7))
            branches.append(coupled_line(name, ends, phases[bus], length))
    loads, size, beside = list[Load](), load / n_bus, {b.to_bus for b in branches if b.from_bus == SOURCE}
    for bus, here in phases.items():
        if bus == SOURCE or (rng.random() < 0.3 and bus not in beside):
            continue
        if len(here) > 1 and rng.random() < 0.2:
            loads.append(Load(bus, here[:2], complex(*rng.uniform(0.3, 1.0, 2)) * size))
        else:
            loads += [Load(bus, p, complex(*rng.uniform(0.3, 1.0, 2)) * size) for p in here]
    buses = tuple(Bus(bus, 4.16, phases=here) for bus, here in phases.items())
    return Network(f"grown {seed}", 5.0, buses, tuple(branches), (Generator(SOURCE, Control.SLACK),), tuple(loads))


def read_feeder(network: Network, seed: int, decades: float = 0.0) -> list[Measurement]:
    """Noisy readings of P and Q at each node, exact ones where no power is, of some voltages, flows and currents."""
    rng, result, source = np.random.default_rng(seed), solve_power_flow(network), _source_of(network)
    places = [(bus.id, p) for bus in network.buses if bus.id != source for p in list_phases(bus.phases)]
    meters = [Meter(kind, bus, phases=p) for bus, p in places for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    meters += [Meter(KIND.VM, source, phases=p) for p in "abc"]
    meters += [Meter(KIND.VM, bus, phases=p) for bus, p in places if rng.random() < 0.1]
    branches = zip(network.active_branches, network.active_branch_ids, strict=True)
    some = [(b.to_bus, name) for b, name in branches if b.from_bus == source or rng.random() < 0.1]
    for kind in (KIND.P_FLOW, KIND.Q_FLOW, KIND.CURRENT):
        of = some if kind is not KIND.CURRENT else some[::3]
        meters += [Meter(kind, bus, name, phases=p) for bus, name in of for p in list_phases(network.bus(bus).phases)]
    model = build_measurement_model(network, build_admittance(network), meters)
    z = model.predict(np.concatenate([result.va, result.vm]))
    sigma = 1e-3 * 10 ** rng.uniform(-decades, 0.0, len(z))
    is_exact = np.array([m.kind.of_injection for m in meters]) & (abs(z) < EXACT)
    noisy = np.where(is_exact, 0.0, z + sigma * rng.standard_normal(len(z)))
    numbers = zip(meters, noisy.tolist(), np.where(is_exact, 0.0, sigma).tolist(), is_exact.tolist(), strict=True)
    return [Measurement(replace(m, source=Source.VIRTUAL) if exact else m, z, s) for m, z, s, exact in numbers]


def cut_feeder(network: Network, size: int) -> dict[str, list[int]]:
    """The buses of areas with ``size`` buses or some more, each a part of the tree; it meets the one above at its top.

    A single bus is no area.
    """
    order, up = _walk(network)
    below, tops = dict.fromkeys(order, 1), set[int]()
    for bus in order[:0:-1]:
        if below[bus] > size:
            tops.add(bus)
            below[bus] = 1
        below[up[bus]] += below[bus]
    return cut_at(network, tops)


def cut_at(network: Network, tops: Collection[int]) -> dict[str, list[int]]:
    """The buses of the areas below each of ``tops``, in the order from the source, and of what is above them all."""
    order, up = _walk(network)
    top = {order[0]: order[0]}
    areas: dict[int, list[int]] = {bus: [bus] for bus in order if bus in tops or bus == order[0]}
    for bus in order[1:]:
        areas[top[up[bus]]].append(bus)
        top[bus] = bus if bus in tops else top[up[bus]]
    return {f"area{bus}": buses for bus, buses in areas.items()}


def _walk(network: Network) -> tuple[list[int], dict[int, int]]:
    """Buses from the source on, and for each the next one towards it."""
    table, ids = network.table, network.table.bus_id.tolist()
    order, up = walk_graph(table.graph, table.rows.row_of(_source_of(network)))
    return [ids[row] for row in order.tolist()], {ids[row]: ids[above] for row, above in enumerate(up.tolist())}


def _source_of(network: Network) -> int:
    assert network.slack is not None
    return network.slack.bus
