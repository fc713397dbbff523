"""Gateways that are wrong as a whole, and sound ones under random loads: which the areas name, on the simulator.

Loads of each scan lie between 20 and 150 % of the schedule, all at one level or each at its own; in half of them
photovoltaics of up to 150 % of a load stand beside each. Of the wrong gateways all P and Q are multiplied by a factor,
or all readings are those of other loads.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import SimulatedBus
from dsse_core.exchange.gateway_mistakes import (
    HIGHEST_LOAD,
    LOWEST_LOAD,
    MISTAKES,
    THRESHOLD,
    GatewayTest,
    add_up,
)
from dsse_core.grid.measurement import Measurement, Source
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry

SCENARIOS = ("ieee33", "case33bw", "industrial13")
SCANS = 10  # of a run with a wrong gateway
HELD = 2  # scans that loads stay the same, of sound gateways
SCAN_S, SOUND_S = 0.2, 0.1  # of virtual time, in which these feeders end a scan; of one without bad data
ANOTHER_HOUR = "another hour"
WRONG: Mapping[str, float] = {"sign": -1.0, "x 0.001": 1e-3, "x 1.73": 3**0.5, "x 1/1.73": 3**-0.5}
NAMED = "all power readings of gateway"

Readings = dict[str, Sequence[Measurement]]


def draw_loads(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """``scenario`` with other loads, and photovoltaics that the schedule of the areas does not have."""
    n, network = len(scenario.network.buses), scenario.network
    levels = np.full(n, rng.uniform(LOWEST_LOAD, HIGHEST_LOAD))
    if rng.random() < 0.5:
        levels = rng.uniform(LOWEST_LOAD, HIGHEST_LOAD, n)
    share = rng.uniform(0.0, HIGHEST_LOAD) * rng.uniform(0.5, 1.0, n) if rng.random() < 0.5 else np.zeros(n)
    buses = tuple(
        replace(
            bus,
            p_load=level * bus.p_load - pv * abs(complex(bus.p_load, bus.q_load)),
            q_load=level * bus.q_load,
        )
        for bus, level, pv in zip(network.buses, levels.tolist(), share.tolist(), strict=True)
    )
    return replace(scenario, network=replace(network, buses=buses))


def read(scenario: Scenario, scan: int) -> Readings:
    return dict(make_telemetry(scenario, scan).by_area)


def spoil(readings: Readings, area: str, factor: float) -> Readings:
    """``readings`` with all P and Q of ``area`` times ``factor``."""
    spoilt = [
        replace(m, value=factor * m.value) if m.meter.kind.of_power and m.meter.source is not Source.VIRTUAL else m
        for m in readings[area]
    ]
    return readings | {area: spoilt}


def find_named(bus: SimulatedBus) -> dict[str, str]:
    """Area -> its note on a gateway that looks wrong."""
    return {name: note for name, state in bus.states.items() for note in state.notes if note.startswith(NAMED)}


def run_wrong(name: str, what: str, seed: int) -> tuple[int | None, bool, bool]:
    """(scan, is_false, is_good) of a run with a wrong gateway.

    ``scan``: that in which the gateway was named, None if in none. ``is_false``: another gateway was named until then,
    or the wrong one in other words. ``is_good``: an area was good before.
    """
    rng, scenario = np.random.default_rng([seed, len(what)]), load_scenario(name, changes={"seed": seed})
    loaded, others = draw_loads(scenario, rng), draw_loads(scenario, rng)
    area = str(rng.choice([a.name for a in scenario.partition.areas]))
    word = {"sign": "sign", "x 0.001": "1000 times too small"}.get(what, "?")
    bus, is_false, is_good = None, False, False
    for scan in range(1, SCANS + 1):
        readings = read(loaded, scan)
        readings = (
            readings | {area: read(others, scan)[area]} if what == ANOTHER_HOUR else spoil(readings, area, WRONG[what])
        )
        if bus is None:
            bus = SimulatedBus(area_files(scenario, "wrong", ("tcp/127.0.0.1:0",)), readings)
        else:
            bus.next_scan(readings)
        bus.run(SCAN_S)
        found = find_named(bus)
        is_false |= any(of != area or word not in note for of, note in found.items())
        if word in found.get(area, ""):
            return scan, is_false, is_good
        is_good |= "good" in {state.quality for state in bus.states.values()}
    return None, is_false, is_good


def run_sound(name: str, scans: int, seed: int) -> Counter[str]:
    """Counts of scans, of scans in which a sound gateway was named, and of scans in which all areas were good."""
    rng, scenario = np.random.default_rng(seed), load_scenario(name, changes={"seed": seed})
    loaded, bus, counts = scenario, None, Counter[str]()
    for scan in range(1, scans + 1):
        if scan % HELD == 1:
            loaded = draw_loads(scenario, rng)
        if bus is None:
            bus = SimulatedBus(area_files(scenario, "sound", ("tcp/127.0.0.1:0",)), read(loaded, scan))
        else:
            bus.next_scan(read(loaded, scan))
        bus.run(SOUND_S)
        counts["scans"] += 1
        counts["false alarms"] += bool(find_named(bus))
        counts["all good"] += {state.quality for state in bus.states.values()} == {"good"}
    return counts


def weigh_sound(name: str, scans: int, seed: int) -> Counter[str]:
    """Counts as of ``run_sound``, of each area by itself: information of neighbours never adds evidence."""
    rng, scenario = np.random.default_rng(seed), load_scenario(name, changes={"seed": seed, "telemetry.noise": False})
    tests = {area.name: GatewayTest(area) for area in scenario.partition.areas}
    sums = dict.fromkeys(((area, factor) for area in tests for factor in MISTAKES), 0.0)
    exact, counts = read(scenario, 1), Counter[str]()
    for scan in range(scans):
        if scan % HELD == 0:
            exact = read(draw_loads(scenario, rng), 1)
        is_named = False
        for area, readings in exact.items():
            noisy = [replace(m, value=m.value + m.sigma * float(rng.normal())) for m in readings]
            for factor, ratio in tests[area].weigh(noisy, {m.meter.id for m in noisy}, None, {}).items():
                sums[area, factor] = add_up(sums[area, factor], ratio)
                is_named |= sums[area, factor] > THRESHOLD
        counts["scans"] += 1
        counts["false alarms"] += is_named
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=45, help="with a wrong gateway, of each kind (45)")
    parser.add_argument("--scans", type=int, default=10_000, help="of sound gateways, each area by itself (10000)")
    parser.add_argument("--simulated", type=int, default=3000, help="of sound gateways, on the simulator (3000)")
    chosen = parser.parse_args()
    for what in (*WRONG, ANOTHER_HOUR) if chosen.runs else ():
        found = [run_wrong(SCENARIOS[k % len(SCENARIOS)], what, k + 1) for k in range(chosen.runs)]
        scans = [named for named, _, _ in found if named is not None]
        others = sum(is_false for _, is_false, _ in found)
        good = sum(is_good for _, _, is_good in found)
        print(
            f"{what}: named in {len(scans)} of {len(found)} runs within {SCANS} scans, in the first scan in "
            f"{scans.count(1)}; another one in {others}; an area good before, or without that, in {good}",
            flush=True,
        )
    for scans, run, where in ((chosen.scans, weigh_sound, "by itself"), (chosen.simulated, run_sound, "simulated")):
        total = Counter[str]()
        for k, name in enumerate(SCENARIOS):
            total += run(name, scans // len(SCENARIOS) + (k < scans % len(SCENARIOS)), k + 1)
        print(f"sound, {where}: {dict(total)}; named in {total['false alarms']} scans", flush=True)


if __name__ == "__main__":
    main()
