"""Which state of a scan a replay keeps: a good one is not lost to what an area shows after it."""

from __future__ import annotations

from dataclasses import replace

from agents.messages.packing import StateMessage
from agents.protocol.quality import GOOD
from coordinator.watch.replay.scan_states import ScanStates
from tests.support.sample_messages import STATE


def shown(scan: int, sequence: int, quality: str) -> StateMessage:
    return replace(STATE, quality=quality, header=replace(STATE.header, scan=scan, sequence=sequence))


def test_a_good_state_stays_until_a_newer_good_one() -> None:
    states = ScanStates(3, 0.0)
    good, newer = shown(3, 2, GOOD), shown(3, 4, GOOD)
    name = good.header.sender
    states.take(1.0, shown(3, 1, "stale"))
    assert states.best[name].quality == "stale"
    assert not states.are_good([name])
    for at, state in ((2.0, good), (3.0, shown(3, 3, "stale"))):
        states.take(at, state)
        assert states.best[name] is good
        assert states.are_good([name])
    assert not states.are_good([name, "another"])
    states.take(4.0, newer)
    assert states.best[name] is newer


def test_states_of_other_scans_change_nothing() -> None:
    states = ScanStates(3, 0.0)
    states.take(1.0, shown(2, 1, GOOD))
    assert (states.best, states.changed_at) == ({}, 0.0)
