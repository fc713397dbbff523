"""Whose word an area waits for in a new scan: it costs no processor time, starves nobody, and ends."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from feeders import make_feeder
from simulated_bus import SimulatedBus, area_files_of

from agents.events import Event, PresenceChanged, Publish, Received
from agents.messages import Header, Incarnation, InformationMessage, StateMessage
from agents.protocol import AreaProtocol
from agents.strategies import make_strategy
from agents.strategies.interface import Estimate, Knowledge
from agents.turn import ANSWER_S, LONGEST_TALK_S, Turn
from coordinator.telemetry_messages import make_message
from coordinator.twin import STARTED_AT
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

SCENARIO = load_scenario("ieee33")  # area1 stands between area2 and area3
BEAT_S = 2.0


@pytest.fixture
def bus() -> SimulatedBus:
    """Three areas at rest."""
    files = area_files_of(SCENARIO, strategy="information", beat_s=BEAT_S)
    bus = SimulatedBus(files, make_telemetry(SCENARIO).by_area)
    bus.run_until_settled()
    bus.run(1.0)
    return bus


def readings_of(bus: SimulatedBus, area: str, scan: int) -> Received:
    header = Header(bus.files[area].run, "plant", Incarnation(0, 0), scan, scan, bus.states[area].header.time)
    return Received(make_message(header, area, make_telemetry(SCENARIO, scan=scan).by_area[area]), "")


def word_of(bus: SimulatedBus, sender: str, to: str) -> InformationMessage:
    """The last one that was delivered."""
    words = [m for _, s, r, m in bus.delivered if (s, r) == (sender, to) and isinstance(m, InformationMessage)]
    return words[-1]


def changed(word: InformationMessage, k: int, scan: int) -> Received:
    header = replace(word.header, scan=scan, sequence=word.header.sequence + k)
    return Received(replace(word, header=header, z=tuple(z * (1 + 0.01 * (k % 2)) for z in word.z)), word.header.sender)


def words_by(protocol: AreaProtocol, events: list[Event], now: float) -> list[tuple[str, InformationMessage]]:
    """Who is told what of the boundary."""
    actions = [a for a in protocol.handle(events, now) if isinstance(a, Publish)]
    return [(a.to, a.message) for a in actions if isinstance(a.message, InformationMessage) and a.to]


def words_until_idle(protocol: AreaProtocol, events: list[Event], now: float) -> list[tuple[str, InformationMessage]]:
    """All that ``protocol`` says at time ``now``."""
    words = words_by(protocol, events, now)
    while protocol.wait_s(now) == 0.0:
        words += words_by(protocol, [], now)
    return words


def told_by(protocol: AreaProtocol, events: list[Event], now: float) -> set[str]:
    """Who is told something of the boundary."""
    return {to for to, _ in words_by(protocol, events, now)}


def told_until_idle(protocol: AreaProtocol, events: list[Event], now: float) -> set[str]:
    return {to for to, _ in words_until_idle(protocol, events, now)}


def test_a_repeat_makes_nobody_solve(bus, monkeypatch):
    protocol = bus.protocols["area1"]
    solved = []
    solve = protocol._strategy.solve
    monkeypatch.setattr(protocol._strategy, "solve", lambda known: solved.append(known) or solve(known))
    last = {(s, type(m)): m for _, s, r, m in bus.delivered if r == "area1"}
    assert len(last) == 6  # load, information and tally from both neighbours
    assert list(protocol.handle([Received(m, s) for (s, _), m in last.items()], bus.now)) == []
    older = replace(word_of(bus, "area2", "area1"), fresh=False)
    assert list(protocol.handle([Received(older, "area2")], bus.now)) == [], "at the same time it says nothing new"
    assert not solved
    list(protocol.handle([changed(word_of(bus, "area2", "area1"), 1, bus.scan)], bus.now))
    assert solved


def test_a_repeat_that_is_no_longer_fresh_shows_at_once_and_makes_nobody_solve(bus, monkeypatch):
    protocol = bus.protocols["area1"]
    assert bus.states["area1"].quality == "good"
    monkeypatch.setattr(protocol._strategy, "solve", lambda known: pytest.fail("it solves"))
    word = word_of(bus, "area2", "area1")
    repeat = replace(word, header=replace(word.header, time=word.header.time + 1.0), fresh=False)
    actions = list(protocol.handle([Received(repeat, "area2")], bus.now))
    (state,) = [a.message for a in actions if isinstance(a, Publish) and isinstance(a.message, StateMessage)]
    assert (state.quality, state.old_sides) == ("degraded", ("area2",))
    assert state.header.sequence == bus.states["area1"].header.sequence
    assert [a.to for a in actions if isinstance(a, Publish) and isinstance(a.message, InformationMessage)] == ["area3"]


def test_an_iteration_that_ran_out_of_steps_goes_on_at_the_areas_own_beat(bus, monkeypatch):
    protocol = bus.protocols["area1"]
    solved = []
    solve = protocol._strategy.solve
    monkeypatch.setattr(protocol._strategy, "solve", lambda known: solved.append(known) or solve(known))
    list(protocol.handle([], bus.now))
    assert not solved
    list(protocol.handle([], bus.now + protocol.wait_s(bus.now)))
    assert solved


def test_answers_are_awaited_anew_after_each_word_and_not_for_ever():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    assert turn.show_at == 1.0 + ANSWER_S
    turn.await_answer("area2", 1.002)
    assert turn.show_at == 1.002 + ANSWER_S
    turn.await_answer("area2", 1.0 + LONGEST_TALK_S)
    assert turn.show_at == 1.0 + LONGEST_TALK_S


def test_after_the_last_answer_nothing_is_waited_for():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    turn.await_answer("area3", 1.0)
    turn.take_answer("area3")
    assert not turn.may_show(1.0)
    turn.take_answer("area1")
    assert not turn.may_show(1.0), "nobody has asked it"
    turn.take_answer("area2")
    assert turn.may_show(1.0)


def test_the_latest_answer_that_is_missing_is_waited_for():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    turn.await_answer("area3", 1.004)
    turn.take_answer("area3")
    assert turn.show_at == 1.0 + ANSWER_S


def test_nothing_is_shown_while_somebody_is_awaited_and_then_answers_are_not():
    turn = Turn()
    turn.awaited = {"area2"}
    turn.await_answer("area2", 2.0)
    assert not turn.may_show(2.0)
    assert turn.next_due() == math.inf
    turn.awaited = set()
    assert turn.may_show(2.0)


def test_only_the_one_awaited_is_told_anything():
    turn = Turn()
    turn.awaited = {"area2"}
    assert (turn.may_tell("area2", 2.0), turn.may_tell("area3", 2.0), turn.is_held_back) == (True, False, False)
    assert not turn.has_more(2.0)
    turn.awaited = {"area2", "area3"}
    assert turn.is_held_back
    turn.awaited = set()
    assert turn.has_more(2.0), "area3 is still to be told"


def test_who_has_not_answered_is_told_more_after_the_answer_or_when_it_is_no_longer_waited_for():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    turn.await_answer("area3", 1.001)
    assert [turn.may_tell(name, 1.002) for name in ("area2", "area3", "area4")] == [False, False, True]
    assert (turn.next_due(), turn.has_more(1.002)) == (1.0 + ANSWER_S, False)
    turn.take_answer("area3")
    assert turn.next_due() < 1.002, "it can be told at once"
    assert turn.has_more(1.002)
    assert [turn.may_tell(name, 1.002) for name in ("area2", "area3")] == [False, True]
    assert not turn.has_more(1.002)
    assert turn.has_more(1.0 + ANSWER_S)
    assert turn.may_tell("area2", 1.0 + ANSWER_S)
    assert not turn.held


def test_nothing_is_shown_before_everybody_has_been_told_everything():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    turn.show()
    assert turn.may_show(1.001)
    assert not turn.may_tell("area2", 1.001), "it is still answering what it was told before that"
    assert not turn.may_show(1.001)
    assert turn.next_due() == 1.0 + ANSWER_S


def test_after_the_longest_talk_a_state_is_shown_and_who_was_held_goes_on_waiting():
    turn = Turn()
    turn.await_answer("area2", 1.0)
    over = 1.0 + LONGEST_TALK_S
    turn.await_answer("area2", over - 0.001)
    assert not turn.may_tell("area2", over)
    assert not turn.may_show(over - 1e-9)
    assert turn.may_show(over)
    turn.show()
    assert (turn.held, turn.may_show(over)) == ({"area2"}, False)
    assert turn.next_due() == over - 0.001 + ANSWER_S


def test_areas_say_little_more_where_messages_take_their_own_time():
    """Each word of a neighbour would else be passed on to all others, and come back by as many ways."""
    feeder = make_feeder(4, 60, 20, shape=0.8)
    most = []
    for jitter_s in (0.0, 0.002):
        bus = SimulatedBus(feeder.area_files(0.0, 0, jitter_s=jitter_s), feeder.telemetry())
        bus.run(0.2)
        assert bus.settled
        words = [message.header.sequence for *_, message in bus.delivered if isinstance(message, InformationMessage)]
        most.append(max(words))
    assert most[0] < most[1] < 2 * most[0]


def test_nothing_final_is_judged_with_a_neighbour_whose_next_word_is_held_back(bus, monkeypatch):
    """Two words of each in turn: the second one is passed on after the answer to the first, beyond the longest talk."""
    area1, start = bus.protocols["area1"], bus.now
    judge, missing = area1._strategy.judge, []

    def watched(known: Knowledge, estimate: Estimate) -> tuple[Estimate, tuple[str, ...]]:
        missing.append({"area2", "area3"} - known.sent.keys())
        return judge(known, estimate)

    monkeypatch.setattr(area1._strategy, "judge", watched)
    for k in range(1, 28):
        name = ("area2", "area2", "area3", "area3")[k % 4]
        words_until_idle(area1, [changed(word_of(bus, name, "area1"), k, bus.scan)], start + 0.001 * k)
        assert not missing or missing == [{"area2", "area3"} - {name}]
    assert missing


def test_an_area_that_is_held_back_in_the_middle_of_its_steps_sleeps(bus):
    area1 = bus.protocols["area1"]
    list(area1.handle([changed(word_of(bus, "area2", "area1"), 1, scan=1)], bus.now))
    assert area1.wait_s(bus.now) == 0.0, "there are steps to go"
    list(area1.handle([readings_of(bus, "area1", 2)], bus.now))
    assert area1.wait_s(bus.now) > 0.0


def test_a_repeat_is_no_answer(bus):
    """The doorkeeper hands on a payload that repeats the last one as the very message that it was."""
    protocol, now = bus.protocols["area1"], bus.now
    news: list[Event] = [changed(word_of(bus, name, "area1"), 1, scan=1) for name in ("area2", "area3")]
    assert told_until_idle(protocol, news, now) == {"area2", "area3"}

    def shows(events: list[Event], at: float) -> bool:
        actions = [a for a in protocol.handle(events, at) if isinstance(a, Publish)]
        return any(isinstance(a.message, StateMessage) for a in actions)

    assert not shows(news, now + ANSWER_S / 2)
    assert shows([], now + 2 * ANSWER_S)


def test_what_is_held_back_while_a_neighbour_is_awaited_is_told_once_the_wait_is_over(bus):
    """A new life of area3 still has the readings of the former scan."""
    area1, now = bus.protocols["area1"], bus.now
    words = {name: word_of(bus, name, "area1") for name in ("area2", "area3")}
    news: list[Event] = [changed(word, 1, scan=2) for word in words.values()]
    told = dict(words_until_idle(area1, [readings_of(bus, "area1", 2), *news], now))
    assert told.keys() == {"area2", "area3"}
    former = words["area3"].header
    header = replace(former, incarnation=replace(former.incarnation, start_ms=former.incarnation.start_ms + 1))
    late = changed(replace(words["area3"], header=header), 2, scan=1)
    now += 2 * ANSWER_S
    assert told_until_idle(area1, [late], now) == {"area3"}
    later = {}
    while area1._turn.awaited:
        now += area1.wait_s(now)
        later |= dict(words_until_idle(area1, [], now))
    assert later["area2"].header.sequence == told["area2"].header.sequence + 1


def test_a_word_is_not_called_fresh_while_another_that_rests_on_more_is_held_back(bus):
    area1, now = bus.protocols["area1"], bus.now
    words = {name: word_of(bus, name, "area1") for name in ("area2", "area3")}
    told_until_idle(area1, [readings_of(bus, "area1", 2), changed(words["area2"], 1, scan=2)], now)
    while not (told := words_until_idle(area1, [], now)):
        now += area1.wait_s(now)
    last = next(word for to, word in told if to == "area2")
    assert not last.fresh, "area3 is silent about the scan"
    told = words_until_idle(area1, [changed(words["area3"], 1, scan=2)], now + 0.001)
    assert not [word for to, word in told if to == "area2"], "it has not answered yet"
    told = words_until_idle(area1, [], now + ANSWER_S)
    (word,) = [word for to, word in told if to == "area2"]
    assert word.fresh
    assert word.header.sequence == last.header.sequence + 1


def test_a_new_scan_waits_for_no_answer_to_the_last_one(bus):
    area1, now = bus.protocols["area1"], bus.now
    words = {name: word_of(bus, name, "area1") for name in ("area2", "area3")}
    news: list[Event] = [changed(word, 1, scan=1) for word in words.values()]
    assert told_until_idle(area1, news, now) == {"area2", "area3"}
    told_until_idle(area1, [changed(word, 2, scan=2) for word in words.values()], now + 0.001)
    assert told_until_idle(area1, [readings_of(bus, "area1", 2)], now + 0.001) == {"area2", "area3"}


def test_a_neighbour_that_a_new_life_has_never_told_anything_is_told_once_the_wait_is_over(bus):
    """It had not yet spoken when a scan began in which the other neighbour was awaited: nothing has changed since."""
    content, start = bus.files["area1"], bus.now
    life = AreaProtocol(
        content, make_strategy(content), Incarnation(2**41, 1), now=start, started_at=STARTED_AT + start
    )
    words = [changed(word_of(bus, name, "area1"), 2, scan) for name, scan in (("area2", 2), ("area3", 1))]
    there = [PresenceChanged(name, alive=True) for name in ("area2", "area3")]
    assert told_by(life, [*there, *words, readings_of(bus, "area1", 1)], start) == set()
    now = start + 0.01
    told = told_until_idle(life, [readings_of(bus, "area1", 2)], now)
    assert told == {"area3"}, "whose own word is awaited"
    now += life.wait_s(now)
    assert "area2" in told_until_idle(life, [], now)


def test_who_has_no_readings_is_not_waited_for_in_every_scan(bus):
    for _ in range(3):
        bus.next_scan(make_telemetry(SCENARIO, scan=bus.scan + 1).by_area, late_s={"area3": 1e6})
        bus.run(BEAT_S / 20)
    assert word_of(bus, "area1", "area2").header.scan == bus.scan


def test_each_scan_is_shown_although_a_neighbour_is_slower_than_scans_come(bus):
    bus.pause("area3")
    for _ in range(4):
        bus.next_scan(make_telemetry(SCENARIO, scan=bus.scan + 1).by_area)
        bus.run(BEAT_S / 20)
        if bus.scan > 2:  # nothing is known before of how fast they come
            assert (bus.states["area1"].header.scan, bus.states["area2"].header.scan) == (bus.scan, bus.scan)


def test_news_before_every_step_leaves_an_estimate_all_the_same(bus):
    area2, word = bus.protocols["area2"], word_of(bus, "area1", "area2")
    list(area2.handle([readings_of(bus, "area2", 2)], bus.now))
    states = []
    for k in range(1, 201):
        actions = area2.handle([changed(word, k, scan=2)], bus.now + 0.001 * k)
        states += [a.message for a in actions if isinstance(a, Publish) and isinstance(a.message, StateMessage)]
    assert states
    assert states[-1].buses
    assert states[-1].quality == "degraded"
