"""Scans that clocks number: areas take what there is, aged, and agree on the estimate of what they have taken."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from agents.messages.packing import StateMessage, TelemetryMessage
from coordinator.lab.simulator.simulator import STARTED_AT
from dsse_core.link_faults import LinkFaults
from tests.support.ticking import SCAN_S, Ticking, by_clock

AREAS = ("area1", "area2", "area3")
SHARP = 1e-9  # p.u. and rad


def kept(message: TelemetryMessage, keep: list[int]) -> TelemetryMessage:
    columns = ("meters", "values", "sigmas", "times", "valid")
    return replace(message, **{name: tuple(getattr(message, name)[k] for k in keep) for name in columns})


@pytest.mark.parametrize("name", ["ieee33", "industrial13"])
def test_meters_of_one_second_five_and_a_minute_make_one_estimate(name):
    run = Ticking(by_clock(name))
    run.run(0.9)
    for _ in range(7):
        run.run(SCAN_S)
        assert run.find_gap() < SHARP
        assert set(run.qualities().values()) == {"good"}
    state = run.bus.states["area1"]
    assert state.header.scan == int(STARTED_AT) + 7
    assert state.taken_at == pytest.approx(STARTED_AT + 7.0)
    assert state.oldest_reading == pytest.approx(7.0)
    assert state.telemetry_age < SCAN_S


def test_late_partial_and_lost_readings_are_normal():
    def spoil(message: TelemetryMessage, now: float) -> TelemetryMessage | None:
        second = round(now)
        if message.area == "area2" and second % 3 == 1:
            return None
        half = [k for k in range(len(message.meters)) if (k + second) % 2]
        return kept(message, half) if message.area == "area3" and second % 2 else message

    run = Ticking(by_clock(), spoil)
    run.run(0.9)
    for _ in range(8):
        run.run(SCAN_S)
        assert run.find_gap() < SHARP
        assert set(run.qualities().values()) == {"good"}
    ages = {r.header.sender: r.taken_at - min(r.times) for r in run.readings[-3:]}
    assert ages["area2"] >= 1.0


def test_each_area_says_once_per_scan_what_it_has_used():
    run = Ticking(by_clock())
    run.run(5.5)
    counts = Counter((r.header.sender, r.header.scan) for r in run.readings)
    assert set(counts.values()) == {1}
    assert {scan for _, scan in counts} == {int(STARTED_AT) + k for k in range(6)}
    first, last = [r for r in run.readings if r.header.sender == "area1"][:: len(run.readings) // 3 - 1]
    sigmas = dict(zip(last.meters, last.sigmas, strict=True))
    grown = {k: (sigmas[k] / sigma) ** 2 for k, sigma in zip(first.meters, first.sigmas, strict=True)}
    for meter_id, growth in grown.items():  # those of a tick itself are there for the next one only
        kind = meter_id.partition("@")[0]
        expected = 1 + {"vm": 1.0 / 1.0, "p_flow": 5.0 / 5.0, "q_flow": 5.0 / 5.0}.get(kind, 5.0 / 60.0)
        assert growth == pytest.approx(expected, rel=0.01), meter_id


def test_where_readings_end_states_say_so_also_between_ticks():
    shown: list[tuple[float, StateMessage]] = []
    kept = {"measurements__voltage__oldest_s": 100.0, "measurements__flow__oldest_s": 100.0}
    scenario = by_clock(measurements__flow__period_s=1.0, measurements__injection__period_s=8.0, **kept)
    run = Ticking(scenario, on_state=lambda at, state: shown.append((at, state)))
    run.run(2.5)
    run.publishes = False  # read last at 2.0
    run.run(2.4)
    assert set(run.qualities().values()) == {"good"}
    run.run(0.3)  # those of 1 s are overdue from 5.0 on: two intervals, and the scan that uses them
    assert "degraded" in run.qualities().values()
    degraded = next(at for at, state in shown if "overdue" in "; ".join(state.notes))
    assert degraded == pytest.approx(5.0, abs=0.01)
    run.run(13.0)  # those of 8 s, read at 0, are overdue from 17 on
    assert set(run.qualities().values()) == {"stale"}
    assert "all readings of this area are overdue or missing" in run.notes_of("area1")
    run.publishes = True
    run.run(2.5)
    assert set(run.qualities().values()) == {"good"}
    assert run.find_gap() < SHARP


def test_an_area_whose_readings_are_overdue_leaves_nobody_good():
    scenario = by_clock(measurements__flow__period_s=1.0)
    run = Ticking(scenario, lambda message, now: None if message.area == "area2" and now > 2.5 else message)
    run.run(6.5)
    assert run.qualities() == dict.fromkeys(AREAS, "degraded")
    assert "behind area2 something is missing or old" in run.notes_of("area1")
    assert run.find_gap() < SHARP


SPOILT = ("vm@1", "vm@22", "p_flow@1:1-2")


def test_rejected_readings_are_counted_and_named_and_the_ones_before_stand_in():
    def spoil(message: TelemetryMessage, now: float) -> TelemetryMessage:
        if message.area != "area1" or not 1.5 < now < 2.5:
            return message
        values, valid, times = [*message.values], [*message.valid], [*message.times]
        one, two, three = map(message.meters.index, SPOILT)
        values[one], valid[two], times[three] = 7.0, False, STARTED_AT + 3600
        return replace(message, values=tuple(values), valid=tuple(valid), times=tuple(times))

    run = Ticking(by_clock(measurements__voltage__highest_pu=1.5), spoil)
    run.run(1.9)
    assert run.bus.states["area1"].rejected == {}
    run.run(1.5)
    state = run.bus.states["area1"]
    assert state.rejected == {"reading out of range": 1, "marked invalid": 1, "time in the future": 1}
    assert state.quality == "good"
    used = next(r for r in reversed(run.readings) if r.header.sender == "area1")
    assert run.find_gap() < SHARP
    assert set(SPOILT) <= set(used.meters)
    for reason in ("reading out of range", "marked invalid", "time in the future"):
        assert reason in run.notes_of("area1")


def test_a_restarted_area_takes_the_readings_anew():
    run = Ticking(by_clock())
    run.run(3.3)
    run.bus.kill("area2")
    run.run(0.1)
    run.bus.start("area2")
    run.run(2.5)
    assert set(run.qualities().values()) == {"good"}
    assert run.find_gap() < SHARP
    incarnations = {r.header.incarnation for r in run.readings if r.header.sender == "area2"}
    assert len(incarnations) == 2


def test_ticks_faster_than_the_exchange_are_skipped():
    links = LinkFaults(delay_s=0.4)
    scenario = by_clock()
    faults = replace(scenario.faults, links=dict.fromkeys(scenario.faults.links, links))
    run = Ticking(replace(scenario, faults=faults))
    run.run(20.0)
    scans = [r.header.scan for r in run.readings if r.header.sender == "area1"]
    assert scans == sorted(scans)
    assert 3 <= len(scans) < 15
    assert all(state.buses for state in run.bus.states.values())


@pytest.mark.parametrize("strategy", ["angle-offset", "admm"])
def test_asynchronous_strategies_take_a_tick_too(strategy):
    run = Ticking(by_clock(strategy=strategy, measurements__injection__period_s=1.0))
    run.run(2.5)
    assert {state.header.scan for state in run.bus.states.values()} == {int(STARTED_AT) + 2}
    run.publishes = False
    run.run(10.0)
    assert set(run.qualities().values()) == {"stale"}


def test_without_a_reading_an_area_goes_on_and_says_so():
    run = Ticking(by_clock(), lambda message, now: None if message.area == "area2" else message)
    run.run(1.9)
    assert run.qualities()["area2"] == "stale"
    assert "good" not in run.qualities().values()
