"""One forged message: what it states of times and numbers delays no later scan, whatever is lost or frozen then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from agents.messages.packing import HeartbeatMessage, LoadMessage, Message
from agents.protocol.events import Received
from coordinator.lab.simulator.simulator import STARTED_AT
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of

MOST_S = 3.0  # until the next scan is there
SCENARIO = load_scenario("ieee33")
VICTIM, NAMED = "area1", "area2"  # which is deceived, in whose name
FARTHEST = 599.0  # s by which a clock may be ahead


def run_for(uptime_s: float, strategy: str = "information") -> SimulatedBus:
    bus = SimulatedBus(area_files_of(SCENARIO, strategy=strategy), make_telemetry(SCENARIO).by_area)
    bus.run(uptime_s)
    assert {state.quality for state in bus.states.values()} <= {"good", "degraded"}
    return bus


def last_sent(bus: SimulatedBus, kind: type[Message]) -> Message:
    """The newest message of a ``kind`` to the deceived area from the one whose name is used."""
    return next(m for *_, to, m in reversed(bus.delivered) if to == VICTIM and isinstance(m, kind) and is_named(m))


def is_named(message: Message) -> bool:
    return message.header.sender == NAMED


def forge(bus: SimulatedBus, kind: type[Message] = HeartbeatMessage, **stated: object) -> None:
    """Have the deceived area receive a message that states ``stated``; names of fields of the header go there."""
    sample = last_sent(bus, kind)
    in_header = {name: stated.pop(name) for name in ("scan", "sequence", "time") if name in stated}
    header = replace(sample.header, **{"time": STARTED_AT + bus.now} | in_header)
    bus.post(VICTIM, Received(replace(sample, header=header, **stated), NAMED))
    bus.run(0.01)


def seconds_of_next_scan(bus: SimulatedBus, areas: set[str]) -> float:
    """Until these areas have an end of the next scan."""
    began, scan = bus.now, bus.scan + 1
    bus.next_scan(make_telemetry(SCENARIO, scan=scan).by_area)
    while not all(bus.states[name].header.scan == scan and bus.states[name].vm for name in areas):
        bus.run(0.05)
        if bus.now > began + 10 * MOST_S:
            break
    return bus.now - began


def lose_first(bus: SimulatedBus, sender: str, kinds: tuple[str, ...]) -> None:
    """Let each message of these ``kinds`` get through when it is sent for the second time only."""
    seen = set()

    def is_first(*link_and: object) -> bool:
        message = link_and[2]
        key = message.kind, message.header.sequence, message.header.scan
        is_new = link_and[0] == sender and message.kind in kinds and key not in seen
        seen.add(key)
        return is_new

    bus.reject_delivery = is_first


@pytest.mark.parametrize("uptime_s", [15.0, pytest.param(600.0, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("back", [1.0, *further(0.01, 0.5)])
@pytest.mark.parametrize("fault", ["lost", "frozen"])
def test_an_answer_to_a_message_of_long_ago_delays_no_scan(fault: str, back: float, uptime_s: float):
    bus = run_for(uptime_s)
    forge(bus, answers=STARTED_AT + bus.now - back * uptime_s + 0.001)
    if fault == "lost":
        lose_first(bus, VICTIM, ("down",))
        assert seconds_of_next_scan(bus, set(bus.files)) < MOST_S
    else:
        bus.pause(NAMED)
        assert seconds_of_next_scan(bus, set(bus.files) - {NAMED}) < MOST_S


FORGED: dict[str, Callable[[SimulatedBus], None]] = {
    "a send time far ahead": lambda bus: forge(bus, time=STARTED_AT + bus.now + FARTHEST),
    "a send time far back": lambda bus: forge(bus, time=-1.7e308, clock=-1.7e308),
    "a clock far ahead": lambda bus: forge(bus, clock=1.7e308),
    "the largest revision": lambda bus: forge(bus, revision=2**51 - 1),
    "half of the largest revision": lambda bus: forge(bus, revision=2**50),
    "the largest number of a load": lambda bus: forge(bus, LoadMessage, sequence=2**53 - 1),
    "a load far ahead": lambda bus: forge(bus, LoadMessage, sequence=2**53 - 1, time=STARTED_AT + bus.now + FARTHEST),
    "acknowledgements of all": lambda bus: forge(bus, received=(2**53 - 1, 2**53 - 1)),
    "another round": lambda bus: forge(bus, k=2**53 - 1),
}

SIMILAR = ("a send time far back", "half of the largest revision", "the largest number of a load", "another round")


@pytest.mark.parametrize("forged", [name for name in FORGED if name not in SIMILAR] + further(*SIMILAR))
def test_a_forged_number_keeps_no_later_scan_from_being_good(forged: str):
    bus = run_for(2.0)
    FORGED[forged](bus)
    for _ in range(2):
        assert seconds_of_next_scan(bus, set(bus.files)) < MOST_S, forged
        bus.run(1.5)
    assert {state.quality for state in bus.states.values()} == {"good"}, forged


@pytest.mark.parametrize("revision", [2**51 - 1, *further(2**49)])
def test_a_forged_revision_leaves_room_for_those_that_follow_in_its_scan(revision: int):
    bus = run_for(1.0)
    forge(bus, revision=revision)
    bus.run(1.0)
    bus.kill("area3")
    bus.run(1.0)
    bus.start("area3")
    bus.run(3.0)
    assert {state.quality for state in bus.states.values()} == {"good"}


def test_times_beyond_all_numbers_leave_no_state_that_cannot_be_read():
    bus = run_for(1.0)
    forge(bus, time=-1.7e308, clock=-1.7e308)
    bus.run(0.3)
    state = bus.states[VICTIM]
    assert state.header.time > STARTED_AT + 1.0
    assert state.rejected == {"numbers beyond reason": 1}
    assert max(map(abs, state.clock_skews.values())) < 0.01


@pytest.mark.parametrize("ahead_s", [FARTHEST, *further(0.0)])
def test_a_forged_number_of_telemetry_keeps_no_later_scan_from_being_good(ahead_s: float):
    """Of the plant's own incarnation, so that no restart ends it."""
    bus = run_for(2.0)
    readings = bus.telemetry_of(VICTIM)
    header = replace(readings.header, sequence=2**53 - 1, time=STARTED_AT + bus.now + ahead_s)
    bus.post(VICTIM, Received(replace(readings, header=header), ""))
    bus.run(2.0)
    for _ in range(2):
        assert seconds_of_next_scan(bus, set(bus.files)) < MOST_S
        bus.run(1.5)
    assert {state.quality for state in bus.states.values()} == {"good"}


@pytest.mark.parametrize("strategy", ["angle-offset", "admm"])
def test_a_forged_number_of_a_boundary_message_is_no_longer_the_newest_than_it_is_repeated(strategy: str):
    bus = run_for(2.0, strategy)
    kind = type(bus.protocols[VICTIM]._peers[NAMED].boundary)
    forge(bus, kind, sequence=2**53 - 1)
    bus.run(3.0)
    seconds_of_next_scan(bus, set(bus.files))
    bus.run(3.0)
    newest = bus.protocols[VICTIM]._peers[NAMED].boundary
    assert (newest.header.scan, newest.header.sequence) < (3, 2**52)
    assert newest.header.scan == bus.scan
