"""A neighbour as a process: which of its messages is newest, what it has acknowledged, when what is repeated."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.packing import Header, HeartbeatMessage, Incarnation, LoadMessage
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS
from agents.peers.peer_table import PeerTable
from agents.peers.peers import FIRST_WAIT_S, LEAST_WAIT_S, MEAN_GAIN, PATIENCE_WAITS, Peer
from agents.strategies.angle_offset import BoundaryMessage
from dsse_core.grid.partition import Neighbour

HEARTBEAT_S = 0.2
OVER_S = PATIENCE_HEARTBEATS * HEARTBEAT_S
WALL = 1.7e9  # at monotonic time 0
FIRST, SET_BACK = Incarnation(2_000, 1), Incarnation(1_000, 2)


def header(incarnation: Incarnation = FIRST, sequence: int = 1, time: float = WALL) -> Header:
    return Header("run", "area2", incarnation, scan=1, sequence=sequence, time=time)


def load(incarnation: Incarnation = FIRST, sequence: int = 1) -> LoadMessage:
    return LoadMessage(header(incarnation, sequence), 6, (float(sequence),), (0.0,), (0.1,))


def heartbeat(incarnation: Incarnation = FIRST, *, time: float = WALL, **changes: object) -> HeartbeatMessage:
    made = HeartbeatMessage(
        header(incarnation, time=time), 0, 0, True, 0.0, (0, 0), False, False, (), variables=("s@6>area2", "v@6")
    )
    return replace(made, **changes)


def boundary(sequence: int, *, time: float = WALL, complete: bool = False) -> BoundaryMessage:
    return BoundaryMessage(header(sequence=sequence, time=time), 6, 1.0, 0.0, True, receives=True, complete=complete)


@pytest.fixture
def peers() -> PeerTable:
    return PeerTable([Neighbour("area2", 6, is_parent=False)], HEARTBEAT_S, 0.0, WALL)


@pytest.fixture
def peer(peers: PeerTable) -> Peer:
    return peers["area2"]


def receive(peer: Peer, message: HeartbeatMessage | BoundaryMessage, now: float) -> None:
    peer.take(message, now, WALL + now, is_awake=True)


def test_neither_a_repeat_nor_an_older_message_is_new(peer: Peer):
    assert peer.take_load(load(sequence=2), 0.0)
    assert not peer.take_load(load(sequence=2), 0.0)
    assert not peer.take_load(load(sequence=1), 0.0)
    assert peer.take_load(load(sequence=3), 0.0)


def test_a_former_incarnation_is_not_received_while_the_newest_sends(peers: PeerTable, peer: Peer):
    for now in (0.0, 0.9 * OVER_S):
        receive(peer, heartbeat(time=WALL + now), now)
    assert peers.is_of_former_incarnation(header(SET_BACK), 1.8 * OVER_S)
    assert not peers.is_of_former_incarnation(header(SET_BACK), 2.0 * OVER_S)


def test_a_load_of_a_restarted_area_whose_clock_was_set_back_counts_once_it_has_been_received(peer: Peer):
    peer.take_load(load(sequence=9), 0.0)
    receive(peer, heartbeat(), 0.0)
    assert not peer.take_load(load(SET_BACK), 0.0)
    receive(peer, heartbeat(SET_BACK), 2 * OVER_S)
    assert peer.received == (0, 0)  # the load that is kept is of a process that is no more
    assert peer.take_load(load(SET_BACK), 0.0)
    assert peer.received == (1, 0)


def test_of_two_messages_of_one_number_the_later_one_says_whether_the_side_is_complete(peer: Peer):
    receive(peer, boundary(1, time=WALL + 1.0, complete=True), 1.0)
    receive(peer, boundary(1, time=WALL + 0.5, complete=False), 1.1)  # overtaken
    assert peer.complete
    receive(peer, boundary(1, time=WALL + 1.2, complete=False), 1.2)
    assert not peer.complete


def test_a_message_is_repeated_until_its_number_is_acknowledged_and_no_slower_than_the_link_needs(peers, peer):
    peer.await_reply(peer.load, load(sequence=4), 0.0)
    due = []
    while len(due) < 4:
        now = min(sent.repeat.at for sent in peer.outgoing if sent.repeat)
        assert list(peers.take_due_repeats(now)) == [("area2", load(sequence=4))]
        due.append(now)
    assert due == pytest.approx([FIRST_WAIT_S * k for k in range(1, 5)])
    for number in (3, 5):  # an earlier one, and one that was said to a former incarnation of this area
        receive(peer, heartbeat(received=(number, 0), time=WALL + now), now)
        assert peer.load.repeat
    receive(peer, heartbeat(received=(4, 0), time=WALL + now), now)
    assert peer.load.repeat is None


def test_repeats_follow_the_measured_round_trip(peer: Peer):
    for k in range(20):
        now = 0.1 * k
        receive(peer, heartbeat(answers=WALL + now - 0.03, time=WALL + now), now)
    assert peer.round_trip.mean == pytest.approx(0.03, abs=1e-6)
    peer.await_reply(peer.exchange, boundary(1), now)
    assert peer.exchange.repeat.wait_s < 2 * 0.03
    assert peer.round_trip.longest_wait_s >= max(4 * peer.round_trip.mean - 1e-6, 4 * LEAST_WAIT_S)


@pytest.mark.parametrize("answers", [1e-300, 1.0, WALL - 1.0, WALL + 10.0])
def test_what_was_never_sent_measures_no_round_trip(peer: Peer, answers: float):
    """Of before this process began, or of later than now."""
    receive(peer, heartbeat(answers=answers), 1.0)
    assert peer.round_trip.longest_wait_s == FIRST_WAIT_S


def test_nothing_is_repeated_to_a_process_that_is_no_more(peer: Peer):
    receive(peer, heartbeat(), 0.0)
    peer.await_reply(peer.load, load(sequence=4), 0.0)
    receive(peer, heartbeat(Incarnation(3_000, 1)), 0.1)
    assert peer.load.repeat is None
    assert peer.load.message is not None  # for when it says that it lacks it


def test_nothing_is_repeated_to_a_neighbour_that_is_not_there(peers: PeerTable, peer: Peer):
    receive(peer, heartbeat(receives=False), 0.0)
    peer.await_reply(peer.load, load(), 0.0)
    assert list(peers.take_due_repeats(PATIENCE_HEARTBEATS * HEARTBEAT_S)) == []
    assert peer.load.repeat is None


def test_a_longer_trip_than_since_the_message_answered_before_is_none(peer: Peer):
    for k in range(20):
        receive(peer, heartbeat(answers=WALL + 0.2 * k - 0.03, time=WALL + 0.2 * k), 0.2 * k)
    waits = peer.round_trip.wait_s, peer.round_trip.longest_wait_s
    receive(peer, heartbeat(answers=WALL + 0.5, time=WALL + 4.0), 4.0)
    assert (peer.round_trip.wait_s, peer.round_trip.longest_wait_s) == waits
    assert peer.clock.skew.doubt_s < 0.1


def test_no_trip_makes_waits_and_patience_longer_than_the_own_heartbeat_allows(peer: Peer):
    receive(peer, heartbeat(answers=WALL + 1.0, time=WALL + 1000.0), 1000.0)
    assert peer.round_trip.longest_wait_s == OVER_S
    assert peer.patience_s == pytest.approx(PATIENCE_WAITS * HEARTBEAT_S)


def test_a_pending_repeat_comes_sooner_when_the_round_trip_is_found_to_be_shorter(peers: PeerTable, peer: Peer):
    receive(peer, heartbeat(answers=WALL + 1.0, time=WALL + 2.0), 2.0)
    peer.await_reply(peer.exchange, boundary(1), 2.0)
    late = peer.exchange.repeat.at
    for k in range(30):
        now = 2.0 + 0.01 * k
        receive(peer, heartbeat(answers=WALL + now - 0.002, time=WALL + now), now)
    assert late > 3.5
    assert peer.exchange.repeat.at < 2.3


def test_one_number_that_is_not_repeated_is_the_newest_for_the_patience_only(peer: Peer):
    receive(peer, heartbeat(time=WALL + 500.0, complete=True), 0.0)
    receive(peer, heartbeat(time=WALL + 1.0), 1.0)
    assert peer.complete
    receive(peer, heartbeat(time=WALL + OVER_S + 0.1), OVER_S + 0.1)
    assert not peer.complete
    assert peer.take_load(load(sequence=2**52), 0.0)
    assert not peer.take_load(load(sequence=4), OVER_S)
    assert peer.take_load(load(sequence=4), OVER_S + 0.1)
    assert peer.take_number(2**52, 0.0)
    assert not peer.take_number(4, OVER_S)
    assert peer.take_number(4, OVER_S + 0.1)


def test_a_message_left_unanswered_for_long_is_no_measure_of_loss(peer: Peer):
    peer.await_reply(peer.load, load(sequence=4), 0.0)
    peer.load.repeat = replace(peer.load.repeat, count=10**6)
    receive(peer, heartbeat(received=(4, 0)), 1.0)
    assert peer.mean_count < PATIENCE_WAITS / 4


def test_where_no_answer_is_counted_gaps_between_arrivals_tell_how_many_messages_are_lost(peer: Peer):
    for k in range(60):  # of ten messages, one each heartbeat, one arrives; none answers the newest one
        now = 10 * HEARTBEAT_S * k
        receive(peer, heartbeat(answers=WALL + now - 0.3, time=WALL + now), now)
        receive(peer, heartbeat(time=WALL + now), now + 0.01)
    assert peer.mean_count == 1.0
    assert peer.patience_messages == pytest.approx(10 * PATIENCE_WAITS, rel=0.1)
    assert peer.patience_s == pytest.approx(10 * PATIENCE_WAITS * HEARTBEAT_S, rel=0.1)


def test_a_silence_counts_as_one_gap_of_the_patience_however_long_it_was(peer: Peer):
    receive(peer, heartbeat(), 0.0)
    patience_s = peer.patience_s
    receive(peer, heartbeat(time=WALL + 1e6), 1e6)
    assert peer.mean_gap <= 1 + MEAN_GAIN * patience_s / HEARTBEAT_S
