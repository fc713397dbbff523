"""What an area finds once is not found at every heartbeat, nor kept when nobody asks for it any more."""

from __future__ import annotations

import gc
import math
import weakref
from typing import Any

import pytest

from agents.protocol import published_state
from coordinator.lab.simulator.simulator import TRAVEL_S
from dsse_core.exchange import area_estimation
from dsse_core.linear.area_model import AreaModel
from tests.support.exact_exchange import settle_bus
from tests.support.feeders import make_feeder
from tests.support.simulated_bus import SimulatedBus

SOME_HEARTBEATS_S = 3.0


@pytest.fixture
def bus() -> SimulatedBus:
    feeder = make_feeder(1, n_bus=24, n_area=4, shape=1.0, decades=1.0, dense=0.5)
    return SimulatedBus(feeder.area_files(0.0, 1), feeder.telemetry())


def test_at_rest_no_heartbeat_finds_the_numbers_of_the_state_anew(bus: SimulatedBus, monkeypatch: pytest.MonkeyPatch):
    settle_bus(bus)
    found: list[Any] = []
    for place, name in ((published_state, "describe_estimate"), (AreaModel, "boundary_values")):
        monkeypatch.setattr(place, name, lambda *_: found.append(1))
    bus.delivered.clear()
    bus.run(SOME_HEARTBEATS_S)
    assert any(message.kind == "heartbeat" for *_, message in bus.delivered)
    assert not found


def test_no_area_keeps_its_no_load_model_when_all_have_been_sent_what_follows_from_it(
    bus: SimulatedBus, monkeypatch: pytest.MonkeyPatch
):
    built: list[weakref.ref[Any]] = []

    def build(*arguments: Any) -> Any:
        model = build_no_load_model(*arguments)
        built.append(weakref.ref(model))
        return model

    build_no_load_model = area_estimation.build_no_load_model
    monkeypatch.setattr(area_estimation, "build_no_load_model", build)
    settle_bus(bus)
    gc.collect()
    assert len(built) == len(bus.files)
    assert not [model for model in built if model() is not None]


def test_at_rest_an_area_wakes_itself_no_more_than_once_a_heartbeat(bus: SimulatedBus):
    """What is due to several neighbours goes out at the area's own heartbeat, to all of them."""
    settle_bus(bus)
    bus.run(SOME_HEARTBEATS_S)  # until what heartbeats say has not changed for longer than one
    bus.delivered.clear()
    bus.run(SOME_HEARTBEATS_S)
    for name, content in bus.files.items():
        times = [at for at, sender, _, message in bus.delivered if sender == name]
        heartbeats = SOME_HEARTBEATS_S / content.beat_s
        assert len(times) >= (heartbeats - 1) * len(content.area.neighbours)
        assert len(set(times)) <= heartbeats + 1


def test_a_neighbour_that_is_there_and_does_not_answer_is_asked_ever_more_rarely(bus: SimulatedBus):
    """It may wait for its turn on a processor that hundreds share; each message would keep it waiting longer."""
    settle_bus(bus)
    silent = next(iter(bus.files))
    bus.pause(silent)
    bus.delivered.clear()
    heartbeats = 4
    bus.run(heartbeats * bus.files[silent].beat_s)
    shortest_wait_s = 2 * TRAVEL_S
    most = heartbeats + math.log2(bus.files[silent].beat_s / shortest_wait_s)
    for neighbour in bus.files[silent].area.neighbours:
        asked = [at for at, sender, receiver, _ in bus.delivered if (sender, receiver) == (neighbour.area, silent)]
        assert heartbeats - 1 <= len(asked) <= most
