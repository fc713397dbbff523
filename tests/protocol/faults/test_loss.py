"""What lost messages cost: round trips of the link that loses them, whatever the heartbeat, under every strategy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coordinator.lab.simulator.simulator import TRAVEL_S
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links

NEAR = 1e-6  # p.u. and rad, of the fixed point
ROUND_TRIP_S = 2 * TRAVEL_S
STRATEGIES = ("information", "angle-offset", "admm")
Ends = dict[str, tuple[np.ndarray, np.ndarray]]


def bus_with(strategy: str, *, loss: float, heartbeat_s: float, seed: int = 0) -> SimulatedBus:
    scenario = load_scenario("ieee33")
    files = with_links(area_files_of(scenario, strategy=strategy), LinkFaults(loss=loss))
    files = [replace(content, seed=seed, beat_s=heartbeat_s) for content in files]
    return SimulatedBus(files, make_telemetry(scenario).by_area)


def find_ends(strategy: str) -> Ends:
    bus = bus_with(strategy, loss=0.0, heartbeat_s=0.2)
    bus.run(5.0)
    return {name: (np.array(state.vm), np.array(state.va)) for name, state in bus.states.items()}


def is_near(bus: SimulatedBus, ends: Ends) -> bool:
    for name, (vm, va) in ends.items():
        state = bus.states.get(name)
        if state is None or not state.referenced:
            return False
        if max(abs(np.array(state.vm) - vm).max(), abs(np.array(state.va) - va).max()) > NEAR:
            return False
    return True


def round_trips_to(bus: SimulatedBus, ends: Ends, most: int) -> int:
    """Until every area has come near the fixed point."""
    for passed in range(most):
        if is_near(bus, ends):
            return passed
        bus.run(ROUND_TRIP_S)
    pytest.fail(f"not there after {most} round trips: {[state.notes for state in bus.states.values()]}")


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize(
    ("loss", "most"), [(0.3, 100), *(pytest.param(*case, marks=pytest.mark.long) for case in ((0.0, 10), (0.6, 500)))]
)
@pytest.mark.n_cases(few=1, long=3, many=3)
def test_a_lost_message_costs_round_trips_and_no_heartbeat(strategy: str, loss: float, most: int, n_cases: int):
    """Waits end at 20 ms, ten round trips: a heartbeat of 20 s would be 10,000.

    Which messages are lost depends on how many have been sent: rounds send heartbeats before the end of a term, as many
    as patience needs, the others none by the clock.
    """
    ends = find_ends(strategy)
    for seed in range(n_cases):
        counts = {
            round_trips_to(bus_with(strategy, loss=loss, heartbeat_s=b, seed=seed), ends, most) for b in (0.2, 2, 20)
        }
        assert max(counts) < 1.2 * min(counts) or strategy == "information", (
            f"{counts} round trips with three heartbeats"
        )
