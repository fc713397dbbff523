"""What a scenario says of gateways, intervals and ticks becomes the rules of each area, or one clear error."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from coordinator.lab.deployment.split import area_files
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.reading_rules import DEFAULT_RULES, KindRule
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.scenario_mistakes import GOOD, problems_of, the_only

LIVE = GOOD.replace('source = "network"', 'source = "live"').replace("noise = true", "") + "\n"
WITH_SCAN = {"run.scan_s": 1.0}


def live(tmp_path: Path, more: str = "", **changes: object) -> Scenario:
    path = tmp_path / "live.toml"
    path.write_text(LIVE + more, encoding="utf-8")
    return load_scenario(path, changes=WITH_SCAN | changes)


def test_a_scenario_without_any_of_this_has_the_rules_of_before():
    scenario = load_scenario("ieee33")
    assert scenario.renew_s is None
    assert all(rules == DEFAULT_RULES for rules in scenario.reading_rules.values())


def test_live_readings_follow_clocks_and_any_gateway_sends_where_none_is_named(tmp_path):
    rules = live(tmp_path).reading_rules["area1"]
    assert rules.ticks == "clock"
    assert rules.gateways == {"*": "all"}
    assert rules.meters_of("whoever") == "all"


def test_live_readings_cannot_be_made(tmp_path):
    with pytest.raises(InvalidInputError, match="its readings come from gateways while it runs"):
        make_telemetry(live(tmp_path))


def test_clocks_need_the_time_between_two_scans(tmp_path):
    assert "give run.scan_s" in the_only(problems_of(tmp_path, LIVE))


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_rules_and_clock_errors_are_written_into_area_files_and_read_back(tmp_path, suffix):
    gateways = '[gateways.substation]\nareas = ["area1"]\nmeters = ["vm@1", "p_flow@1:*"]\n'
    gateways += '[gateways.feeder]\nareas = "all"\n'
    changes: dict[str, object] = {
        "measurements.voltage.period_s": 5.0,
        "measurements.voltage.lowest_pu": 0.5,
        "measurements.flow.period_s": 60.0,
        "measurements.flow.aging_s": 900.0,
        "quality.most_overdue": 0.4,
        "faults.clock_error_s": {"area2": 3.0},
    }
    scenario = live(tmp_path, gateways, **changes)
    one, two, _ = area_files(scenario, "run", ["tcp/127.0.0.1:7447"])
    assert one.readings.gateways == {"substation": ("vm@1", "p_flow@1:1-2"), "feeder": "all"}
    assert two.readings.gateways == {"feeder": "all"}
    assert one.readings.kinds[MeasurementKind.VM] == KindRule(5.0, lowest=0.5)
    assert one.readings.kinds[MeasurementKind.Q_FLOW] == KindRule(60.0, aging_s=900.0)
    assert (one.clock_error_s, two.clock_error_s, one.limits.most_overdue) == (0.0, 3.0, 0.4)
    path = tmp_path / f"area{suffix}"
    for content in (one, two):
        save_area_file(path, content)
        assert load_area_file(path) == content


def test_ranges_of_angles_are_given_in_degrees():
    angle = {"buses": [1], "sigma_deg": 0.1, "lowest_deg": -30.0, "highest_deg": 30.0}
    scenario = load_scenario("ieee33", changes={"measurements.angle": angle})
    rule = scenario.reading_rules["area1"].kinds[MeasurementKind.VA]
    assert (rule.lowest, rule.highest) == pytest.approx((-math.pi / 6, math.pi / 6))


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ('[gateways.g]\nareas = ["area7"]\n', "gateways.g.areas: unknown area 'area7'"),
        ('[gateways.g]\nareas = "all"\nmeters = ["vm@*", "temp@*"]\n', "gateways.g.meters: 'temp@*' is no meter"),
        ('[gateways.g]\nareas = ["area1", "area2"]\n', "no gateway reads meter"),
        ("[faults.clock_error_s]\narea9 = 1.0\n", "faults.clock_error_s.area9: there is no area 'area9'"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, more, problem):
    with pytest.raises(InvalidInputError) as caught:
        live(tmp_path, more)
    assert any(problem in found for found in caught.value.problems), caught.value.problems


def test_a_leader_that_is_no_gateway_is_named(tmp_path):
    changes = {"telemetry.ticks": "gateway", "telemetry.leader": "scada"}
    with pytest.raises(InvalidInputError, match=r"telemetry\.leader: unknown gateway 'scada'"):
        live(tmp_path, '[gateways.feeder]\nareas = "all"\n', **changes)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"measurements.flow.aging_s": 3.0}, "readings without period_s do not age"),
        ({"measurements.voltage.lowest_pu": 1.2, "measurements.voltage.highest_pu": 1.0}, "must be below highest_pu"),
        ({"measurements.voltage.period_s": 0.0}, "measurements.voltage.period_s"),
    ],
)
def test_impossible_intervals_and_ranges_are_named(changes, problem):
    with pytest.raises(InvalidInputError, match=problem):
        load_scenario("ieee33", changes=changes)


def test_intervals_count_from_the_longer_of_period_and_scan():
    rule = KindRule(period_s=5.0)
    assert (rule.overdue_s(1.0), rule.overdue_s(60.0), rule.overdue_s(None)) == (11.0, 180.0, 10.0)
    assert (rule.leaves_out_s(1.0), rule.leaves_out_s(60.0)) == (25.0, 300.0)
    assert KindRule().overdue_s(None) == KindRule().leaves_out_s(None) == math.inf
