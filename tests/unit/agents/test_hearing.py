"""Of each sender the newest life counts, unless it is over and the clock of the next one was set back."""

from __future__ import annotations

from dataclasses import replace

from agents.freshness import find_fresh
from agents.hearing import OVER_BEATS, Hearing
from agents.messages import BoundaryMessage, Header, Incarnation, LoadMessage, TelemetryMessage

BEAT_S = 0.2
OVER_S = OVER_BEATS * BEAT_S
FIRST, SET_BACK = Incarnation(2_000, 1), Incarnation(1_000, 2)


def header(life: Incarnation, sequence: int = 1) -> Header:
    return Header("run", "area2", life, scan=1, sequence=sequence, time=0.0)


def load(life: Incarnation, p: float, sequence: int = 1) -> LoadMessage:
    return LoadMessage(header(life, sequence), 6, p, 0.0, 0.1)


def test_neither_a_repeat_nor_an_older_word_is_new():
    hearing = Hearing(BEAT_S)
    assert hearing.take(load(FIRST, 1.0, sequence=2), 0.0)
    assert not hearing.take(load(FIRST, 1.0, sequence=2), 0.1)
    assert not hearing.take(load(FIRST, 3.0, sequence=1), 0.1)
    assert hearing.take(load(FIRST, 3.0, sequence=3), 0.1)


def test_a_former_life_is_not_heard_while_the_newest_speaks():
    hearing = Hearing(BEAT_S)
    hearing.take(load(FIRST, 1.0), 0.0)
    hearing.take(load(FIRST, 1.0), OVER_S)  # a repeat
    hearing.take(load(SET_BACK, 2.0), 1.9 * OVER_S)
    assert hearing.loads["area2"].p == 1.0


def test_a_restarted_area_whose_clock_was_set_back_is_heard_once_its_former_life_is_over():
    hearing = Hearing(BEAT_S)
    hearing.take(load(FIRST, 1.0, sequence=9), 0.0)
    hearing.take(load(SET_BACK, 2.0), 0.9 * OVER_S)
    assert hearing.loads["area2"].p == 1.0
    hearing.take(load(SET_BACK, 2.0), 1.1 * OVER_S)
    hearing.take(load(SET_BACK, 3.0, sequence=2), 1.2 * OVER_S)
    assert hearing.loads["area2"].p == 3.0


def test_an_old_word_of_the_same_life_is_never_taken_however_long_it_was_silent():
    hearing = Hearing(BEAT_S)
    hearing.take(load(FIRST, 1.0, sequence=9), 0.0)
    hearing.take(load(FIRST, 2.0, sequence=8), 5 * OVER_S)
    assert hearing.loads["area2"].p == 1.0


def test_a_plant_whose_clock_was_set_back_is_heard_once_its_former_life_is_over():
    hearing = Hearing(BEAT_S)
    telemetry = TelemetryMessage(header(FIRST, 5), "area1", (), (), (), (), ())
    set_back = replace(telemetry, header=header(SET_BACK))
    assert hearing.take_telemetry(telemetry, 0.0)
    assert not hearing.take_telemetry(set_back, 0.9 * OVER_S)
    assert hearing.take_telemetry(set_back, 1.1 * OVER_S)
    assert hearing.telemetry == set_back


def test_information_of_a_later_scan_is_used_only_as_long_as_it_is_heard():
    hearing = Hearing(BEAT_S)
    own = TelemetryMessage(replace(header(FIRST), sender="plant"), "area1", (), (), (), (), ())
    hearing.take_telemetry(own, 0.0)
    ahead = BoundaryMessage(replace(header(FIRST), scan=2), 6, 1.0, 0.0, True)
    hearing.take(ahead, 1.0)
    assert hearing.usable(1.5) == {"area2": ahead}
    assert hearing.usable(1.7) == {}  # its scan was that of a plant that is no more, and so is its sender


def boundary(time: float, fresh: bool, vm: float = 1.0) -> BoundaryMessage:
    return BoundaryMessage(replace(header(FIRST), time=time), 6, vm, 0.0, True, fresh)


def test_of_two_repeats_the_later_one_says_whether_all_is_fresh_and_nothing_else_changes():
    hearing = Hearing(BEAT_S)
    hearing.take(boundary(1.0, True), 1.0)
    hearing.take(boundary(3.0, True), 3.1)
    hearing.take(boundary(2.0, False, vm=2.0), 3.2)  # overtaken
    assert hearing.boundary["area2"] == boundary(3.0, True)
    hearing.take(boundary(4.0, False, vm=2.0), 4.1)
    assert hearing.boundary["area2"] == boundary(4.0, False)


def test_what_is_passed_on_may_be_half_a_beat_older():
    hearing = Hearing(BEAT_S)
    own = TelemetryMessage(replace(header(FIRST), sender="plant"), "area1", (), (), (), (), ())
    hearing.take_telemetry(own, 0.0)
    hearing.take(boundary(0.0, True), 0.0)
    now = 3.2 * BEAT_S
    assert (hearing.find_old(["area2"], now), hearing.is_late(now)) == ({"area2"}, True)
    assert find_fresh(hearing, ["area2", "area3"], set(), now) == {"area2": False, "area3": True}
    assert find_fresh(hearing, ["area2"], set(), now) == {"area2": True}
    assert find_fresh(hearing, ["area2"], set(), 3.6 * BEAT_S) == {"area2": False}
