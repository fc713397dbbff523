"""Who watches tells an area or a plant that runs twice from one that was started again."""

from __future__ import annotations

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from agents.runtime.duplicate_guard import GIVES_WAY, OVERLAP_S
from coordinator.watch.observe.duplicates import SURE_S, Duplicate, Duplicates

INCARNATIONS = [Incarnation(start, 1) for start in (1, 2)]


def tokens(role: str, name: str) -> list[str]:
    return [live_key("run", role, name, incarnation) for incarnation in INCARNATIONS]


@pytest.mark.parametrize(("role", "name"), [("area", "area1"), ("plant", "plant")])
def test_two_that_are_there_for_long_are_reported_once_with_both_incarnations(role: str, name: str):
    assert SURE_S < OVERLAP_S, "or the older one has gone before it is reported"
    duplicates = Duplicates(heartbeat_s=0.2)
    for at, key in enumerate(tokens(role, name)):
        duplicates.take(key, True, at)
    assert duplicates.find_lasting(1.0 + 0.9 * SURE_S) == []
    duplicate = Duplicate(role, name, *map(str, INCARNATIONS))
    assert duplicates.find_lasting(1.0 + SURE_S) == [duplicate]
    assert duplicates.find_lasting(2.0 + SURE_S) == []
    assert duplicates.found == [duplicate]
    assert all(word in str(duplicate) for word in (name, "1-00000001", "2-00000001", "at once"))


@pytest.mark.parametrize("leave_reasons", [(GIVES_WAY, ""), ("", GIVES_WAY)])
def test_one_that_gives_way_is_reported_at_once_and_only_once(leave_reasons: tuple[str, str]):
    old, new = tokens("area", "area1")
    duplicates = Duplicates(heartbeat_s=0.2)
    duplicates.take(old, True, 0.0)
    duplicates.take(new, True, 0.0)
    for leave_reason in leave_reasons:
        reported = duplicates.take(old, False, 0.1, leave_reason)
        assert reported == (Duplicate("area", "area1", *map(str, INCARNATIONS)) if leave_reason else None)
    assert len(duplicates.found) == 1


def test_a_process_that_was_killed_and_started_again_is_none_nor_one_that_leaves_in_order():
    old, new = tokens("area", "area1")
    duplicates = Duplicates(heartbeat_s=0.2)
    for leave_reason in ("", "SIGTERM"):
        duplicates.take(old, True, 0.0)
        duplicates.take(new, True, 0.5)
        assert duplicates.take(old, False, 2.0, leave_reason) is None
        assert duplicates.find_lasting(100.0) == []


def test_watchers_may_be_many():
    duplicates = Duplicates(heartbeat_s=0.2)
    for key in tokens("coordinator", "coordinator"):
        duplicates.take(key, True, 0.0)
    assert duplicates.find_lasting(100.0) == []


def test_where_heartbeats_are_long_a_dead_ones_token_may_be_there_for_longer():
    duplicates = Duplicates(heartbeat_s=2.0)
    for key in tokens("area", "area1"):
        duplicates.take(key, True, 0.0)
    assert duplicates.find_lasting(8 * 2.0) == []
    assert len(duplicates.find_lasting(10 * 2.0)) == 1
