"""All area files of a running system are replaced by those of a new split, area by area, while scans go on."""

from __future__ import annotations

import queue
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from agents.area_files.reader import load_area_file
from agents.messages.keys import all_states
from agents.messages.packing import StateMessage, decode
from agents.protocol.quality import GOOD
from agents.transport.zenoh_bus import Session
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.split_identity import SplitIdentity
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.dsse_command import free_endpoint
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import DEADLINE_S

AREAS = ("area1", "area2", "area3")
RUN, EVERY_S = "ieee33", 0.5
LONGEST_GAP_S = 2.0  # without an estimate of an area
GAP = 1e-6  # p.u., of a good state to the centralised estimate of its split
BEFORE, AFTER = "{ from = 7, to = 8, r_ohm = 0.7114", "{ from = 7, to = 8, r_ohm = 0.75"


@pytest.mark.long
def test_all_areas_go_over_together_and_no_scan_is_without_an_estimate_for_long(dsse, tmp_path: Path):
    endpoint = free_endpoint()
    assert dsse("scenarios", "copy", RUN, "new").returncode == 0
    network = tmp_path / "new" / "network.toml"
    assert BEFORE in network.read_text()
    network.write_text(network.read_text().replace(BEFORE, AFTER))
    new = str(tmp_path / "new" / "ieee33.toml")
    for scenario, folder in ((RUN, "areas"), (new, "next")):
        assert dsse("split", scenario, "--out", folder, "--connect", endpoint).returncode == 0
    splits = {folder: load_area_file(tmp_path / folder / "area1.toml").identity for folder in ("areas", "next")}
    scenarios = {splits["areas"]: load_scenario(RUN), splits["next"]: load_scenario(new)}
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        for name in AREAS:
            system.start(name, "agent", f"areas/{name}.toml")
        system.start("plant", "plant", RUN, "--connect", endpoint, "--every", EVERY_S)
        with Session.connect([endpoint], DEADLINE_S) as session:
            states = States(session)
            states.wait_until_good(splits["areas"])
            for name in AREAS:
                shutil.copy(tmp_path / "next" / f"{name}.toml", tmp_path / "areas" / f"{name}.next.toml")
                if name != AREAS[-1]:
                    states.wait_until(lambda name=name: states.newest[name].next_split == splits["next"])
            states.wait_until(lambda: {s.split for s in states.newest.values()} == {splits["next"]})
            assert system.end("plant") == 0
            system.start("plant", "plant", new, "--connect", endpoint, "--every", EVERY_S)
            states.wait_until_good(splits["next"])
        assert all(load_area_file(tmp_path / "areas" / f"{name}.toml").identity == splits["next"] for name in AREAS)
        assert all(process.poll() is None for process in system.processes.values())
    assert states.longest_gap_s <= LONGEST_GAP_S
    good = [state for state in states.all if state.quality == GOOD]
    assert {state.split for state in good} == {*scenarios}
    assert [state for state in good if gap_of(state, scenarios[state.split]) > GAP] == []


class States:
    """What the areas show, by arrival."""

    def __init__(self, session: Session) -> None:
        self.all: list[StateMessage] = []
        self.newest: dict[str, StateMessage] = {}
        self._estimated_at: dict[str, float] = {}
        self.longest_gap_s = 0.0  # by the send times of states with an estimate
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        session.subscribe(all_states(RUN), lambda key, payload: self._received.put(payload))

    def wait_until(self, holds: object) -> None:
        assert callable(holds)
        deadline = time.monotonic() + DEADLINE_S
        while not (self.newest.keys() == {*AREAS} and holds()):
            assert time.monotonic() < deadline, {name: (s.quality, s.notes) for name, s in self.newest.items()}
            state = decode(self._received.get(timeout=DEADLINE_S))
            assert isinstance(state, StateMessage)
            self.all.append(state)
            self.newest[state.header.sender] = state
            if state.buses:
                self._note_estimate(state)

    def wait_until_good(self, split: SplitIdentity) -> None:
        self.wait_until(lambda: all((s.quality, s.split) == (GOOD, split) for s in self.newest.values()))

    def _note_estimate(self, state: StateMessage) -> None:
        name, at = state.header.sender, state.header.time
        self.longest_gap_s = max(self.longest_gap_s, at - self._estimated_at.get(name, at))
        self._estimated_at[name] = at


def gap_of(state: StateMessage, scenario: Scenario) -> float:
    """To the centralised estimate of the readings of its scan, p.u."""
    result = process_bad_data(scenario.network, make_telemetry(scenario, state.header.scan).union).result
    voltages = result.vm * np.exp(1j * result.va)
    centre = dict(zip((bus.id for bus in scenario.network.buses), voltages.tolist(), strict=True))
    found = np.array(state.vm) * np.exp(1j * np.array(state.va))
    return float(max(abs(found - np.array([centre[bus] for bus in state.buses]))))
