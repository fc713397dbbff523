"""The operator's commands where clocks number scans: readings are taken anew in the same tick."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.packing import Header, Incarnation, TelemetryMessage
from agents.protocol.events import Ordered
from agents.protocol.numbering import TickReadings
from coordinator.lab.deployment.split import area_files
from dsse_core.grid.measurement import Source
from dsse_core.reading_rules import ANYBODY, ReadingRules
from scenarios.scenario import load_scenario

UTC = 1_800_000_000.0  # s since 1970, at monotonic time 0
RULES = ReadingRules(ticks="clock", gateways={ANYBODY: "all"})
CONTENT = replace(area_files(load_scenario("ieee33"), "run", ["tcp/127.0.0.1:7447"])[0], readings=RULES, scan_s=10.0)
METERS = tuple(meter.id for meter in CONTENT.meters if meter.source is not Source.VIRTUAL)


def read_all(value: float, at: float, sequence: int) -> TelemetryMessage:
    """A gateway has read ``value`` of every meter at ``at``, monotonic time."""
    header = Header("run", "north", Incarnation(1, 1), 0, sequence, UTC + at)
    n = len(METERS)
    return TelemetryMessage(header, "area1", METERS, (value,) * n, (0.01,) * n, (UTC + at,) * n, (True,) * n)


@pytest.fixture
def scan() -> TickReadings:
    """Readings of the tick at time 0, with a newer message that waits for the next one."""
    scan = TickReadings(CONTENT, 0.0, UTC)
    scan.take(read_all(1.0, 0.0, 1), 0.0)
    scan.enter(scan.next_scan, 0.0)
    scan.take(read_all(2.0, 1.0, 2), 1.0)
    assert values(scan) == dict.fromkeys(METERS, 1.0)
    return scan


def values(scan: TickReadings) -> dict[str, float]:
    return {m.meter.id: m.value for m in scan.readings.measurements if m.meter.source is not Source.VIRTUAL}


def test_a_scan_that_is_asked_for_takes_the_newest_readings_of_this_tick(scan: TickReadings):
    tick = scan.scan
    assert scan.follow(Ordered((1, 1, 1), (), scan=True))
    assert scan.are_outdated
    scan.enter(tick, 2.0)
    assert not scan.are_outdated
    assert values(scan) == dict.fromkeys(METERS, 2.0)


def test_a_new_term_of_the_tick_without_a_command_goes_on_with_what_was_taken(scan: TickReadings):
    scan.enter(scan.scan, 2.0)
    assert values(scan) == dict.fromkeys(METERS, 1.0)


def test_a_meter_that_is_off_is_in_no_snapshot_until_it_is_on(scan: TickReadings):
    assert scan.follow(Ordered((1, 1, 1), METERS[:2]))
    scan.enter(scan.scan, 2.0)
    assert values(scan).keys() == set(METERS[2:])
    assert not set(METERS[:2]) & {*scan.readings.unread, *scan.readings.invalid}
    assert not scan.follow(Ordered((1, 1, 2), METERS[:2])), "nothing has changed"
    assert scan.follow(Ordered((1, 1, 3), ()))
    scan.enter(scan.scan, 3.0)
    assert values(scan).keys() == set(METERS)
