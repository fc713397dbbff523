"""What a source hands over is used, or counted with its reason; nothing else is lost by it."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from coordinator.field.gateway import counts as reasons
from coordinator.field.gateway.counts import MOST_NAMED, MOST_REASONS, Counts
from coordinator.field.gateway.intake import Intake
from coordinator.field.gateway.maps.map_file import GatewayMap

NOW = 1_800_000_000.0


@pytest.fixture
def intake(two_meters: GatewayMap) -> Intake:
    return Intake(two_meters.points, lambda: NOW)


def find_sum(intake: Intake) -> int:
    """Of all fates of readings, those that wait included."""
    counts = intake.counts
    rejected = sum(found.count for found in counts.rejected.values())
    return counts.used + counts.superseded + rejected + sum(map(len, intake.waiting.values()))


def test_a_reading_is_in_per_unit_with_its_sigma(intake: Intake) -> None:
    intake("U1", 12.66, NOW - 2)
    intake("P1", 3000, NOW - 3)
    of_area = intake.newest["area1"]
    assert of_area["vm@1"].value == pytest.approx(1.0)
    assert of_area["vm@1"].sigma == pytest.approx(0.02 / 12.66)
    assert of_area["p_flow@1:1-2"].value == pytest.approx(3.0 / 10)
    assert of_area["p_flow@1:1-2"].sigma == pytest.approx(0.01 * of_area["p_flow@1:1-2"].value)
    assert of_area["p_flow@1:1-2"].time == NOW - 3


@pytest.mark.parametrize(
    ("address", "value", "time", "unit", "reason"),
    [
        ("nowhere", 1.0, None, None, reasons.UNKNOWN),
        ("U1", "n/a", None, None, reasons.BAD_TYPE),
        ("U1", True, None, None, reasons.BAD_TYPE),
        ("U1", None, None, None, reasons.BAD_TYPE),
        ("U1", [12.66], None, None, reasons.BAD_TYPE),
        ("U1", math.nan, None, None, reasons.NOT_FINITE),
        ("U1", -math.inf, None, None, reasons.NOT_FINITE),
        ("U1", 10**400, None, None, reasons.NOT_FINITE),
        ("U1", 12.66, None, "V", reasons.WRONG_UNIT),
        ("U1", 12660.0, None, None, reasons.OUT_OF_RANGE),
        ("U1", -12.66, None, None, reasons.OUT_OF_RANGE),
        ("U1", 12.66, NOW + 3600, None, reasons.AHEAD),
        ("U1", 12.66, "noon", None, reasons.BAD_TIME),
        ("U1", 12.66, math.nan, None, reasons.BAD_TIME),
        ("U1", 12.66, 17.0, None, reasons.BAD_TIME),
        ("U1", 12.66, NOW - 3600, None, reasons.OLDER),
        ("U1", 12.5, NOW - 1, None, reasons.TWICE),
    ],
)
def test_bad_input_is_counted_and_named_and_takes_no_good_reading_away(
    intake: Intake, address: str, value: object, time: float | None, unit: str | None, reason: str
) -> None:
    intake("U1", 12.7, NOW - 1)
    intake(address, value, time, unit=unit)
    intake("P1", 100.0)
    rejected = intake.counts.rejected
    assert list(rejected) == [reason]
    assert rejected[reason].count == 1
    assert rejected[reason].addresses == {address: 1}
    assert address in rejected[reason].last
    assert intake.newest["area1"]["vm@1"].value == pytest.approx(12.7 / 12.66)
    assert set(intake.newest["area1"]) == {"vm@1", "p_flow@1:1-2"}
    assert find_sum(intake) == intake.counts.received == 3
    json.dumps(intake.counts.as_json(), allow_nan=False)


def test_numbers_of_numpy_that_are_pythons_count(intake: Intake) -> None:
    intake("U1", np.float64(12.66))
    assert intake.newest["area1"]["vm@1"].value == pytest.approx(1.0)


def test_a_flood_takes_nothing_from_other_meters_and_every_reading_of_it_is_counted(intake: Intake) -> None:
    intake("P1", 100.0)
    for k in range(10_000):
        intake("U1", 12.0 + k / 1e5)
        intake("strange" + str(k), 1.0)
    assert intake.take_waiting("area1") == 2
    assert intake.counts.received == 20_001 == find_sum(intake)
    assert intake.counts.superseded == 9_999
    assert intake.counts.rejected[reasons.UNKNOWN].count == 10_000
    assert len(intake.counts.rejected[reasons.UNKNOWN].addresses) == MOST_NAMED
    assert intake.newest["area1"]["vm@1"].value == pytest.approx(12.09999 / 12.66)


def test_a_flood_is_logged_a_few_times(two_meters: GatewayMap) -> None:
    warnings: list[str] = []
    intake = Intake(two_meters.points, lambda: NOW, counts=Counts(warn=warnings.append))
    for _ in range(1000):
        intake("U1", "bad\x1b[31m")
    assert len(warnings) == 4
    assert all("bad type" in line and "U1" in line and "\x1b" not in line for line in warnings)


def test_a_source_cannot_make_any_number_of_reasons() -> None:
    counts = Counts(warn=lambda _: None)
    for k in range(1000):
        counts.reject(f"reason {k}", "", "a line")
    assert len(counts.rejected) == MOST_REASONS + 1
    assert sum(found.count for found in counts.rejected.values()) == 1000


def test_a_reading_that_its_source_does_not_vouch_for_is_passed_on_as_such(intake: Intake) -> None:
    intake("U1", 12.66, valid=False)
    assert not intake.newest["area1"]["vm@1"].valid
    assert intake.counts.invalid == 1


def test_after_the_clock_was_set_back_readings_are_taken_again(two_meters: GatewayMap) -> None:
    clock = [NOW]
    intake = Intake(two_meters.points, lambda: clock[0])
    intake("U1", 12.66)
    clock[0] = NOW - 3600
    intake("U1", 12.5)
    assert intake.newest["area1"]["vm@1"].value == pytest.approx(12.5 / 12.66)


def test_two_readings_without_a_time_in_one_instant_are_one_after_the_other(intake: Intake) -> None:
    intake("U1", 12.6)
    intake("U1", 12.7)
    assert intake.newest["area1"]["vm@1"].value == pytest.approx(12.7 / 12.66)
    assert not intake.counts.rejected
