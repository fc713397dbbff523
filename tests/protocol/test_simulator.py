"""The simulator: repeatable to the bit, and what its links do to messages delays the answer and does not change it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from agents.messages.packing import StateMessage
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.link_faults import LinkFaults
from scenarios.faults.faults import change_links
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links
from tests.support.tree_of_areas import tree_scenario

WILD = LinkFaults(loss=0.3, delay_s=0.004, jitter_s=0.1, duplicate=0.4)


def states_of(seed: int, faults: LinkFaults = WILD) -> list[StateMessage]:
    """Every state that the areas of a lossy run publish in two seconds."""
    files = with_links(area_files_of(load_scenario("ieee33"), seed=seed), faults)
    shown: list[StateMessage] = []
    telemetry = make_telemetry(load_scenario("ieee33")).by_area  # the same for every seed: only the links differ
    bus = SimulatedBus(files, telemetry, on_state=lambda at, state: shown.append(state))
    bus.run(2.0)
    return shown


def test_the_same_seed_twice_gives_the_same_history_to_the_bit():
    assert states_of(seed=3) == states_of(seed=3)


def test_another_seed_gives_another_history():
    assert states_of(seed=3) != states_of(seed=4)


def test_link_faults_alone_change_the_history():
    assert states_of(seed=3) != states_of(seed=3, faults=replace(WILD, jitter_s=0.05))
    assert states_of(seed=3) != states_of(seed=3, faults=replace(WILD, duplicate=0.0))


@pytest.mark.parametrize("strategy", ["information", "admm"])
def test_delays_duplicates_and_overtaking_do_not_change_the_fixed_point(strategy: str):
    scenario = tree_scenario()
    telemetry = make_telemetry(scenario)
    files = with_links(area_files_of(scenario, seed=5, strategy=strategy), replace(WILD, loss=0.2))
    bus = SimulatedBus(files, telemetry.by_area)
    arrived = record_arrivals(bus)
    bus.run_until_settled(300.0)
    bus.run(20.0)
    assert bus.settled
    assert has_overtaking(arrived)
    central = estimate_state(scenario.network, telemetry.union, tolerance=1e-12)
    for state in bus.states.values():
        rows = [central.network.row[b] for b in state.buses]
        np.testing.assert_allclose(state.vm, central.vm[rows], atol=1e-8)
        np.testing.assert_allclose(state.va, central.va[rows], atol=1e-8)


def record_arrivals(bus: SimulatedBus) -> dict[tuple[str, str, str], list[float]]:
    """(sender, receiver, kind) -> send times in the order in which messages reach the receiver."""
    arrived: dict[tuple[str, str, str], list[float]] = {}
    for receiver, protocol in bus.protocols.items():

        def handle(events, now, receiver=receiver, handle=protocol.handle):
            for event in events:
                if sender := getattr(event, "key_sender", ""):
                    key = (sender, receiver, event.message.kind)
                    arrived.setdefault(key, []).append(event.message.header.time)
            return handle(events, now)

        protocol.handle = handle  # type: ignore[method-assign]
    return arrived


def has_overtaking(arrived: dict[tuple[str, str, str], list[float]]) -> bool:
    return any(later < earlier for numbers in arrived.values() for earlier, later in pairwise(numbers))


def test_presence_reaches_neighbours_and_watchers():
    scenario = load_scenario("ieee33")
    seen: list[tuple[float, str, bool]] = []
    bus = SimulatedBus(
        area_files_of(scenario),
        make_telemetry(scenario).by_area,
        on_presence=lambda at, area, alive: seen.append((at, area, alive)),
    )
    bus.run(1.0)
    bus.kill("area2")
    bus.run(0.5)
    assert seen == [(0.0, "area1", True), (0.0, "area2", True), (0.0, "area3", True), (1.0, "area2", False)]
    assert "neighbour area2 is gone" in bus.states["area1"].notes
    bus.start("area2")
    bus.send_telemetry("area2")
    bus.run_until_settled()
    assert bus.states["area1"].notes == ()


def test_time_passes_exactly_as_asked_and_heartbeats_come_in_it():
    bus = SimulatedBus(area_files_of(load_scenario("ieee33")), make_telemetry(load_scenario("ieee33")).by_area)
    bus.run(1.1)
    sent = sum(link.messages for link in bus.links.values())
    bus.run(1.0)
    assert bus.now == 2.1
    heartbeat_s, links, kinds = 0.2, 4, 1  # links are directed; heartbeat
    assert sum(link.messages for link in bus.links.values()) - sent == links * kinds * round(1.0 / heartbeat_s)


def test_impossible_changes_of_links_are_rejected_all_at_once():
    with pytest.raises(InvalidInputError) as error:
        change_links(load_scenario("ieee33").faults, {"delay_s": -1.0, "jitter_s": 1e9, "duplicate": 2.0})
    assert len(error.value.problems) == 3
