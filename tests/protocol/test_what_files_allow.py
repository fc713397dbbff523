"""Ids, names and numbers drawn from all that files allow reach every area and watcher through the real encoder."""

from __future__ import annotations

import random
from itertools import pairwise
from pathlib import Path

import pytest
from simulated_bus import SimulatedBus, area_files_of

from agents.messages.packing import decode, encode
from dsse_core.grid.physical_ranges import BASE_POWER, BASE_VOLTAGE
from dsse_core.limits import LARGEST_BUS, LARGEST_SEED, LONGEST_NAME
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry

LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789_-"
EDGES = (-LARGEST_BUS, -1, 0, 1, LARGEST_BUS)


def draw_ids(rng: random.Random, count: int) -> list[int]:
    """Ids of buses: the ends of the range, numbers near 0 and any of the range."""
    ids: dict[int, None] = {}
    while len(ids) < count:
        drawn = (rng.choice(EDGES), rng.randint(-9, 9), rng.randint(-LARGEST_BUS, LARGEST_BUS))
        ids[rng.choice(drawn)] = None
    return list(ids)


def draw_names(rng: random.Random, count: int) -> list[str]:
    """Names of areas and branches, of 1 to ``LONGEST_NAME`` letters."""
    names: dict[str, None] = {}
    while len(names) < count:
        length = rng.choice((1, 2, rng.randint(1, LONGEST_NAME), LONGEST_NAME))
        names["".join(rng.choice(LETTERS) for _ in range(length))] = None
    return list(names)


def draw_between(rng: random.Random, least: float, most: float) -> float:
    """A number of any decade of a range, its ends included."""
    return min(max(least * (most / least) ** rng.choice((0.0, 1.0, rng.random())), least), most)


def draw_scenario(folder: Path, rng: random.Random) -> Scenario:
    """A feeder of four to six buses in two areas; impedances and loads in p.u. are the same whatever the base is."""
    buses = draw_ids(rng, rng.randint(4, 6))
    names = draw_names(rng, 2 + len(buses))
    base_mva = draw_between(rng, BASE_POWER.least, BASE_POWER.most / 10)
    base_kv = draw_between(rng, BASE_VOLTAGE.least, BASE_VOLTAGE.most)
    lines = ['name = "drawn"', 'data_source = "drawn"', f"base_mva = {base_mva!r}"]
    for bus in buses:
        p, q = (0.01 * rng.random() * base_mva for _ in range(2))
        lines.append(f"[[bus]]\nid = {bus}\nbase_kv = {base_kv!r}\np_load_mw = {p!r}\nq_load_mvar = {q!r}")
    for k, (upstream, bus) in enumerate(pairwise(buses)):
        given = f'id = "{names[2 + k]}"' if rng.random() < 0.5 else ""
        lines.append(f"[[branch]]\nfrom = {upstream}\nto = {bus}\n{given}\nr_pu = 0.01\nx_pu = 0.02")
    lines.append(f'[[source]]\nbus = {buses[0]}\nkind = "slack"\nvm_pu = 1.0')
    (folder / "net.toml").write_text("\n".join(lines), encoding="utf-8")
    areas = {names[0]: buses[:3], names[1]: buses[2:]}
    text = [f'version = 1\ndescription = "drawn"\nnetwork = "net.toml"\nseed = {rng.randint(0, LARGEST_SEED)}']
    text += [f'[areas."{name}"]\nbuses = {of}' for name, of in areas.items()]
    text += ["[telemetry]\nnoise = false", "[measurements]"]
    text += [f'voltage = {{ buses = "all", sigma_percent = {draw_between(rng, 0.01, 1.0)!r} }}']
    text += [f'injection = {{ buses = "all", sigma_percent = {draw_between(rng, 0.1, 10.0)!r} }}']
    (folder / "drawn.toml").write_text("\n".join(text), encoding="utf-8")
    return load_scenario(folder / "drawn.toml")


@pytest.mark.random_cases(few=30, many=2000)
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
