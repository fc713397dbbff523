"""How long a link may be silent, beside how long everything that follows from its end waits."""

from __future__ import annotations

import pytest

from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS
from agents.runtime.duplicate_guard import OVERLAP_HEARTBEATS, OVERLAP_S
from agents.transport.bus_config import bus_config
from coordinator.watch.observe.duplicates import SURE_HEARTBEATS, SURE_S


@pytest.mark.parametrize("heartbeat_s", [0.02, 0.2, 2.0, 5.0])
def test_an_area_that_waits_for_its_turn_is_not_gone_before_the_patience_of_its_neighbours_ends(heartbeat_s: float):
    """Its token vanishes with its link, and then all areas begin their term anew, which makes it wait longer still."""
    lease_s = bus_config("client", heartbeat_s=heartbeat_s)["transport"]["link"]["tx"]["lease"] / 1000
    assert lease_s >= PATIENCE_HEARTBEATS * heartbeat_s
    assert lease_s < max(SURE_S, SURE_HEARTBEATS * heartbeat_s) < max(OVERLAP_S, OVERLAP_HEARTBEATS * heartbeat_s)
