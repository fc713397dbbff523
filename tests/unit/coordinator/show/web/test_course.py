"""Any moment of a play is found without going there from the beginning, and a play of any length stays bounded."""

from __future__ import annotations

import json
from typing import Any

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation, StateMessage
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.simulator.simulate import Simulation
from coordinator.show.web.playback import course as course_of_play
from coordinator.show.web.playback import play as plays
from coordinator.show.web.playback import source as sources
from coordinator.show.web.playback.course import WatchedPlay
from coordinator.show.web.playback.play import IN_SIMULATION, Play, Sent
from coordinator.show.web.playback.source import PlaybackSource
from coordinator.watch.observe.watcher import Watcher
from coordinator.watch.replay.recorded_messages import Presence
from tests.support.shown_states import published_by

TOKEN = live_key("run", "area", "area2", IN_SIMULATION)


def play_of(scenario: str) -> Play:
    play = Play()
    Simulation(choose_scenario(scenario), subscriber=play).run()
    return play


def long_play(updates: int) -> Play:
    """Of two areas, of which one comes and goes once."""
    play = Play(run="run")
    play.updates = [
        (float(k), published_by(f"area{1 + k % 2}", Incarnation(1, k + 1), objective=float(k))) for k in range(updates)
    ]
    third = updates // 3
    play.updates[third : third + 1] = [(third + 0.1, Presence(TOKEN, True)), (third + 0.2, Presence(TOKEN, False))]
    return play


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[StateMessage]:
    """All states that watchers have taken in."""
    taken: list[StateMessage] = []
    take = Watcher.take_state

    def note(watcher: Watcher, state: StateMessage, *more: Any) -> None:
        taken.append(state)
        take(watcher, state, *more)

    monkeypatch.setattr(Watcher, "take_state", note)
    return taken


@pytest.mark.parametrize("scenario", ["ieee33-cut", "ieee33-restart"])
def test_each_moment_is_that_of_who_was_there_from_the_beginning(scenario: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(course_of_play, "STEP", 3)
    play = play_of(scenario)
    course, witness, k = WatchedPlay(play, None), Watcher(play.run), 0
    times = sorted({at for at, _ in play.updates})
    for at in times:
        while k < len(play.updates) and play.updates[k][0] <= at:
            course_of_play._show(witness, *play.updates[k])
            k += 1
        found = course.watcher_at(at)
        assert found.look(at + 1.0) == witness.look(at + 1.0)
        assert found.readings == witness.readings


def test_moving_the_slider_does_not_go_from_the_beginning(taken: list[StateMessage]):
    source = PlaybackSource(long_play(5000), None)
    taken.clear()
    for number in (4990, 10, 2500):
        source.frame(number)
    assert len(taken) <= 3 * course_of_play.STEP


def test_watchers_that_are_kept_do_not_change_as_others_go_on():
    course = WatchedPlay(long_play(200), None)
    before = course.watcher_at(70.0).look(70.0)
    course.watcher_at(127.0).take_presence(TOKEN, True)
    assert course.watcher_at(70.0).look(70.0) == before


def test_a_play_of_very_many_moments_is_looked_at_a_thousand_times_and_nobody_comes_or_goes_unseen():
    course = WatchedPlay(long_play(5000), None)
    assert len(list(course.walk())) <= course_of_play.MOST_LOOKS + 3
    events = [(event["area"], event["kind"]) for event in course.find_events().kept]
    assert events.count(("area2", "appeared")) == 1
    assert events.count(("area2", "vanished")) == 2  # it had never been there at the first look


def test_a_run_that_is_too_long_is_kept_to_its_first_part_and_said_to_be(monkeypatch: pytest.MonkeyPatch):
    whole = play_of("ieee33-lossy")
    times = PlaybackSource(whole, None).times()
    assert len(times) > 10
    with monkeypatch.context() as patch:
        patch.setattr(plays, "MOST_MESSAGES", 20)
        source = PlaybackSource(play_of("ieee33-lossy"), None)
    assert source.remarks == ("the run is long: its first part is played",)
    assert len(source._play.messages) == 20
    monkeypatch.setattr(sources, "MOST_FRAMES", 10)
    source = PlaybackSource(whole, None)
    assert source.remarks == ("the run is long: its first part is played",)
    assert source.times() == times[:10]


def test_a_message_is_shown_from_when_it_is_sent_until_it_has_arrived():
    play = long_play(10)
    play.messages = [
        Sent("area1", "area2", "slow", 0.5, 7.5),
        Sent("area2", "area1", "lost", 1.5, None),
        Sent("area1", "area2", "fast", 2.5, 2.75),
    ]
    source = PlaybackSource(play, None)
    seen = {at: [m["kind"] for m in json.loads(source.frame(k))["messages"]] for k, at in enumerate(source.times())}
    assert [at for at, kinds in seen.items() if "slow" in kinds] == [at for at in seen if 0.5 <= at <= 7.5]
    assert [at for at, kinds in seen.items() if "lost" in kinds] == [1.5]
    assert [at for at, kinds in seen.items() if "fast" in kinds] == [2.5, 2.75]


def test_a_moment_of_a_play_does_not_say_since_when_a_limit_is_exceeded():
    numbers = {"buses": (1,), "vm": (0.5,), "va": (0.0,), "sigma_vm": (0.1,), "sigma_va": (0.1,)}
    state = published_by("area2", Incarnation(1, 1), **numbers)
    play = Play(run="run", updates=[(0.0, Presence(TOKEN, True)), (1.0, state), (2.0, state)])
    moments = [json.loads(PlaybackSource(play, None).frame(k)) for k in (1, 2)]
    found = [[cause["since"] for cause in m["causes"] if cause["kind"] == "low voltage"] for m in moments]
    assert found == [[None], [None]]
