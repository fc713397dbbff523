"""What strangers announce costs a bounded amount, and hides nobody who is known."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from agents.messages.keys import gateway_key, live_key, name_of_live, readings_key, state_key
from agents.messages.packing import Header, Incarnation, ReadingsMessage, encode
from coordinator.show.web import sources
from coordinator.show.web.moment import Events, Moments, encode_json, find_links
from coordinator.show.web.sources import LiveSource
from coordinator.watch.observe import attachment as session
from coordinator.watch.observe import watched_keys
from coordinator.watch.observe import watcher as watch
from coordinator.watch.observe.run_address import RunAddress
from coordinator.watch.observe.updates import Updates
from coordinator.watch.observe.view_text import format_view
from coordinator.watch.observe.watched_keys import NAMED_BY_NEIGHBOUR
from coordinator.watch.observe.watcher import MOST_AREAS, Watcher
from tests.support.repeating import repeating
from tests.support.served import wait_for
from tests.support.shown_states import a_state, published_by

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
    watcher.take_state(published_by("mallory", ME), 0.0)
    assert watcher.states == {}


def test_names_that_come_and_go_are_not_kept_for_ever():
    events, watcher = Events(), Watcher("run")
    for k in range(500):
        key = live_key("run", "area", f"a{k}", ME)
        watcher.take_presence(key, True)
        view = watcher.look(float(k))
        events.take(float(k), view, find_links(view))
        watcher.take_presence(key, False)
    view = watcher.look(500.0)
    events.take(500.0, view, find_links(view))
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
    class Endless(deque):
        def popleft(self):
            updates.put("more")
            return super().popleft()

    updates = Updates()
    updates._waiting = Endless()
    for _ in range(3):
        updates.put("first")
    assert updates.take(0.0) == ["first"] * 3


def test_states_of_strangers_make_no_moment_line_or_table_longer_than_the_areas_that_are_shown():
    watcher = Watcher("run")
    watcher.take_state(a_state(buses=(7,)), 0.0)
    for k in range(3 * MOST_AREAS):
        watcher.take_state(published_by(f"0stranger{k}", ME, buses=(100 + k,)), 0.0)
        watcher.take_readings(ReadingsMessage(Header("run", f"0stranger{k}", ME, 1, 1, 0.0), 0.0, *[()] * 4))
    view = watcher.look(0.1)
    assert len(view.areas) == len(watcher.states) == MOST_AREAS
    assert len(watcher.readings) < MOST_AREAS
    assert "area1" in watcher.states, "who came first stays"
    assert view.strangers == 1 + 3 * MOST_AREAS - MOST_AREAS
    assert len(Moments(None).make(watcher, 0.1, 0.1)["buses"]["id"]) == MOST_AREAS
    text = format_view(view)
    assert f"{view.strangers} more are announced as areas and not shown" in text
    assert "800 areas more: --json has all" in text
    assert len(text.splitlines()) < 1000


def test_processes_that_strangers_announce_hide_no_plant_and_are_counted():
    watcher = Watcher("run")
    for k in range(500):
        watcher.take_presence(live_key("run", "<b>", f"0x{k}", ME), True)
    watcher.take_presence(live_key("run", "plant", "plant", ME), True)
    view = watcher.look(0.0)
    assert "plant plant" in view.others
    assert len(view.others) + view.more_others == 501
    assert len(view.others) <= 100
    assert "and 489 more" in " ".join(format_view(view).split())


def test_large_states_of_strangers_are_kept_up_to_a_number_of_bytes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(watch, "MOST_BYTES", 1000)
    unknown, known = Watcher("run"), Watcher("run", frozenset({"area1"}))
    for watcher in (unknown, known):
        for k in range(10):
            watcher.take_state(published_by(f"stranger{k}", ME), 0.0, 400)
        watcher.take_state(a_state(), 0.0, 400)
    assert list(unknown.states) == ["stranger0", "stranger1"]
    assert list(known.states) == ["area1"]
    unknown.take_state(published_by("stranger0", ME), 0.0, 100)
    unknown.take_state(published_by("stranger3", ME), 0.0, 400)
    assert list(unknown.states) == ["stranger0", "stranger1", "stranger3"], "a smaller state makes room"


def test_large_messages_that_nobody_takes_in_do_not_pile_up():
    updates = Updates(most_bytes=1000)
    for _ in range(2):
        for k in range(100):
            updates.offer(k, size=300)
        updates.offer("said once", sent_once=True, size=300)
        assert updates.take(0.0) == [0, 1, 2, "said once"]


class Bus:
    """Keeps what a watcher asks of its session."""

    keys, is_linked = None, staticmethod(lambda: True)

    def __init__(self) -> None:
        self.on = dict[str, Any]()
        self.tokens = set[str]()

    def subscribe(self, keys: str, callback: Any) -> None:
        self.on[keys] = callback

    def watch_presence(self, keys: str, callback: Any) -> None:
        self.on[keys] = callback
        self.tokens.add(keys)

    def asks_for(self, key: str) -> bool:
        """Whether anything that it asks for is shown on ``key``."""
        return any(_matches(keys, key) for keys in self.on)

    def say(self, key: str, payload: bytes = b"") -> None:
        for keys, callback in list(self.on.items()):
            if keys not in self.tokens and _matches(keys, key):
                callback(key, payload)


def _matches(keys: str, key: str) -> bool:
    return bool(re.fullmatch(re.escape(keys).replace(re.escape("*"), "[^/]*"), key))


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    """The one that watchers join."""
    made = Bus()

    @contextmanager
    def joined(*_: object) -> Iterator[tuple[Any, str]]:
        yield made, "run"

    monkeypatch.setattr(session, "join_run", joined)
    return made


def test_what_strangers_send_is_not_read_on_the_thread_that_holds_up_the_router(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
):
    read = list[bytes]()

    def decoded(key: str, payload: bytes) -> None:
        read.append(payload)

    monkeypatch.setattr(session, "_decoded", decoded)
    with session.attach(RunAddress((), "run", 1.0), areas=frozenset({"area1"})) as look:
        bus.on[state_key("run", "area1")](state_key("run", "area1"), b"area1")
        assert read == [], "the thread of the bus only puts it down"
        look(0.0)
    assert read == [b"area1"]


@pytest.mark.parametrize(("areas", "shows_strangers"), [(frozenset({"area1"}), False), (None, True)])
def test_a_watcher_that_knows_the_areas_asks_the_bus_for_nothing_of_strangers(
    bus: Bus, areas: frozenset[str] | None, shows_strangers: bool
):
    with session.attach(RunAddress((), "run", 1.0), areas=areas) as look:
        for name, is_heard in (("area1", True), ("stranger", shows_strangers)):
            assert {bus.asks_for(key) for key in (state_key("run", name), readings_key("run", name))} == {is_heard}
        bus.say(state_key("run", "area1"))
        bus.say(gateway_key("run", "north"))
        look(0.0)
    for version in ("/v", "/v9"):  # the other one is to be upgraded
        for role, name in (("area", "area1"), ("plant", "plant"), ("gateway", "north")):
            assert bus.asks_for(live_key("run", role, name, ME).replace("/v", version, 1)), name


@pytest.mark.parametrize("areas", [frozenset({"area1"}), None])
def test_nobody_asks_for_what_strangers_announce_before_they_say_something(bus: Bus, areas: frozenset[str] | None):
    with session.attach(RunAddress((), "run", 1.0), areas=areas) as look:
        bus.say(state_key("run", "area1"), encode(a_state()))
        bus.say(gateway_key("run", "north"))
        for name in ("*", "**", "$*", "a" * 65, "<b>"):
            bus.say(state_key("run", name))
            bus.say(gateway_key("run", name))
        look(0.0)
    for role in ("area", "gateway", "plant", "coordinator", "anything"):
        assert not bus.asks_for(live_key("run", role, "stranger", ME)), "neither tokens nor leave messages"
    assert {name_of_live(keys)[1] for keys in bus.tokens} >= {"area1", "north", "plant", "coordinator"}
    assert not {name_of_live(keys)[1] for keys in bus.tokens} & {"*", "**", "$*"}


def test_of_strangers_that_say_something_no_more_than_so_many_are_asked_for(bus: Bus, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(watched_keys, "MOST_ASKED", {"area": 3, NAMED_BY_NEIGHBOUR: 2, "gateway": 1})
    with session.attach(RunAddress((), "run", 1.0)) as look:
        named = {f"named{k}": (1, 1) for k in range(20)}
        for k in range(20):
            bus.say(state_key("run", f"a{k}"), encode(published_by(f"a{k}", ME, sent=named)))
            bus.say(gateway_key("run", f"g{k}"))
        look(0.0)
    asked = {name_of_live(keys)[1] for keys in bus.tokens}
    assert asked == {"plant", "coordinator", "a0", "a1", "a2", "named0", "named1", "g0"}


def test_an_area_that_has_just_said_something_is_not_gone_before_the_bus_has_said_so(bus: Bus):
    token = live_key("run", "area", "area1", ME)
    with session.attach(RunAddress((), "run", 1.0)) as look:
        bus.say(state_key("run", "area1"), encode(a_state()))
        (area,) = look(0.0).look(time.monotonic()).areas
        assert area.present
        on_token = next(callback for keys, callback in bus.on.items() if keys in bus.tokens and _matches(keys, token))
        on_token(token, True)
        on_token(token, False)
        (area,) = look(0.0).look(time.monotonic()).areas
        assert not area.present


def test_a_flood_does_not_make_a_watcher_look_more_often():
    bus, updates = Bus(), Updates()
    look = session.Attachment(Watcher("run"), updates, bus)  # type: ignore[arg-type]
    with repeating(lambda: updates.offer((live_key("run", "area", "a1", ME), True)), 0.0):
        began = time.monotonic()
        for _ in range(2):
            look.for_whole(0.1)
        assert time.monotonic() - began >= 2 * 0.1
