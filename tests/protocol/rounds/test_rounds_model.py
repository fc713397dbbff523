"""The protocol of rounds without its numbers: whatever is lost, late, dead or cut for a while, all come to one end."""

from __future__ import annotations

import itertools

import pytest

from agents.protocol.quality import GOOD
from agents.protocol.rounds import RoundsProtocol
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support import toy_history
from tests.support.ablations import ABLATIONS
from tests.support.levels import further
from tests.support.schedules import all_schedules, events_of, live_through
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links
from tests.support.toy_estimation import toy_numbers
from tests.support.toy_rounds import HEARTBEAT_S, TREES, ToyBus

LIMIT_S = 15.0
CAUGHT_BY_HISTORIES = {  # by which of them, which saves the search
    "says where it stands when idle": 0,
    "late readings raise": 0,
    "the set of links is fixed within a term": 15,
    "rejoins who is received": 13,
    "a restart raises": 14,
}
MOST_HISTORIES = 60


@pytest.mark.n_cases(few=12, long=200, many=20_000)
@pytest.mark.parametrize("tree", TREES)
def test_in_every_schedule_within_bounds_all_come_to_the_same_end(tree: str, n_cases: int):
    """Two messages lost or delayed; or a crash, a cut, two revisions at once, a scan at any moment, and one message."""
    schedules = list(all_schedules(tree, most_deviations=2, with_event=1))
    events = events_of(tree)
    for schedule in itertools.islice(schedules, 0, None, max(1, -(-len(schedules) // n_cases))):
        try:
            live_through(schedule, events)
        except AssertionError as error:
            raise AssertionError(f"{schedule}: {error}") from error


@pytest.mark.random_cases(few=8, long=60, many=2000)
def test_after_any_history_of_faults_all_are_good_on_the_last_scan(random_seed: int):
    toy_history.live_through(random_seed)


@pytest.mark.parametrize("rule", CAUGHT_BY_HISTORIES)
def test_without_one_of_its_rules_the_protocol_fails_in_some_history(rule: str):
    with ABLATIONS[rule]():
        for seed in (CAUGHT_BY_HISTORIES[rule], *range(MOST_HISTORIES)):
            try:
                toy_history.live_through(seed)
            except AssertionError:
                return
    pytest.fail(f"{MOST_HISTORIES} histories end well without the rule")


def end_of_a_one_way_link() -> dict[str, bool]:
    """Area -> whether it has come to an end of the last scan although the link a -> b passes nothing any more."""
    with toy_numbers():
        bus = ToyBus("three in a row")
        bus.run_until_at_rest(LIMIT_S)
        bus.cut(("a", "b"))
        bus.next_scan()
        bus.run(LIMIT_S)
        return {name: p.outcome is not None and p.scan == bus.scan for name, p in bus.protocols.items()}


def test_with_a_one_way_link_for_good_all_come_to_an_end():
    assert all(end_of_a_one_way_link().values())


def test_without_two_way_presence_a_one_way_link_stops_who_is_not_received():
    with ABLATIONS["presence is two-way"]():
        assert end_of_a_one_way_link() == {"a": False, "b": True, "c": True}


def ends_on_readings_known_to_be_outdated() -> bool:
    """Whether b ends a term on readings that it knows to be replaced, because it may not begin the next one yet."""
    with toy_numbers():
        bus = ToyBus("three in a row", lambda *_: 0.01)
        bus.run_until_at_rest(LIMIT_S)
        bus.read("b", bus.scan, 0.9)
        bus.run(0.015)
        bus.read("b", bus.scan, 0.91)
        bus.run(HEARTBEAT_S / 2)
        ends = bus.protocols["b"].outcome is not None
        bus.run_until_at_rest(LIMIT_S)
        return ends


def test_while_a_change_is_due_no_term_ends():
    assert not ends_on_readings_known_to_be_outdated()


def test_without_waiting_for_a_change_that_is_due_a_term_ends_on_outdated_readings():
    with ABLATIONS["while a change is due, sends and takes no Up or Down"]():
        assert ends_on_readings_known_to_be_outdated()


def test_every_rule_is_left_out_by_some_test():
    directed = {"presence is two-way", "while a change is due, sends and takes no Up or Down"}
    assert {*CAUGHT_BY_HISTORIES} | directed == ABLATIONS.keys()


# With real numbers


def ieee33(delay_s: float = 0.0) -> SimulatedBus:
    scenario = load_scenario("ieee33")
    files = with_links(area_files_of(scenario, strategy="information"), LinkFaults(delay_s=delay_s))
    return SimulatedBus(files, make_telemetry(scenario).by_area)


def scans_of(bus: SimulatedBus) -> dict[str, int]:
    """Area -> the scan that it has come to an end of, 0 while it has not."""
    rounds = {name: p for name, p in bus.protocols.items() if isinstance(p, RoundsProtocol)}
    return {name: p.scan if p.outcome else 0 for name, p in rounds.items()}


def test_with_a_one_way_link_for_good_the_last_scan_ends_everywhere_and_nobody_is_good():
    bus = ieee33()
    bus.run(1.0)
    bus.reject_delivery = lambda sender, receiver, message: (sender, receiver) == ("area2", "area1")
    for scan in range(2, 5):
        bus.next_scan(make_telemetry(load_scenario("ieee33"), scan=scan).by_area)
        bus.run(5.0)
    assert scans_of(bus) == dict.fromkeys(bus.files, 4)
    assert GOOD not in {state.quality for state in bus.states.values()}


@pytest.mark.parametrize("delay_s", [*further(0.0), 0.04])  # the exchange takes 15 ms, and longer than a scan
def test_a_scan_every_tenth_of_a_second_starves_nobody(delay_s: float):
    bus, ended = ieee33(delay_s), set()
    for scan in range(2, 42):
        bus.next_scan(make_telemetry(load_scenario("ieee33"), scan=scan).by_area)
        bus.run(0.1)
        ended.add(min(state.header.scan for state in bus.states.values()) if len(bus.states) == len(bus.files) else 0)
    assert len(ended - {0}) >= 4, f"in 4 s all have shown scans {sorted(ended)} only"
    bus.run(5.0)
    assert scans_of(bus) == dict.fromkeys(bus.files, 41)
    assert {state.quality for state in bus.states.values()} == {GOOD}
