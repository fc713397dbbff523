"""Who watches tells an area or a plant that runs twice from one that was started again."""

from __future__ import annotations

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from agents.runtime.duplicate_guard import GIVES_WAY, OVERLAP_S
from coordinator.observe.duplicates import SURE_S, Double, Doubles

LIVES = [Incarnation(start, 1) for start in (1, 2)]


def tokens(role: str, name: str) -> list[str]:
    return [live_key("run", role, name, life) for life in LIVES]


@pytest.mark.parametrize(("role", "name"), [("area", "area1"), ("plant", "plant")])
def test_two_that_are_there_for_long_are_told_once_with_both_lives(role: str, name: str):
    assert SURE_S < OVERLAP_S, "or the older one has gone before it is told"
    doubles = Doubles(beat_s=0.2)
    for at, key in enumerate(tokens(role, name)):
        doubles.take(key, True, at)
    assert doubles.find_lasting(1.0 + 0.9 * SURE_S) == []
    double = Double(role, name, *map(str, LIVES))
    assert doubles.find_lasting(1.0 + SURE_S) == [double]
    assert doubles.find_lasting(2.0 + SURE_S) == []
    assert doubles.found == [double]
    assert all(word in str(double) for word in (name, "1-00000001", "2-00000001", "at once"))


@pytest.mark.parametrize("farewells", [(GIVES_WAY, ""), ("", GIVES_WAY)])
def test_one_that_gives_way_is_told_at_once_and_only_once(farewells: tuple[str, str]):
    old, new = tokens("area", "area1")
    doubles = Doubles(beat_s=0.2)
    doubles.take(old, True, 0.0)
    doubles.take(new, True, 0.0)
    for farewell in farewells:
        told = doubles.take(old, False, 0.1, farewell)
        assert told == (Double("area", "area1", *map(str, LIVES)) if farewell else None)
    assert len(doubles.found) == 1


def test_a_process_that_was_killed_and_started_again_is_none_nor_one_that_leaves_in_order():
    old, new = tokens("area", "area1")
    doubles = Doubles(beat_s=0.2)
    for farewell in ("", "SIGTERM"):
        doubles.take(old, True, 0.0)
        doubles.take(new, True, 0.5)
        assert doubles.take(old, False, 2.0, farewell) is None
        assert doubles.find_lasting(100.0) == []


def test_watchers_may_be_many():
    doubles = Doubles(beat_s=0.2)
    for key in tokens("coordinator", "coordinator"):
        doubles.take(key, True, 0.0)
    assert doubles.find_lasting(100.0) == []


def test_where_beats_are_long_a_dead_ones_token_may_be_there_for_longer():
    doubles = Doubles(beat_s=2.0)
    for key in tokens("area", "area1"):
        doubles.take(key, True, 0.0)
    assert doubles.find_lasting(3 * 2.0) == []
    assert len(doubles.find_lasting(4 * 2.0)) == 1
