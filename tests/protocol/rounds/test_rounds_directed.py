"""The protocol of rounds in single histories that have once gone wrong, or would without one of its rules."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import DownMessage, HeartbeatMessage, Incarnation, UpMessage
from agents.peers.peers import LEAST_WAIT_S
from agents.protocol.events import PresenceChanged, Received
from agents.protocol.numbering import MOST_AHEAD
from agents.protocol.quality import GOOD
from dsse_core.estimation.decision import Decision, Memory, Totals, decide
from tests.support.levels import further
from tests.support.toy_estimation import toy_numbers
from tests.support.toy_history import MOST_CHATTER
from tests.support.toy_rounds import HEARTBEAT_S, TRAVEL_S, ToyBus

pytestmark = pytest.mark.quick

ROW, LONG_ROW = "three in a row", "four in a row"
LIMIT_S = 15.0
MOMENTS = [TRAVEL_S * k / 2 for k in range(2, 16)]  # from the telemetry of a scan on


@pytest.fixture(autouse=True)
def numbers() -> Iterator[None]:
    with toy_numbers():
        yield


def at_rest(tree: str = ROW, **changes: object) -> ToyBus:
    bus = ToyBus(tree, **changes)
    bus.run_until_at_rest(LIMIT_S)
    return bus


def lose_an_acknowledgement(seed: int) -> ToyBus:
    """At rest when b ends scan 2 with its neighbours and the answer of a is lost."""
    rng = np.random.default_rng(seed)
    is_lost, final = False, None

    def lose_one(sender, receiver, message):
        nonlocal is_lost, final
        if isinstance(message, DownMessage) and receiver == "a" and message.header.scan == 2 and message.k == 1:
            final = message.header.sequence
        is_answer = sender == "a" and message.header.scan == 2 and isinstance(message, HeartbeatMessage)
        if is_answer and message.received[1] == final and not is_lost:
            is_lost = True
            return None
        return TRAVEL_S * float(rng.uniform(1.0, 1.5))

    bus = at_rest(fate=lose_one)
    bus.next_scan()
    bus.run(0.007)
    assert is_lost
    return bus


def test_of_two_late_readings_within_a_heartbeat_the_newer_one_counts():
    bus = at_rest()
    for k in range(4):
        bus.at(bus.now + 0.02 * k, lambda k=k: bus.read("a", 1, 0.9 + 0.01 * k))
    bus.run(0.1)
    bus.run_until_at_rest(LIMIT_S)


def test_a_late_reading_leaves_the_final_state_as_it_is_until_the_next_term_begins():
    bus = at_rest()
    bus.read("a", 1, 0.9)
    bus.run(0.01)
    bus.read("a", 1, 0.91)  # a heartbeat has not passed: the change is due, not made
    bus.read("a", 1, 0.92)
    bus.run(2.0)
    bus.run_until_at_rest(LIMIT_S)


def test_a_late_reading_that_goes_back_to_the_one_in_use_replaces_the_one_that_waits():
    bus = at_rest()
    bus.read("a", 1, 0.9)
    bus.run(0.01)
    bus.read("a", 1, 0.91)  # a heartbeat has not passed: the change is due, not made
    bus.run(0.01)
    bus.read("a", 1, 0.9)
    bus.run(2.0)
    bus.run_until_at_rest(LIMIT_S)


@pytest.mark.parametrize("lost", [HeartbeatMessage, UpMessage, DownMessage])
@pytest.mark.parametrize("number", [0, 1, 2, *further(*range(3, 8))])
@pytest.mark.parametrize("travel_s", [TRAVEL_S, *further(0.0017, 0.03)])
def test_a_lost_message_starts_no_chatter(lost: type, number: int, travel_s: float):
    received = 0

    def lose_one(sender, receiver, message):
        nonlocal received
        received += isinstance(message, lost)
        return None if isinstance(message, lost) and received == number + 1 else travel_s

    bus = ToyBus(ROW, lose_one)
    bus.run_until_at_rest(LIMIT_S)
    assert bus.find_chatter() <= MOST_CHATTER


@pytest.mark.parametrize("seed", range(8))
def test_a_lost_acknowledgement_is_made_good_by_one_repeat(seed: int):
    bus = lose_an_acknowledgement(seed)
    before = bus.sent_of_rounds["b", "a"]
    bus.run(0.15)
    assert bus.sent_of_rounds["b", "a"] - before <= 1


@pytest.mark.parametrize("died_at", MOMENTS[::2] + further(*MOMENTS[1::2]))
@pytest.mark.parametrize("away_s", [TRAVEL_S / 2, *further(3 * TRAVEL_S)])
@pytest.mark.parametrize("name", ["a", "b", "c"])
@pytest.mark.parametrize("has_tokens", [False, True])
def test_who_starts_again_in_the_middle_of_a_scan_takes_nothing_that_was_sent_to_its_past(
    died_at, away_s, name, has_tokens
):
    bus = at_rest()
    bus.has_tokens = has_tokens
    begin = bus.now
    bus.next_scan()
    bus.at(begin + died_at, lambda: bus.kill(name))
    bus.at(begin + died_at + away_s, lambda: bus.start(name))
    bus.run(0.1)
    bus.run_until_at_rest(LIMIT_S)


def test_a_neighbour_whose_token_is_lost_while_it_sends_makes_nobody_begin_anew_at_every_heartbeat():
    bus = at_rest()
    bus.post("a", PresenceChanged("b", False))
    bus.next_scan()
    bus.run_until_at_rest(LIMIT_S)
    revision = bus.protocols["a"].term[1]
    bus.run(5.0)
    assert bus.protocols["a"].term[1] == revision


def test_nobody_is_good_on_readings_that_are_known_to_be_replaced():
    bus = at_rest()
    bus.read("b", 1, 0.9)
    bus.run(0.03)
    assert {state.quality for state in bus.states.values()} == {GOOD}
    bus.read("b", 1, 0.91)
    bus.run(0.01)
    assert GOOD not in {state.quality for state in bus.states.values()}
    bus.run_until_at_rest(LIMIT_S)


def test_a_neighbour_that_starts_again_with_its_clock_set_back_is_received_again():
    bus = at_rest()
    bus.kill("a")
    bus.run(1.0)
    bus.start("a", clock_offset=-300.0)
    bus.run_until_at_rest(LIMIT_S)


def test_who_does_not_believe_a_neighbour_lets_the_others_come_to_an_end():
    bus = ToyBus(ROW)
    bus._check = lambda *_: None
    bus.run_until_at_rest(LIMIT_S)
    bus.next_scan()
    bus.run(TRAVEL_S / 2)
    bus.protocols["a"].round.find_lie = lambda *_: "made up"
    bus.run(5.0)
    assert {name: protocol.outcome is not None for name, protocol in bus.protocols.items()} == dict.fromkeys(
        bus.files, True
    )


def test_after_a_process_has_stood_still_a_dead_neighbour_is_left_out_as_soon_as_ever():
    bus = at_rest()
    bus.freeze("a")
    bus.run(60.0)
    bus.thaw("a")
    bus.run_until_at_rest(LIMIT_S)
    bus.has_tokens = False
    bus.kill("b")
    bus.next_scan()
    bus.run(10 * HEARTBEAT_S)
    assert bus.protocols["a"].outcome is not None


def test_a_repeat_at_rest_takes_good_from_nobody_for_longer_than_round_trips():
    bus = lose_an_acknowledgement(1)
    bus.run(LEAST_WAIT_S + 5 * 2 * TRAVEL_S)  # the wait for the repeat, and less than between two heartbeats
    assert not bus.find_missing()


def test_of_two_heartbeats_of_one_moment_the_second_counts():
    bus = at_rest()
    last = bus.last_heartbeat["a", "b"]
    first, second = (replace(last, header=replace(last.header, time=last.header.time + ms / 1000)) for ms in (1, 2))
    for heartbeat in (replace(first, complete=False), second):
        bus.post("b", Received(heartbeat, "a"))
    bus.run(TRAVEL_S / 2)
    assert bus.states["b"].quality == GOOD


@pytest.mark.parametrize("seed", range(3))
def test_at_rest_loss_takes_good_from_nobody(seed: int):
    rng, loss = np.random.default_rng(seed), 0.0
    bus = at_rest(fate=lambda *_: None if rng.random() < loss else TRAVEL_S)
    loss = 0.3
    for _ in range(500):
        bus.run(0.02)
        assert {state.quality for state in bus.states.values()} == {GOOD}


def test_at_rest_a_sound_link_carries_two_heartbeats_a_heartbeat():
    bus = at_rest()
    bus.run(5 * HEARTBEAT_S)
    before = bus.sent.total()
    heartbeats, links = 50, 2
    bus.run(heartbeats * HEARTBEAT_S)
    assert bus.sent.total() - before <= 2 * links * (heartbeats + 1)


def test_a_scan_that_no_plant_has_made_is_forgotten_when_its_author_is_gone():
    bus = at_rest()
    lie = bus.last_heartbeat["a", "b"]
    bus.post("b", Received(replace(lie, header=replace(lie.header, scan=2**40), receives=True), "a"))
    bus.run(3.0)
    for _ in range(3):
        bus.next_scan()
        bus.run(3.0)
    assert {state.quality for state in bus.states.values()} == {GOOD}


def test_whatever_totals_say_the_verdicts_come_to_an_end():
    memory, evaluated = Memory(), 0
    for _ in range(5000):
        step = 0.0 if memory.steps else 1.0
        worst = ((f"made-up@{evaluated}", 9.0),) if memory.evaluating else ()
        evaluated += memory.evaluating
        memory, verdict = decide(memory, Totals(1e9, 9, step, step, worst=worst, areas=3))
        if verdict.decision is Decision.FINAL:
            return
    pytest.fail(f"{evaluated} evaluations, {len(memory.removed)} meters removed")


def scan_numbers(bus):
    """Area -> the scan it works on, the plant's number of its readings, and how many areas with readings it counts."""
    found = {}
    for name, protocol in bus.protocols.items():
        outcome = protocol.outcome
        counted = outcome.totals.areas - len(outcome.totals.stale) if outcome else 0
        used = protocol._scan._used
        found[name] = protocol.scan, used.header.scan if used else 0, counted
    return found


