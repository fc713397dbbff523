"""Of two processes under one name the older gives way, but never to a dead one."""

from __future__ import annotations

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from agents.peers.rejections import LONGEST_LEAD_S
from agents.runtime.duplicate_guard import OVERLAP_S, DuplicateGuard, ReplacedError

START_MS = 1_700_000_000_000
OWN = Incarnation(START_MS, 7)


def token(later_s: float = 1.0, random: int = 7) -> str:
    return live_key("run", "area", "area1", Incarnation(START_MS + int(1000 * later_s), random))


def guard(heartbeat_s: float = 0.2) -> DuplicateGuard:
    return DuplicateGuard("area area1 of run run", OWN, 100.0, heartbeat_s)


def test_it_gives_way_to_a_newer_incarnation_that_stays_and_says_whose_and_which():
    watched = guard()
    watched.take(token(), True, 101.0)
    watched.check(101.0 + 0.9 * OVERLAP_S)
    assert watched.next_due() == 101.0 + OVERLAP_S
    with pytest.raises(ReplacedError, match=f"run as area area1 of run run at once.*{OWN}.*{START_MS + 1000:x}-"):
        watched.check(101.0 + OVERLAP_S)


def test_it_waits_longer_where_heartbeats_are_long_and_with_them_the_lease():
    watched = guard(heartbeat_s=2.0)
    watched.take(token(), True, 101.0)
    watched.check(101.0 + 8 * 2.0)
    with pytest.raises(ReplacedError):
        watched.check(101.0 + 12 * 2.0)


def test_a_token_that_vanishes_in_time_was_that_of_a_dead_incarnation_and_is_no_reason_to_go():
    watched = guard()
    watched.take(token(), True, 101.0)
    watched.take(token(), False, 102.0)
    watched.check(200.0)
    assert watched.next_due() == float("inf")


def test_it_stays_where_the_others_are_older_or_itself_or_no_incarnations_at_all():
    watched = guard()
    for key in (token(0.0), token(-5.0), token(0.0, random=6), token() + "zz", "dsse/v3/run/live/area/area1/*"):
        watched.take(key, True, 101.0)
    watched.check(200.0)


def test_of_two_that_began_in_the_same_millisecond_just_one_gives_way():
    watched = guard()
    watched.take(token(0.0, random=8), True, 101.0)
    with pytest.raises(ReplacedError):
        watched.check(200.0)


def test_an_incarnation_from_the_future_whose_messages_nobody_takes_drives_nobody_out():
    watched = guard()
    watched.take(token(LONGEST_LEAD_S + 2.0), True, 101.0)
    watched.check(200.0)
    watched.take(token(LONGEST_LEAD_S + 2.0), True, 103.0)
    with pytest.raises(ReplacedError):
        watched.check(200.0)
