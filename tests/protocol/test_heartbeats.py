"""Heartbeats tell where an area stands, and that it is there; how long a scan takes is no reason for more of them."""

from collections import Counter

import pytest

from tests.support.feeders import make_feeder
from tests.support.simulated_bus import SimulatedBus

LONG = 59


def count_per_edge(n_area: int) -> tuple[float, Counter[str]]:
    """How long the first scan of a row of areas takes, s, and how often each kind of message is sent over an edge."""
    feeder = make_feeder(1, n_bus=2 * n_area, n_area=n_area, shape=1.0, decades=1.0, dense=0.5)
    bus = SimulatedBus(feeder.area_files(0.0, 1), feeder.telemetry())
    while len(bus.states) < len(bus.files) or any(state.quality != "good" for state in bus.states.values()):
        assert bus.now < 10.0, "no end"
        bus.run(0.01)
    counts = Counter(message.kind for *_, message in bus.delivered)
    return bus.now, Counter({kind: count / (len(bus.files) - 1) for kind, count in counts.items()})


def test_waiting_for_the_far_end_of_a_long_row_is_not_filled_with_heartbeats():
    (short_s, short), (long_s, long) = count_per_edge(20), count_per_edge(LONG)
    assert long["up"] + long["down"] == pytest.approx(short["up"] + short["down"]) == 8
    assert long_s > 2 * short_s
    assert long["heartbeat"] < 1.5 * short["heartbeat"]
