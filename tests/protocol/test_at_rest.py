"""What an area finds once is not found at every heartbeat, nor kept when nobody asks for it any more."""

from __future__ import annotations

import gc
import weakref
from typing import Any

import pytest
from exact_exchange import settle_bus
from feeders import make_feeder
from simulated_bus import SimulatedBus

from agents.protocol import published_state
from dsse_core.exchange import area_estimation
from dsse_core.linear.area_model import AreaModel

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


def test_no_area_keeps_its_no_load_model_when_all_have_been_told_what_follows_from_it(
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
