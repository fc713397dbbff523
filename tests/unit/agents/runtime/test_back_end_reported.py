"""Which back end computes the exchange is reported at the start, and in the end what that had to leave to another."""

from __future__ import annotations

import pytest

from agents.messages.packing import Incarnation
from agents.protocol.choose import make_protocol
from tests.support.back_ends import back_end
from tests.support.feeders import make_feeder
from tests.support.simulated_bus import SimulatedBus


@pytest.mark.parametrize(("n_bus", "expected"), [(20, "dense"), (50, "sparse"), (80, "radial")])
def test_the_back_end_is_known_before_anything_is_computed(n_bus: int, expected: str):
    if expected == "radial":
        pytest.importorskip("numba")
    (content,) = make_feeder(1, n_bus=n_bus, n_area=1).area_files(0.0, 0)
    protocol = make_protocol(content, Incarnation(1, 1), now=0.0, started_at=1.7e9)
    assert protocol.describe_backend() == expected


def test_calls_that_the_tree_has_left_are_reported_and_messages_away_from_the_reference_are_none():
    with back_end("radial"):
        feeder = make_feeder(5, n_bus=60, n_area=6, decades=1.0)
        bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
        bus.run_until_settled()
        reported = {area.name: bus.protocols[area.name].describe_backend() for area in feeder.partition.areas}
        assert set(reported.values()) == {"radial"}
        protocol = bus.protocols["a1"]
        protocol.round.estimation.model.linear.declined["an open combination of p and q"] += 2
        left = "radial, calls left to sparse matrices: 2 for an open combination of p and q"
        assert protocol.describe_backend() == left
