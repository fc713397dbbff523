"""A simulated run is played while it is computed."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest

from agents.messages.packing import Message
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.simulator.simulate import Simulation
from coordinator.show.web.playback import growing
from coordinator.show.web.playback.growing import GrowingPlayback
from coordinator.show.web.playback.play import Play
from tests.support.served import client, played, wait_for

NAME = "industrial13-lossy"


@pytest.fixture
def halted(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """The simulation waits after 24 notes of messages until this is set."""
    goes_on, seen, take = threading.Event(), list[float](), growing._Watched.take_message

    def take_message(self: Any, at: float, receiver: str, message: Message, arrives: bool) -> None:
        seen.append(at)
        if len(seen) > 24:
            goes_on.wait(60)
        take(self, at, receiver, message, arrives)

    monkeypatch.setattr(growing._Watched, "take_message", take_message)
    monkeypatch.setattr(growing, "GROW_S", 0.02)
    return goes_on


def test_the_first_moments_are_played_before_the_run_is_over_and_stay_as_they_are(halted: threading.Event):
    said: list[str] = []
    source = GrowingPlayback(choose_scenario(NAME), lambda: said.append("complete"))
    source.start()
    try:
        asked = client(source)
        wait_for(lambda: len(source.times()) > 2)
        early = asked.get("/api/frames").json()
        assert not early["complete"]
        assert "the simulation goes on" in early["remarks"][0]
        assert said == []
        frames = [asked.get(f"/api/frame/{k}").json() for k in range(len(early["times"]))]
        halted.set()
        wait_for(lambda: source.is_complete and bool(said))
        late = asked.get("/api/frames").json()
        assert late["times"][: len(early["times"])] == early["times"]
        assert (late["complete"], late["remarks"], said) == (True, [], ["complete"])
        for k, frame in enumerate(frames):
            assert asked.get(f"/api/frame/{k}").json() == frame
        assert late["times"] == list(played(NAME).times())
    finally:
        halted.set()
        source.close()


def test_who_leaves_ends_the_simulation(halted: threading.Event):
    source = GrowingPlayback(choose_scenario(NAME), lambda: pytest.fail("it is not complete"))
    source.start()
    before = threading.active_count()
    halted.set()
    source.close()
    assert threading.active_count() < before


def test_a_simulation_that_fails_is_played_as_far_as_it_came_and_the_page_says_why(monkeypatch: pytest.MonkeyPatch):
    run = Simulation.run

    def fails(self: Simulation) -> str | None:
        run(self)
        raise RuntimeError("a defect")

    monkeypatch.setattr(Simulation, "run", fails)
    source = GrowingPlayback(choose_scenario(NAME))
    source.start()
    try:
        wait_for(lambda: source.is_complete)
        assert source.remarks == ("the simulation has failed here: a defect",)
        assert json.loads(source.newest.payload)["view"]["areas"]
    finally:
        source.close()


def test_a_simulation_that_fails_before_anything_has_happened_is_an_error(monkeypatch: pytest.MonkeyPatch):
    def fails(self: Simulation) -> str | None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(Simulation, "run", fails)
    monkeypatch.setattr(Play, "_take", lambda *_: None)
    with pytest.raises(RuntimeError, match="a defect"):
        GrowingPlayback(choose_scenario(NAME)).start()
