"""The inbox keeps the newest of each slot; the lossy link drops the same messages in every run."""

import random
import signal
import threading
import time

import pytest

from agents.messages.packing import Header, Incarnation, StateMessage, decode
from agents.runtime.inbox import MAX_WAITING, Inbox
from agents.runtime.link import FaultyLinks
from agents.runtime.link_faults import draw_fate
from agents.strategies.angle_offset import BoundaryMessage
from agents.strategies.installed import load_strategy
from dsse_core.link_faults import LinkFaults

load_strategy("angle-offset")  # which makes its messages known


def test_the_newest_of_each_slot_is_taken_once():
    inbox = Inbox()
    for slot, item in [("a", 1), ("b", 2), ("a", 3)]:
        inbox.put(slot, item)
    assert inbox.take(0.0) == [2, 3]
    assert inbox.take(0.0) == []


def test_a_taker_wakes_when_updates_arrives():
    inbox = Inbox()
    threading.Timer(0.05, inbox.put, ("a", 1)).start()
    started = time.monotonic()
    assert inbox.take(30.0) == [1]
    assert time.monotonic() - started < 10.0


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no timer that sends signals")
def test_a_signal_as_the_timeout_passes_does_not_prolong_the_wait():
    inbox, began = Inbox(), time.monotonic()

    def interrupt(*_):
        assert time.monotonic() - began < 10.0, "the wait of a millisecond has no end"
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, 1e-3), 0.5)

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        interrupt()
        for _ in range(500):
            began = time.monotonic()
            assert inbox.take(0.001) == []
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_a_flood_is_dropped():
    inbox = Inbox()
    for k in range(MAX_WAITING + 5):
        inbox.put(k, k)
    assert inbox.take(0.0) == list(range(MAX_WAITING))


def test_an_item_that_is_not_taken_holds_one_place_however_often_it_is_renewed():
    inbox = Inbox()
    for k in range(3 * MAX_WAITING):
        inbox.put("a", k)
    inbox.put("b", -1)
    assert inbox.take(0.0) == [3 * MAX_WAITING - 1, -1]


class HalfPut(dict):
    """The updates of an inbox while another thread replaces the item of ``slot`` and has only removed the old."""

    slot = "a"

    def pop(self, slot, *default):
        if slot == self.slot:
            super().pop(slot, None)
            self.slot = None
        return super().pop(slot, *default)


def test_an_item_that_is_being_replaced_while_all_is_taken_comes_with_the_next_taking():
    inbox = Inbox()
    inbox._updates = HalfPut()
    inbox._updates["a"] = 1
    inbox.put("b", 2)
    assert inbox.take(0.0) == [2]
    inbox.put("a", 3)
    assert inbox.take(0.0) == [3]


def message(sequence):
    return BoundaryMessage(Header("r", "a", Incarnation(1, 1), 1, sequence, 0.0), 6, 0.95, 0.0, True)


def send_many(seed, loss, count=400):
    arrived = []
    link = FaultyLinks(
        "a",
        {"b": LinkFaults(loss=loss)},
        seed,
        lambda to, kind, payload: arrived.append(decode(payload).header.sequence),
    )
    for k in range(count):
        link.send(message(k), "b", 0.0)
    return arrived, link


def test_the_same_seed_loses_the_same_messages():
    assert send_many(4, 0.3)[0] == send_many(4, 0.3)[0]
    assert send_many(4, 0.3)[0] != send_many(5, 0.3)[0]


def test_the_share_of_lost_messages_is_the_one_asked_for():
    arrived, link = send_many(1, 0.3, count=5000)
    assert link.messages == 5000
    assert link.lost == 5000 - len(arrived)
    assert abs(link.lost / 5000 - 0.3) < 4 * (0.3 * 0.7 / 5000) ** 0.5


@pytest.mark.parametrize(("loss", "kept"), [(0.0, 400), (1.0, 0)])
def test_no_loss_keeps_all_and_full_loss_keeps_none(loss, kept):
    assert len(send_many(3, loss)[0]) == kept


def test_the_two_directions_of_a_link_have_fates_of_their_own():
    there = [draw_fate(1, "a", "b", k) for k in range(50)]
    back = [draw_fate(1, "b", "a", k) for k in range(50)]
    assert there != back


def test_a_state_carries_the_totals_of_the_link_and_is_never_lost():
    shown = []
    link = FaultyLinks(
        "a", {"b": LinkFaults(loss=1.0)}, 0, lambda to, kind, payload: shown.append((to, decode(payload)))
    )
    link.send(message(1), "b", 0.0)
    empty = ((),) * 5
    state = StateMessage(
        message(1).header, *empty, False, 0.0, 0, (), (), True, {}, {}, 0, 0, 0, {}, (), {}, "good", 0.0, {}, {}, ()
    )
    link.send(state, None, 0.0)
    ((to, seen),) = shown
    assert to is None
    assert (seen.messages, seen.lost) == (1, 1)
    assert seen.bytes == link.bytes > 0