def start_plant_again(bus, number):
    """Scan ``number`` of a plant whose clock was set back, in all areas that are there."""
    for name in bus.files:
        bus.read(name, number, 1.5 + 1e-3 * number, incarnation=1)
    bus.run(HEARTBEAT_S)


def agree(bus):
    found = set(scan_numbers(bus).values())
    return len(found) == 1 and next(iter(found))[2] == len(bus.files)


def wait_until_agreed(bus, limit_s=LIMIT_S):
    end = bus.now + limit_s
    while not agree(bus):
        assert bus.now < end, scan_numbers(bus)
        bus.run(HEARTBEAT_S)


def test_areas_in_different_scans_do_not_number_those_of_a_plant_that_was_set_back_differently():
    bus = ToyBus(ROW)
    for _ in range(8):
        bus.next_scan()
        bus.run(1.0)
    bus.cut(("b", "c"), ("c", "b"))
    bus.next_scan(without=["c"])
    bus.run(5.0)
    assert {name: protocol.scan for name, protocol in bus.protocols.items()} == {"a": 10, "b": 10, "c": 9}
    start_plant_again(bus, 1)
    bus.run(5.0)
    assert {name: protocol.scan for name, protocol in bus.protocols.items()} == {"a": 11, "b": 11, "c": 10}
    bus.heal(("b", "c"), ("c", "b"))
    wait_until_agreed(bus)
    for number in (2, 3):
        before = bus.protocols["a"].scan
        start_plant_again(bus, number)
        wait_until_agreed(bus)
        assert bus.protocols["a"].scan == before + 1


