"""Of each meter the reading that was measured last counts; what cannot be used is rejected, and ages grow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.messages.packing import Header, Incarnation, TelemetryMessage
from agents.protocol.configuration import Configuration
from agents.protocol.readings import Readings, ReadingStore
from coordinator.lab.deployment.split import area_files
from dsse_core.grid.measurement import MeasurementKind, Source
from dsse_core.reading_rules import KindRule, MetersOf, ReadingRules
from scenarios.scenario import load_scenario

NOW = 1.7e9  # s since 1970
RULES = {MeasurementKind.VM: KindRule(period_s=10.0, lowest=0.5, highest=1.5), MeasurementKind.P_FLOW: KindRule(60.0)}


def content(gateways: Mapping[str, MetersOf] | None = None, *, ticks: str = "clock") -> Configuration:
    area1 = area_files(load_scenario("ieee33"), "run", ["tcp/127.0.0.1:7447"])[0]
    rules = ReadingRules(ticks, "plant", gateways or {"*": "all"}, RULES)  # type: ignore[arg-type]
    return replace(area1, scan_s=1.0, readings=rules)


AREA = content()
METERS = [meter.id for meter in AREA.meters if meter.source is not Source.VIRTUAL]
VM, FLOW = "vm@1", next(meter_id for meter_id in METERS if meter_id.startswith("p_flow"))


def message(
    readings: Sequence[tuple[str, float, float]],
    gateway: str = "feeder",
    *,
    sequence: int = 1,
    start: int = 1,
    valid: bool = True,
    sigma: float = 0.01,
) -> TelemetryMessage:
    """``readings``: meter, value, and when it was read, s after ``NOW``."""
    header = Header("run", gateway, Incarnation(start, 1), 0, sequence, NOW)
    meters, values, times = zip(*readings, strict=True)
    n = len(readings)
    return TelemetryMessage(header, "area1", meters, values, (sigma,) * n, tuple(NOW + t for t in times), (valid,) * n)


def taken(store: ReadingStore, at: float = 0.0, area: Configuration = AREA) -> Readings:
    readings = Readings(area, store)
    list(readings.take(None, at, NOW + at))
    return readings


def sigma_of(readings: Readings, meter_id: str) -> float:
    return next(m.sigma for m in readings.measurements if m.meter.id == meter_id)


MESSAGES = st.lists(
    st.builds(
        lambda reading, gateway, sequence: message(reading, gateway, sequence=sequence),
        st.lists(
            st.tuples(st.sampled_from(METERS[:4]), st.floats(0.5, 1.5), st.integers(-5, 0)),
            min_size=1,
            max_size=4,
            unique_by=lambda reading: reading[0],
        ),
        st.sampled_from(["feeder", "substation"]),
        st.integers(1, 5),
    ),
    max_size=6,
    unique_by=lambda m: (m.header.sender, m.header.sequence),
)


@given(MESSAGES, st.randoms(use_true_random=False))
def test_neither_the_order_of_messages_nor_how_often_they_come_matters(messages, random):
    store, other = ReadingStore(AREA), ReadingStore(AREA)
    for each in messages:
        store.take(each, NOW)
    shuffled = [*messages, *random.choices(messages, k=len(messages))] if messages else []
    random.shuffle(shuffled)
    for each in shuffled:
        other.take(each, NOW)
    assert store.newest == other.newest
    assert taken(store).measurements == taken(other).measurements


def test_the_variance_doubles_at_the_period():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, -10.0), (FLOW, 0.2, -30.0)]), NOW)
    readings = taken(store)
    assert sigma_of(readings, VM) == pytest.approx(0.01 * math.sqrt(2.0))
    assert sigma_of(readings, FLOW) == pytest.approx(0.01 * math.sqrt(1.5))
    assert readings.ages.oldest_s == 30.0


def test_a_reading_without_period_does_not_age():
    store = ReadingStore(AREA)
    meter_id = next(meter_id for meter_id in METERS if meter_id.startswith("p_injection"))
    store.take(message([(meter_id, 0.1, -4.0)]), NOW)
    assert sigma_of(taken(store), meter_id) == 0.01


def test_a_reading_that_is_too_old_is_left_out_and_named():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, -51.0), (FLOW, 0.2, -51.0)]), NOW)
    readings = taken(store)
    assert readings.too_old == [VM]
    assert VM not in {m.meter.id for m in readings.measurements}
    assert VM not in readings.unread
    assert readings.ages.times == {FLOW: NOW - 51.0}


@pytest.mark.parametrize(
    ("value", "time", "sigma", "valid", "reason"),
    [
        (1.0, 1.1, 0.01, True, "time in the future"),
        (1.6, 0.0, 0.01, True, "reading out of range"),
        (0.4, 0.0, 0.01, True, "reading out of range"),
        (1.0, 0.0, 0.01, False, "marked invalid"),
        (1.0, 0.0, 0.0, True, "sigma not positive"),
        (1.0, 0.0, 1e-300, True, "reading beyond reason"),
    ],
)
def test_a_rejected_reading_does_not_replace_a_good_one(value, time, sigma, valid, reason):
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.01, -1.0)]), NOW)
    rejected = message([(VM, value, time)], sequence=2, sigma=sigma, valid=valid)
    for _ in range(3):  # a repeat counts once
        assert not store.take(rejected, NOW)
    assert store.newest[VM].value == 1.01
    assert store.rejected == {reason: 1}
    assert taken(store).why_rejected == {VM: reason}
    store.take(message([(VM, 1.02, 0.5)], sequence=3), NOW)
    assert taken(store).why_rejected == {}


def test_a_reading_from_the_future_is_taken_once_its_time_has_come():
    store = ReadingStore(AREA)
    ahead = message([(VM, 1.0, 5.0)])
    assert not store.take(ahead, NOW)
    assert store.take(ahead, NOW + 5.0)


def test_a_reading_left_in_the_future_by_a_clock_that_was_set_back_is_not_used():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, 0.0)]), NOW)
    readings = taken(store, -3600.0)
    assert readings.why_rejected == {VM: "time in the future"}
    assert VM not in readings.ages.times


def test_readings_taken_before_all_clocks_were_set_back_do_not_keep_out_those_that_come_after():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, 3600.0)]), NOW + 3600.0)
    assert store.take(message([(VM, 1.1, 0.0)], sequence=2), NOW)
    readings = taken(store)
    assert store.newest[VM].value == 1.1
    assert readings.why_rejected == {}
    assert VM in readings.ages.times


def test_a_gateway_cannot_speak_for_the_meter_of_another():
    store = ReadingStore(content({"substation": (VM,), "feeder": (FLOW,)}))
    store.take(message([(VM, 9.0, 0.0), (FLOW, 0.2, 0.0), ("vm@999", 1.0, 0.0)], "feeder"), NOW)
    store.take(message([(FLOW, 0.2, 0.0)], "stranger"), NOW)
    assert store.newest.keys() == {FLOW}
    assert store.rejected == {"meter of another gateway": 2, "unknown meter": 1}
    assert store.why_rejected == {}


def test_a_gateway_whose_clock_was_set_back_does_not_hide_what_is_younger():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, -1.0)], start=1000), NOW)
    assert not store.take(message([(VM, 1.2, -3600.0)], start=1), NOW)
    assert store.take(message([(VM, 1.1, 0.0)], start=2), NOW)
    assert store.newest[VM].value == 1.1


def test_of_two_gateways_of_one_meter_the_newer_reading_counts():
    store = ReadingStore(AREA)
    store.take(message([(VM, 1.0, -1.0)], "substation"), NOW)
    store.take(message([(VM, 1.1, -0.5)], "feeder"), NOW)
    store.take(message([(VM, 1.2, -0.8)], "substation", sequence=2), NOW)
    assert store.newest[VM].value == 1.1


def test_meters_that_are_off_are_neither_read_nor_missed():
    store = ReadingStore(AREA)
    store.take(message([(meter_id, 1.0, 0.0) for meter_id in METERS]), NOW)
    store.off = frozenset({VM})
    readings = taken(store)
    assert VM not in {m.meter.id for m in readings.measurements}
    assert VM not in readings.unread
    assert readings.ages.overdue_share(0.0) == 0.0


def test_shares_and_moments_of_overdue_readings():
    store = ReadingStore(AREA)
    others = [(meter_id, 1.0, 0.0) for meter_id in METERS if meter_id not in (VM, FLOW)]
    store.take(message([(VM, 1.0, -5.0), *others]), NOW)
    readings = taken(store)
    n = len(METERS)
    assert readings.ages.overdue_share(0.0) == pytest.approx(1 / n)  # FLOW has none
    assert readings.ages.next_overdue(0.0) == 3.0  # those that read at every scan
    assert readings.ages.find_overdue(2.9) == []
    assert VM not in readings.ages.find_overdue(15.9)
    assert VM in readings.ages.find_overdue(16.0)
    assert readings.ages.overdue_share(121.0) == 1.0


def test_where_a_gateway_numbers_scans_its_readings_without_period_belong_to_theirs():
    area = content({"plant": "all"}, ticks="gateway")
    store = ReadingStore(area)
    meter_id = next(meter_id for meter_id in METERS if meter_id.startswith("p_injection"))
    first = message([(VM, 1.0, -10.0), (meter_id, 0.1, -4.0)], "plant")
    second = message([(VM, 1.0, -10.0)], "plant", sequence=2)
    readings = Readings(area, store)
    for each, found in ((first, {VM, meter_id}), (second, {VM})):
        store.take(each, NOW)
        assert list(readings.take(each, 0.0, NOW)) == []
        assert readings.ages.times.keys() == found
    assert meter_id in readings.unread


def test_a_scan_that_is_sent_again_at_every_heartbeat_is_not_looked_through_meter_by_meter(
    monkeypatch: pytest.MonkeyPatch,
):
    area = replace(AREA, readings=ReadingRules())
    store, looks = ReadingStore(area), []
    monkeypatch.setattr(ReadingStore, "is_of_scan", lambda *of: looks.append(of) or True)
    assert not store.take(message([(VM, 1.0, 0.0), (FLOW, 0.1, 0.0)], "plant"), NOW)
    assert (looks, store.newest) == ([], {})
