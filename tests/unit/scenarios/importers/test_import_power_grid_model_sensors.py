"""Sensors of power-grid-model: the estimate is its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from scenarios.importers import Imported
from tests.support.power_grid_model_grids import (
    BRANCH_FROM,
    BRANCH_TO,
    NAN,
    NODE,
    NODES,
    SHUNT,
    Data,
    imported,
    measured_grid,
    pgm,
    power_at,
    problems_of,
    table,
    voltages_there,
)


@pytest.mark.parametrize("stiff", [False, True])
def test_the_estimate_from_the_sensors_is_that_of_newton_raphson(tmp_path: Path, stiff: bool) -> None:
    data = measured_grid(stiff=stiff)
    if stiff:  # the source is an injection at node 1 then
        data["source"]["u_ref_angle"] = 0.0
    check_estimate(imported(tmp_path, data), data)


@pytest.mark.parametrize("terminal", [BRANCH_FROM, BRANCH_TO])
def test_a_line_open_at_one_end_keeps_the_sensor_at_the_other(tmp_path: Path, terminal: int) -> None:
    """power-grid-model leaves it out. It moves no estimate here: it reads what the others make of it."""
    data = measured_grid()
    line = data["line"]["id"] == 33  # from node 4, where it is closed, to node 8
    if terminal == BRANCH_TO:
        data["line"]["from_node"][line], data["line"]["to_node"][line] = 8, 4
        data["line"]["from_status"][line], data["line"]["to_status"][line] = 0, 1
    extra = data["sym_power_sensor"][:1].copy()
    extra["id"], extra["measured_object"], extra["measured_terminal_type"] = 300, 33, terminal
    extra["p_measured"], extra["q_measured"] = power_at(estimate_there(data), 33, terminal)
    data["sym_power_sensor"] = np.concatenate([data["sym_power_sensor"], extra])
    grid = imported(tmp_path, data)
    (new,) = set(grid.network.row) - set(imported(tmp_path, measured_grid()).network.row)
    assert isinstance(grid.zero_injection, tuple)
    assert new in grid.zero_injection
    assert {m.meter.bus for m in grid.readings if m.meter.branch and str(new) in m.meter.branch} == {4}
    text = f"branch 33: open at one end and metered, kept as a branch to bus {new}, where nothing is injected"
    assert text in {remark.text for remark in grid.remarks}
    check_estimate(grid, data)


def estimate_there(data: Data) -> Data:
    found: Data = pgm.PowerGridModel(data).calculate_state_estimation(
        error_tolerance=1e-13, max_iterations=100, calculation_method=pgm.CalculationMethod.newton_raphson
    )
    return found


def check_estimate(grid: Imported, data: Data) -> None:
    assert isinstance(grid.zero_injection, tuple)
    kinds = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    virtual = [
        Measurement(Meter(k, bus, source=Source.VIRTUAL), 0.0, 0.0) for bus in grid.zero_injection for k in kinds
    ]
    result = estimate_state(grid.network, [*grid.readings, *virtual], tolerance=1e-12)
    rows, vm, va = voltages_there(grid, estimate_there(data))
    np.testing.assert_allclose(result.vm[rows], vm, rtol=0, atol=1e-6)
    turned = np.exp(1j * (result.va[rows] - result.va[rows[0]] - va + va[0]))
    np.testing.assert_allclose(turned, 1, rtol=0, atol=1e-6)


def test_powers_of_appliances_count_only_where_all_are_measured(tmp_path: Path) -> None:
    data = measured_grid()
    data["sym_power_sensor"] = data["sym_power_sensor"][data["sym_power_sensor"]["measured_object"] != 63]
    grid = imported(tmp_path, data)
    assert not any(m.meter.bus == 4 and m.meter.kind.of_injection for m in grid.readings)
    assert any("60 at bus 4" in remark.text and "63 stands there, too" in remark.text for remark in grid.remarks)


def test_a_node_where_nothing_stands_injects_exactly_nothing_whatever_its_sensor_says(tmp_path: Path) -> None:
    data = measured_grid()
    extra = data["sym_power_sensor"][:1].copy()
    extra["id"], extra["measured_object"], extra["measured_terminal_type"] = 300, 2, NODE
    data["sym_power_sensor"] = np.concatenate([data["sym_power_sensor"], extra])
    grid = imported(tmp_path, data)
    assert isinstance(grid.zero_injection, tuple)
    assert 2 in grid.zero_injection
    assert not any(m.meter.bus == 2 and m.meter.kind.of_injection for m in grid.readings)
    assert any("power sensor 300 of node 2: nothing stands there" in remark.text for remark in grid.remarks)


def test_one_angle_only_turns_the_grid_and_is_reported(tmp_path: Path) -> None:
    data = measured_grid()
    data["sym_voltage_sensor"]["u_angle_measured"] = [0.3] + [NAN] * 7
    assert any("the angle of voltage sensor 101" in remark.text for remark in imported(tmp_path, data).remarks)


def test_a_current_sensor_is_a_meter_of_magnitude(tmp_path: Path) -> None:
    data = measured_grid()
    data["sym_voltage_sensor"]["u_angle_measured"][0] = 0.3
    data["sym_current_sensor"] = table(
        "sym_current_sensor", id=[301], measured_object=[21], measured_terminal_type=[BRANCH_FROM],
        angle_measurement_type=[1], i_sigma=[2.0], i_angle_sigma=[0.1], i_measured=[20.0], i_angle_measured=[0.1],
    )  # fmt: skip
    data["sym_power_sensor"] = data["sym_power_sensor"][data["sym_power_sensor"]["measured_object"] != 21]
    grid = imported(tmp_path, data)
    (current,) = (m for m in grid.readings if m.meter.kind is MeasurementKind.CURRENT)
    assert (current.meter.bus, current.meter.branch) == (5, "5-6")
    assert (current.value, current.sigma) == pytest.approx((20 * 3**0.5 * 10e3 / 1e6, 2 * 3**0.5 * 10e3 / 1e6))
    assert any("the angle of current sensor 301" in remark.text for remark in grid.remarks)


def test_a_current_sensor_with_a_local_angle_is_not_reduced_to_its_magnitude(tmp_path: Path) -> None:
    data = measured_grid()
    output = pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-12)
    p, q = power_at(output, 30, BRANCH_FROM)
    line = output["line"][output["line"]["id"] == 30][0]
    data["sym_power_sensor"] = data["sym_power_sensor"][data["sym_power_sensor"]["measured_object"] != 30]
    data["sym_voltage_sensor"]["u_measured"] = output["node"]["u"][
        [NODES.index(node) for node in data["sym_voltage_sensor"]["measured_object"]]
    ]
    columns = {
        "measured_object": [30], "measured_terminal_type": [BRANCH_FROM], "angle_measurement_type": [0],
        "i_measured": [line["i_from"]], "i_angle_measured": [np.arctan2(q, p)],
    }  # fmt: skip
    data["sym_current_sensor"] = table("sym_current_sensor", id=[301], i_sigma=[2.0], i_angle_sigma=[0.01], **columns)
    grid = imported(tmp_path, data)
    flows = {m.meter.kind: m for m in grid.readings if m.meter.branch == "2-3"}
    assert set(flows) == {MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW}
    assert flows[MeasurementKind.P_FLOW].value == pytest.approx(p / 1e6, rel=1e-9)
    assert flows[MeasurementKind.Q_FLOW].value == pytest.approx(q / 1e6, rel=1e-9)
    u, i, phi = float(output["node"]["u"][1]), float(line["i_from"]), np.arctan2(q, p)
    rng = np.random.default_rng(1)  # what the sensors would say, many times
    s = (u + 50 * rng.standard_normal(10**6)) * (i + 2 * rng.standard_normal(10**6)) * 3**0.5 / 1e6
    phis = phi + 0.01 * rng.standard_normal(10**6)
    assert flows[MeasurementKind.P_FLOW].sigma == pytest.approx(np.std(s * np.cos(phis)), rel=0.01)
    assert flows[MeasurementKind.Q_FLOW].sigma == pytest.approx(np.std(s * np.sin(phis)), rel=0.01)
    assert not any("the angle of current sensor" in remark.text for remark in grid.remarks)


def test_a_local_angle_without_a_voltage_beside_it_is_reported(tmp_path: Path) -> None:
    data = measured_grid()
    data["sym_current_sensor"] = table(
        "sym_current_sensor", id=[301], measured_object=[32], measured_terminal_type=[BRANCH_TO],
        angle_measurement_type=[0], i_sigma=[2.0], i_angle_sigma=[0.1], i_measured=[20.0], i_angle_measured=[0.1],
    )  # fmt: skip
    data["sym_power_sensor"] = data["sym_power_sensor"][data["sym_power_sensor"]["measured_object"] != 32]
    data["sym_voltage_sensor"] = data["sym_voltage_sensor"][data["sym_voltage_sensor"]["measured_object"] != 5]
    grid = imported(tmp_path, data)
    (current,) = (m for m in grid.readings if m.meter.kind is MeasurementKind.CURRENT)
    assert (current.meter.bus, current.meter.branch) == (5, "4-5")
    assert (current.value, current.sigma) == pytest.approx((20 * 3**0.5 * 10e3 / 1e6, 2 * 3**0.5 * 10e3 / 1e6))
    assert any("301" in remark.text and "no voltage sensor at bus 5" in remark.text for remark in grid.remarks)


@pytest.mark.parametrize("sigma", [1e200, np.inf])
def test_a_sensor_without_weight_does_not_divide_by_zero(tmp_path: Path, sigma: float) -> None:
    data = measured_grid()
    data["sym_power_sensor"]["power_sigma"][[0, 12]] = sigma
    data["sym_voltage_sensor"]["u_sigma"][1:3] = sigma  # both of node 4
    grid = imported(tmp_path, data)
    meters = {m.meter.id for m in grid.readings}
    assert "vm@4" not in meters
    assert "p_flow@1:1-2" not in meters
    assert any(r.what == "left out" and r.text.startswith("sensor 102, 103, 200, 212: with a") for r in grid.remarks)
    assert all(m.sigma < 1e6 for m in grid.readings)


def test_the_type_of_a_load_is_not_asked_where_sensors_are(tmp_path: Path) -> None:
    data = measured_grid()
    expected = imported(tmp_path, data).readings
    data["sym_load"]["type"][0] = 4
    grid = imported(tmp_path, data)
    assert grid.readings == expected
    assert any("'type'" in remark.text and "60" in remark.text for remark in grid.remarks)
    del data["sym_power_sensor"], data["sym_voltage_sensor"]
    assert "60" in problems_of(tmp_path, data)


def test_every_sensor_that_no_meter_can_be_is_named(tmp_path: Path) -> None:
    data = measured_grid()
    data["sym_voltage_sensor"]["u_angle_measured"] = [0.3, 0.2] + [NAN] * 6
    extra = data["sym_power_sensor"][:2].copy()
    extra["id"], extra["measured_object"], extra["measured_terminal_type"] = [300, 301], [80, 3], [SHUNT, NODE]
    data["sym_power_sensor"] = np.concatenate([data["sym_power_sensor"], extra])
    text = problems_of(tmp_path, data)
    for words in (
        "sym_voltage_sensor 101, 102: their angles",
        "sym_power_sensor 300: the power of shunt 80",
        "sym_power_sensor 301: the power of node 3 includes a shunt",
    ):
        assert words in text