def test_numbers_that_go_back_with_the_clock_of_who_leads_go_on_in_every_area():
    bus = ToyBus(ROW)
    for _ in range(8):
        bus.next_scan()
        bus.run(1.0)
    for number in (5, 6, 9, 3):
        before = bus.protocols["a"].scan
        for name in bus.files:
            del bus._telemetry[name]  # the same process, whose next message has another number
            bus.read(name, number, 1.5 + 1e-3 * number)
        bus.run(HEARTBEAT_S)
        wait_until_agreed(bus)
        scan, used, _ = scan_numbers(bus)["a"]
        assert (scan > before, used) == (True, number)


def test_an_area_that_starts_after_a_plant_was_set_back_does_not_number_scans_by_itself():
    bus = ToyBus(ROW)
    for _ in range(40):
        bus.next_scan()
        bus.run(0.2)
    bus.kill("c")
    bus.run(1.0)
    start_plant_again(bus, 1)
    bus.run(1.0)
    bus.start("c")
    wait_until_agreed(bus)
    start_plant_again(bus, 2)
    wait_until_agreed(bus)


def test_what_a_liar_says_of_the_numbers_of_scans_leads_to_no_scan_that_others_lack():
    bus = at_rest()
    for offset in (7, 2**40, 2**51 - 1, 2**60):
        bus.post("b", Received(replace(bus.last_heartbeat["c", "b"], plant=Incarnation(0, 0), offset=offset), "c"))
        bus.run(TRAVEL_S / 2)
        wait_until_agreed(bus)
    assert 2**40 < bus.protocols["a"].scan < 2**41
    bus.next_scan()
    wait_until_agreed(bus)


