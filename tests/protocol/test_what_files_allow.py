"""Ids, names and numbers drawn from all that files allow reach every area and watcher through the real encoder."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from agents.messages.packing import decode, encode
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.drawn_files import draw_scenario
from tests.support.simulated_bus import SimulatedBus, area_files_of


@pytest.mark.random_cases(few=10, long=30, many=2000)
def test_what_files_allow_reaches_every_area_and_watcher(tmp_path: Path, random_seed: int) -> None:
    scenario = draw_scenario(tmp_path, random.Random(random_seed))
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    while not (bus.settled and {state.quality for state in bus.states.values()} == {"good"}):
        assert bus.now < 30.0, {name: (state.quality, state.notes) for name, state in bus.states.items()}
        bus.run(0.05)
    for state in bus.states.values():
        assert dict(state.rejected) == {}
        assert decode(encode(state)) == state
    assert {b for state in bus.states.values() for b in state.buses} == set(scenario.network.row)


@pytest.mark.parametrize("areas", ["count = 1", "a.buses = [-1]"])
def test_a_network_of_one_bus_is_an_area_of_one_bus(tmp_path: Path, areas: str) -> None:
    bus = "bus = [{ id = -1, base_kv = 12.66, p_load_mw = 0.1 }]\nbranch = []"
    source = 'source = [{ bus = -1, kind = "slack", vm_pu = 1.02 }]'
    (tmp_path / "net.toml").write_text(f'name = "one"\ndata_source = "drawn"\nbase_mva = 1.0\n{bus}\n{source}')
    meters = 'voltage = { buses = "all", sigma_percent = 0.3 }\ninjection = { buses = "all", sigma_percent = 3.0 }'
    head = f'version = 1\ndescription = "one"\nnetwork = "net.toml"\n[areas]\n{areas}\n[telemetry]\nnoise = false'
    (tmp_path / "one.toml").write_text(f"{head}\n[measurements]\n{meters}")
    scenario = load_scenario(tmp_path / "one.toml")
    simulated = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    simulated.run(1.0)
    (state,) = simulated.states.values()
    assert (state.buses, state.quality) == ((-1,), "good")
    assert state.vm == pytest.approx((1.02,), abs=1e-9)
