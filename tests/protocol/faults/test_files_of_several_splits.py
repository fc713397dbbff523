"""An area with the file of another split, or an edited one, is named on all areas, and none of them is good."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agents.area_files.area_file import stamp_split
from agents.messages.packing import StateMessage
from agents.protocol.configuration import Configuration
from agents.protocol.quality import GOOD
from coordinator.lab.simulator.simulator import STARTED_AT
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.partition import Area
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of

SCENARIOS = ("ieee33", "case33bw", "industrial13")
SCAN_S = 2.0  # many times what a scan of these feeders takes
OLDER_S = 86_400.0


def change_branch(area: Area, rng: np.random.Generator, **changes: Callable[[float], float]) -> Area:
    """One branch of ``area`` with other numbers."""
    branches = list(area.network.branches)
    k = int(rng.integers(len(branches)))
    branches[k] = replace(branches[k], **{key: change(getattr(branches[k], key)) for key, change in changes.items()})
    return replace(area, network=replace(area.network, branches=tuple(branches)))


def scale_impedance(factor: float) -> Callable[[Area, np.random.Generator], Area]:
    return lambda area, rng: change_branch(area, rng, r=lambda r: factor * r, x=lambda x: factor * x)


def move_lateral(area: Area, rng: np.random.Generator) -> Area:
    """A branch begins at another bus."""
    buses = [bus.id for bus in area.network.buses]
    branches = list(area.network.branches)
    k = int(rng.integers(len(branches)))
    others = [bus for bus in buses if bus not in (branches[k].from_bus, branches[k].to_bus)]
    if not others:
        return scale_impedance(2.0)(area, rng)
    branches[k] = replace(branches[k], from_bus=int(rng.choice(others)))
    return replace(area, network=replace(area.network, branches=tuple(branches)))


def change_tap(area: Area, rng: np.random.Generator) -> Area:
    return change_branch(area, rng, tap=lambda tap: 1.025 * tap)


def add_capacitor(area: Area, rng: np.random.Generator) -> Area:
    buses = list(area.network.buses)
    k = int(rng.integers(len(buses)))
    buses[k] = replace(buses[k], b_shunt=buses[k].b_shunt + 0.05)
    return replace(area, network=replace(area.network, buses=tuple(buses)))


EDITS = {
    "z x 1.2": scale_impedance(1.2),
    "z x 2": scale_impedance(2.0),
    "z x 0.5": scale_impedance(0.5),
    "z x 10": scale_impedance(10.0),
    "lateral elsewhere": move_lateral,
    "tap": change_tap,
    "capacitor": add_capacitor,
    "meters": None,
}


def edit(content: Configuration, what: str, rng: np.random.Generator) -> Configuration:
    """``content`` as an operator would change it by hand."""
    change = EDITS[what]
    if change is not None:
        return replace(content, area=change(content.area, rng))
    bus = int(rng.choice([bus.id for bus in content.area.network.buses]))
    meter = Meter(MeasurementKind.VM, bus)
    meters = tuple(content.meters)
    return replace(content, meters=tuple(m for m in meters if m != meter) if meter in meters else (*meters, meter))


def run_with(files: list[Configuration], scenario: object) -> tuple[SimulatedBus, list[StateMessage]]:
    """One scan, and what the areas have shown of it."""
    shown: list[StateMessage] = []
    telemetry = make_telemetry(scenario).by_area
    bus = SimulatedBus(files, telemetry, on_state=lambda at, state: shown.append(state))
    bus.run(SCAN_S)
    return bus, shown


def assert_all_name(bus: SimulatedBus, shown: list[StateMessage], name: str, *splits: object) -> None:
    """No area has ever been good, and at the end of the scan each names the file of ``name`` and ``splits``."""
    assert all(state.quality != GOOD for state in shown)
    for area, state in bus.states.items():
        whose = "this area" if area == name else name
        (note,) = (note for note in state.notes if note.startswith(f"the file of {whose} "))
        assert all(str(split) in note for split in splits), note


@pytest.mark.random_cases(few=1, long=6, many=90)
@pytest.mark.parametrize("what", EDITS)
def test_one_older_or_edited_file_leaves_no_area_good_and_all_name_it_within_one_scan(what: str, random_seed: int):
    rng = np.random.default_rng([random_seed, list(EDITS).index(what)])
    name = SCENARIOS[random_seed % len(SCENARIOS)]
    scenario = load_scenario(name)
    files = stamp_split(area_files_of(scenario, strategy="information"), time=STARTED_AT)
    k = int(rng.integers(len(files)))
    edited = edit(files[k], what, rng)
    if random_seed // len(SCENARIOS) % 2:
        own = edited
    else:
        own = stamp_split([*files[:k], edited, *files[k + 1 :]], time=STARTED_AT - OLDER_S)[k]
    bus, shown = run_with([*files[:k], own, *files[k + 1 :]], scenario)
    theirs, ours = own.identity, files[k].identity
    assert theirs != ours
    assert_all_name(bus, shown, own.area.name, theirs, *(() if theirs.edited else (ours,)))


@pytest.mark.parametrize("strategy", ["angle-offset", *further("admm")])
def test_under_an_asynchronous_strategy_the_neighbours_name_it_and_no_area_is_good(strategy: str):
    scenario = load_scenario("ieee33")
    files = stamp_split(area_files_of(scenario, strategy=strategy), time=STARTED_AT)
    old = stamp_split([edit(f, "z x 2", np.random.default_rng(1)) for f in files], time=STARTED_AT - OLDER_S)[0]
    bus, shown = run_with([old, *files[1:]], scenario)
    assert all(state.quality != GOOD for state in shown)
    neighbours = {n.area for n in old.area.neighbours}
    for name in (old.area.name, *neighbours):
        assert any("is older" in note and str(old.identity) in note for note in bus.states[name].notes)


def test_areas_that_are_restarted_with_the_new_files_one_by_one_are_good_at_the_end():
    scenario = load_scenario("ieee33")
    old = stamp_split(area_files_of(scenario, strategy="information"), time=STARTED_AT - OLDER_S)
    new = stamp_split([edit(f, "capacitor", np.random.default_rng(1)) for f in old], time=STARTED_AT)
    bus, _ = run_with(old, scenario)
    assert {state.quality for state in bus.states.values()} == {GOOD}
    for k, content in enumerate(new):
        name = content.area.name
        bus.kill(name)
        bus.files[name] = content
        bus.start(name)
        bus.run(SCAN_S)
        behind = {f.area.name for f in old[k + 1 :]}
        for area, state in bus.states.items():
            assert (state.quality == GOOD) == (not behind)
            notes = [note for note in state.notes if note.startswith("the file of ") and "is older" in note]
            whose = {"this area" if other == area else other for other in behind}
            assert {note.removeprefix("the file of ").partition(" is older")[0] for note in notes} == whose


def test_files_of_a_version_without_splits_work_and_are_never_good():
    scenario = load_scenario("ieee33")
    files = [replace(f, split=None) for f in area_files_of(scenario, strategy="information")]
    bus, shown = run_with(files, scenario)
    assert {state.quality for state in shown if state.buses} == {"degraded"}
    for state in bus.states.values():
        assert any(note.startswith("the file of this area states no split") for note in state.notes)


def test_one_area_alone_with_an_edited_file_is_not_good():
    (content,) = stamp_split(area_files_of(load_scenario("ieee33"))[:1], time=0.0)
    alone = replace(content.area, neighbours=(), n_areas=1, towards_hub=None)
    content = stamp_split([replace(content, area=alone, strategy="information", links={})], time=0.0)[0]
    telemetry = {alone.name: make_telemetry(load_scenario("ieee33")).by_area[alone.name]}
    for own, is_good in ((content, True), (replace(content, tolerance=1e-5), False)):
        bus = SimulatedBus([own], telemetry)
        bus.run(SCAN_S)
        assert (bus.states[alone.name].quality == GOOD) == is_good, bus.states[alone.name].notes
