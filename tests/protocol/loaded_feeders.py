"""Random feeders near the nose of their voltage curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from feeders import KIND, Feeder, make_feeder, read_with_noise

from dsse_core.errors import PowerFlowDivergedError
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow

HALVINGS = 12  # of the interval that holds the largest load


def make_loaded_feeder(seed: int, *, full: bool = True) -> Feeder:
    """A feeder under 0.9 to 0.99 of its largest load.

    ``full``: voltmeters at all buses, flow meters at both ends of all branches, injection meters where not exactly
    nothing is injected; else one voltmeter, at the substation, the injections and every other flow.
    """
    rng = np.random.default_rng([4, seed])
    drawn = make_feeder(seed, n_bus=int(rng.integers(5, 40)), n_area=int(rng.integers(2, 8)), shape=0.7, decades=1.0)
    network = _scale(drawn.network, float(rng.uniform(0.9, 0.99)) * find_largest_load(drawn.network))
    flow = solve_power_flow(network)
    largest = abs(flow.injection).max()
    measurements = tuple(read_with_noise(rng, m, flow, largest, 1.0) for m in _choose_meters(network, rng, full))
    areas = {area.name: [bus.id for bus in area.network.buses] for area in drawn.partition.areas}
    return Feeder(network, build_partition(network, areas), measurements)


def _choose_meters(network: Network, rng: np.random.Generator, full: bool) -> list[Meter]:
    meters = [Meter(KIND.VM, bus.id) for bus in (network.buses if full else network.buses[:1])]
    for bus in network.buses:
        exact = bus.p_load == 0 and bus.id != 1
        source = Source.VIRTUAL if exact else Source.TELEMETERED
        meters += [Meter(kind, bus.id, source=source) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    for branch in network.branches:
        for end in (branch.from_bus, branch.to_bus) if full else (branch.from_bus,) * int(rng.integers(2)):
            meters += [Meter(kind, end, branch.id) for kind in (KIND.P_FLOW, KIND.Q_FLOW)]
    return meters


def find_largest_load(network: Network) -> float:
    """The factor on all loads beyond which the power flow has no solution, by bisection."""
    low, high = 1.0, 2.0
    while _has_solution(_scale(network, high)):
        low, high = high, 2 * high
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if _has_solution(_scale(network, middle)):
            low = middle
        else:
            high = middle
    return low


def _has_solution(network: Network) -> bool:
    try:
        return bool(solve_power_flow(network).vm.min() > 0)
    except PowerFlowDivergedError:
        return False


def _scale(network: Network, factor: float) -> Network:
    buses = tuple(replace(b, p_load=b.p_load * factor, q_load=b.q_load * factor) for b in network.buses)
    return replace(network, buses=buses)


def make_outvoted_feeder() -> Feeder:
    """A feeder whose power meters agree on a load that no voltage can carry; the only voltmeter there says otherwise.

    The voltmeter's normalised residual is the largest, and without it the readings have no state near them.
    """
    p, q, bus = 1.9, 0.76, 3
    buses = (Bus(1, 20.0, 0.0, 0.0), Bus(2, 20.0, 0.0, 0.0), Bus(bus, 20.0, p, q))
    branches = (Branch("1-2", 1, 2, r=1e-4, x=1e-4), Branch("2-3", 2, bus, r=0.1, x=0.1))
    network = Network("outvoted", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    virtual = [Meter(kind, 2, source=Source.VIRTUAL) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    measurements = [Measurement(Meter(KIND.VM, k), vm, 0.01) for k, vm in ((1, 1.0), (2, 1.0), (bus, 0.9))]
    measurements += [Measurement(meter, 0.0, 0.01) for meter in virtual]
    measurements += [
        Measurement(Meter(KIND.P_INJECTION, bus), -p, 0.01),
        Measurement(Meter(KIND.Q_INJECTION, bus), -q, 0.01),
    ]
    measurements += [
        Measurement(Meter(KIND.P_FLOW, bus, "2-3"), -p, 0.01),
        Measurement(Meter(KIND.Q_FLOW, bus, "2-3"), -q, 0.01),
    ]
    return Feeder(network, build_partition(network, {"a1": [1, 2], "a2": [2, 3]}), tuple(measurements))
