"""What strangers announce costs a bounded amount, and hides nobody who is known."""

from __future__ import annotations

from served import wait_for
from shown_states import a_state, said_by

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.observe.watch import Watcher
from coordinator.process_run.processes import Updates
from coordinator.web import sources
from coordinator.web.moment import MOST_AREAS, Events, Moments, encode_json
from coordinator.web.sources import LiveSource

ME = Incarnation(1, 1)
CROWD = 100_000


def crowded(areas: frozenset[str] | None) -> Watcher:
    """A hundred thousand areas are announced before area1 is there."""
    watcher = Watcher("run", areas)
    for k in range(CROWD):
        watcher.take_presence(live_key("run", "area", f"a{k}", ME), True)
    watcher.take_presence(live_key("run", "area", "area1", ME), True)
    watcher.take_state(a_state(), 0.0)
    return watcher


def test_a_hundred_thousand_strangers_take_no_place_of_an_area_of_the_scenario():
    view = crowded(frozenset({"area1", "area2"})).look(0.1)
    assert [(area.name, area.present, area.quality) for area in view.areas if area.estimated] == [
        ("area1", True, "good")
    ]
    assert len(view.areas) <= 2
    assert view.strangers > 10_000


def test_what_is_sent_of_a_hundred_thousand_areas_is_bounded_and_begins_with_who_estimates():
    watcher = crowded(None)
    moments = Moments(None)
    for at in range(3):
        moment = moments.make(watcher, float(at), float(at))
    assert len(moment["view"]["areas"]) == MOST_AREAS
    assert "area1" in moment["view"]["areas"]
    assert moment["view"]["strangers"] > 10_000
    assert len(encode_json(moment)) < 3_000_000


def test_a_state_of_a_stranger_is_no_state_of_the_scenario():
    watcher = Watcher("run", frozenset({"area1"}))
    watcher.take_state(said_by("mallory", ME), 0.0)
    assert watcher.states == {}


def test_names_that_come_and_go_are_not_kept_for_ever():
    events, watcher = Events(), Watcher("run")
    for k in range(500):
        key = live_key("run", "area", f"a{k}", ME)
        watcher.take_presence(key, True)
        events.take(float(k), watcher.look(float(k)))
        watcher.take_presence(key, False)
    events.take(500.0, watcher.look(500.0))
    assert len(events._before) == 0
    assert events.kept[-1] == {"time": 500.0, "area": "a499", "kind": "vanished", "text": "is gone"}


def test_a_flood_on_the_bus_does_not_make_more_moments(monkeypatch):
    monkeypatch.setattr(sources, "UPDATE_S", 1000.0)
    watcher, looks = Watcher("run"), []

    def look(duration_s: float) -> Watcher:
        """Something has always just arrived."""
        looks.append(duration_s)
        return watcher

    source = LiveSource(look, None, "run")
    source.start()
    try:
        wait_for(lambda: len(looks) > 1000)
    finally:
        source.close()
    assert source.newest.number == 1


def test_what_arrives_while_one_takes_waits_for_the_next_time():
    class Endless(Updates):
        def get_nowait(self):
            self.put("more")
            return super().get_nowait()

    updates = Endless()
    for _ in range(3):
        updates.put("first")
    assert updates.take(0.0) == ["first"] * 3