def test_a_slow_link_elsewhere_lets_every_area_show_one_scan_after_another():
    slow = {("c", "d"), ("d", "c")}
    bus = ToyBus(LONG_ROW, lambda sender, receiver, _: 1.0 if (sender, receiver) in slow else TRAVEL_S)
    shown = {name: set() for name in bus.files}
    for step in range(600):
        if step % 30 == 0:
            bus.next_scan()
        bus.run(0.1)
        for name, state in bus.states.items():
            shown[name].add(state.header.scan)
    assert min(map(len, shown.values())) >= 10, shown


def test_an_end_is_shown_even_if_readings_of_the_next_scan_are_there():
    slowed = False

    def slow_final(sender, receiver, message):
        nonlocal slowed
        is_final = isinstance(message, DownMessage) and receiver == "a" and message.header.scan == 2 and message.k == 1
        slowed |= is_final
        return 0.05 if is_final else TRAVEL_S

    bus = at_rest(fate=slow_final)
    shown = set()
    bus.on_handled = lambda: shown.add(bus.states["a"].header.scan)
    bus.next_scan()
    bus.run(0.02)
    assert slowed
    bus.next_scan()
    bus.run(0.1)
    assert shown >= {1, 2, 3}


def test_an_area_whose_telemetry_is_silent_for_many_scans_stays_in_the_exchange():
    bus = at_rest()
    bus.send_telemetry = lambda name, send=bus.send_telemetry: None if name == "b" else send(name)
    for _ in range(3 * MOST_AHEAD):
        bus.next_scan()
        bus.run(2.0)
    outcome = bus.protocols["a"].outcome
    assert outcome is not None
    assert (outcome.totals.areas, outcome.totals.stale) == (3, ("b",))
    del bus.send_telemetry
    bus.run_until_at_rest(LIMIT_S)


def test_waiting_readings_of_a_former_plant_leave_those_of_the_next_one_not_behind():
    bus = at_rest()
    bus.next_scan()
    bus.run(1.5 * TRAVEL_S)
    for name in bus.files:
        bus.read(name, 1000)
    bus.run(TRAVEL_S / 2)
    start_plant_again(bus, 1)
    for number in (1, 2):
        start_plant_again(bus, number)
        wait_until_agreed(bus)
        assert {number for _, number, _ in scan_numbers(bus).values()} == {number}
