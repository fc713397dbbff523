"""Telemetry: repeatable per seed, distributed as its sigmas say, and true where it should be."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source, check_measurements
from scenarios.check import check_scenario
from scenarios.files.shipped_files import find_shipped
from scenarios.meters import SigmaRule
from scenarios.scenario import Scenario, TelemetrySettings, load_scenario
from scenarios.telemetry import make_telemetry, sum_up_ids

KIND = MeasurementKind


def silent(scenario: Scenario) -> Scenario:
    return replace(scenario, telemetry=replace(scenario.telemetry, noise=False))


def readings(scenario: Scenario, scan: int = 1) -> dict[str, Measurement]:
    return {m.meter.id: m for m in make_telemetry(scenario, scan).union}


def test_the_same_seed_and_scan_give_the_same_telemetry() -> None:
    scenario = load_scenario("ieee33")
    assert make_telemetry(scenario, 3).by_area == make_telemetry(load_scenario("ieee33"), 3).by_area


@pytest.mark.parametrize("name", sorted(find_shipped("shipped")))
def test_the_noise_of_a_meter_belongs_to_its_id(name: str) -> None:
    scenario = load_scenario(name)
    expected = [zlib.crc32(meter.id.encode()) for meter in scenario.meters]
    assert sum_up_ids(scenario.network, scenario.meters).tolist() == expected


@pytest.mark.parametrize(("seed", "scan"), [(2, 1), (1, 2)])
def test_another_seed_or_scan_gives_other_noise_at_every_meter(seed: int, scan: int) -> None:
    scenario = load_scenario("ieee33")
    first, other = readings(scenario), readings(replace(scenario, seed=seed), scan)
    for meter_id, measurement in first.items():
        if measurement.meter.source is not Source.VIRTUAL:
            assert measurement.value != other[meter_id].value
            assert measurement.sigma == other[meter_id].sigma


def test_the_noise_of_a_meter_does_not_depend_on_the_other_meters() -> None:
    scenario = load_scenario("ieee33")
    fewer = readings(replace(scenario, meters=scenario.meters[::-3]))
    everything = readings(scenario)
    assert fewer
    assert all(everything[meter_id] == measurement for meter_id, measurement in fewer.items())


def test_a_relative_sigma_refers_to_the_hypotenuse_of_p_and_q_to_the_bit() -> None:
    scenario = load_scenario("ieee33")
    own = readings(silent(scenario))
    for branch in scenario.network.active_branches:
        p, q = (own[f"{kind}@{branch.from_bus}:{branch.id}"] for kind in ("p_flow", "q_flow"))
        expected = max(0.01 * float(np.hypot(p.value, q.value)), scenario.sigma_rule.floor)
        assert p.sigma == q.sigma == expected


def test_the_noise_is_standard_normal_in_units_of_sigma() -> None:
    """120 scans of all meters: mean, spread and 2-sigma tails within four standard errors."""
    scenario = load_scenario("industrial13")
    truth = {meter_id: m.value for meter_id, m in readings(silent(scenario)).items()}
    noise = np.array(
        [
            (m.value - truth[meter_id]) / m.sigma
            for scan in range(1, 121)
            for meter_id, m in readings(scenario, scan).items()
            if m.sigma > 0
        ]
    )
    n = len(noise)
    assert n > 5000
    assert abs(noise.mean()) < 4 / math.sqrt(n)
    assert abs(noise.std() - 1) < 4 / math.sqrt(2 * n)
    tail = math.erfc(2 / math.sqrt(2))
    assert abs((abs(noise) > 2).mean() - tail) < 4 * math.sqrt(tail * (1 - tail) / n)


def test_every_reading_without_noise_is_the_truth() -> None:
    scenario = silent(load_scenario("ieee33"))
    telemetry = make_telemetry(scenario)
    assert all(m.value == telemetry.truth.read(m.meter) for m in telemetry.union)


@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_the_union_is_what_the_areas_have_and_fits_the_estimator(name: str) -> None:
    scenario = load_scenario(name)
    telemetry = make_telemetry(scenario)
    check_measurements(scenario.network, telemetry.union)
    by_area = [m for measurements in telemetry.by_area.values() for m in measurements]
    assert sorted(m.meter.id for m in by_area) == sorted(m.meter.id for m in telemetry.union)
    for area in scenario.partition.areas:
        check_measurements(area.network, telemetry.by_area[area.name])


@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_noise_free_telemetry_gives_back_the_power_flow(name: str) -> None:
    telemetry = make_telemetry(silent(load_scenario(name)))
    result = estimate_state(telemetry.truth.network, telemetry.union, tolerance=1e-10)
    np.testing.assert_allclose(result.vm, telemetry.truth.vm, atol=1e-9)
    np.testing.assert_allclose(result.va, telemetry.truth.va, atol=1e-9)


def test_a_percentage_of_power_refers_to_the_apparent_power_and_has_a_floor() -> None:
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario)
    sigma = {m.meter.id: m.sigma for m in telemetry.union}

    def apparent(place: Meter, other: MeasurementKind) -> float:
        return math.hypot(telemetry.truth.read(place), telemetry.truth.read(replace(place, kind=other)))

    flow = Meter(KIND.P_FLOW, 1, "1-2")
    assert sigma["p_flow@1:1-2"] == pytest.approx(0.01 * apparent(flow, KIND.Q_FLOW))
    assert sigma["q_flow@1:1-2"] == sigma["p_flow@1:1-2"]
    assert sigma["p_injection@24"] == pytest.approx(0.1 * abs(0.042 + 0.02j))
    assert sigma["vm@16"] == pytest.approx(0.002 * 0.922)
    assert sigma["p_flow@32:32-33"] == 1e-4  # 1 % of 0.06 + j0.04 MVA is less than the floor of 1 kVA on 10 MVA
    assert min(s for s in sigma.values()) >= 1e-4


def test_an_absolute_sigma_has_no_floor_and_a_current_has_one() -> None:
    rule = SigmaRule(relative={KIND.CURRENT: 0.01}, absolute={KIND.P_FLOW: 1e-9}, floor=1e-4)
    meters = [Meter(KIND.P_FLOW, 1, "1-2"), *2 * [Meter(KIND.CURRENT, 1, "1-2")]]
    assert rule.sigmas(meters, np.array([1.0, 0.0, 2.0])).tolist() == [1e-9, 1e-4, 0.02]


def test_virtual_measurements_are_exact_zeros_and_belong_to_the_owner_of_their_bus() -> None:
    scenario = load_scenario("industrial13")
    by_area = make_telemetry(scenario).by_area
    for area, measurements in by_area.items():
        for m in measurements:
            if m.meter.source is Source.VIRTUAL:
                assert (m.value, m.sigma) == (0.0, 0.0)
                assert scenario.partition.owner_of_bus[m.meter.bus] == area


def test_a_gross_error_moves_its_meter_by_so_many_sigmas_and_no_other() -> None:
    scenario = load_scenario("ieee33")
    settings = TelemetrySettings(source="network", noise=True, gross_errors={"p_flow@3:3-4": 20.0})
    clean, wrong = readings(scenario), readings(replace(scenario, telemetry=settings))
    moved = {meter_id for meter_id in clean if clean[meter_id] != wrong[meter_id]}
    assert moved == {"p_flow@3:3-4"}
    m = clean["p_flow@3:3-4"]
    assert wrong["p_flow@3:3-4"].value == pytest.approx(m.value + 20 * m.sigma)


def test_all_kinds_of_meters_can_stand_in_one_scenario(tmp_path: Path) -> None:
    text = find_shipped("shipped")["industrial13"].read_text(encoding="utf-8")
    angle = "angle = { buses = [1, 4], sigma_deg = 0.5 }"
    current = 'current = { branches = ["1-2"], sigma_pu = 0.01 }'
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("[measurements]", f"[measurements]\n{angle}\n{current}", 1), encoding="utf-8")
    found = readings(load_scenario(path))
    assert found["va@4"].sigma == pytest.approx(math.radians(0.5))
    assert found["current@1:1-2"].sigma == 0.01


def test_area_power_flow_readings_come_from_the_areas_own_power_flow() -> None:
    scenario = load_scenario("ieee33-thesis")
    telemetry = make_telemetry(scenario)
    assert telemetry.area_power_flows.keys() == {"area1", "area2", "area3"}
    for area, measurements in telemetry.by_area.items():
        result = telemetry.area_power_flows[area]
        assert all(m.value == result.read(m.meter) for m in measurements)
    area3 = telemetry.area_power_flows["area3"]
    assert area3.vm[area3.network.row[30]] == pytest.approx(0.935)  # its local slack, not the generator's 0.928
    assert area3.va[area3.network.row[30]] == 0.0


def test_readings_of_the_network_ignore_the_load_error() -> None:
    wrong = load_scenario("ieee33-load-error")
    right = replace(wrong, load_error=dict.fromkeys(wrong.load_error, 0j))
    assert make_telemetry(wrong).by_area == make_telemetry(right).by_area


def test_area_power_flow_without_a_local_slack_voltage_names_the_area_and_the_keys() -> None:
    scenario = load_scenario("industrial13")
    scenario = replace(scenario, telemetry=replace(scenario.telemetry, source="area-power-flow"))
    for reject in (make_telemetry, check_scenario):
        with pytest.raises(InvalidInputError, match=r"areas\.area1: .* bus 3; give slack_bus and slack_vm_pu"):
            reject(scenario)
