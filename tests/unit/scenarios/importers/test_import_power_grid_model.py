"""power-grid-model input: power flow and estimate are its own; what the model cannot hold is rejected."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.importers import Imported, import_grid

pgm: Any = pytest.importorskip("power_grid_model")
utils: Any = pytest.importorskip("power_grid_model.utils")

Data = dict[str, Any]
NODES = [1, 2, 3, 4, 5, 6, 7, 8, 9]
NAN = float("nan")
BRANCH_FROM, BRANCH_TO, SOURCE, SHUNT, LOAD, GENERATOR, NODE = 0, 1, 2, 3, 4, 5, 9


def table(component: str, **columns: list[Any]) -> Any:
    made = pgm.initialize_array("input", component, len(next(iter(columns.values()))))
    for name, values in columns.items():
        made[name] = values
    return made


def small_grid() -> Data:
    """150 / 10 / 0.4 kV: tap changers on either side, clocks, dielectric losses, a half-open line, a link 4 to 9."""
    both = {"from_status": [1, 1], "to_status": [1, 1]}
    kv = [150e3, 10e3, 10e3, 10e3, 10e3, 400.0, 10e3, 10e3, 10e3]
    return {
        "node": table("node", id=NODES, u_rated=kv),
        "transformer": table(
            "transformer", id=[20, 21], from_node=[1, 5], to_node=[2, 6], **both, u1=[150e3, 10.5e3], u2=[10.5e3, 420],
            sn=[30e6, 0.63e6], uk=[0.2, 0.04], pk=[100e3, 6e3], i0=[0.002, 0.003], p0=[20e3, 900], winding_from=[2, 2],
            winding_to=[1, 1], clock=[11, 5], tap_side=[0, 1], tap_pos=[4, -1], tap_min=[-11, 2], tap_max=[9, -2],
            tap_nom=[0, 0], tap_size=[2.5e3, 10], uk_min=[0.21, NAN], uk_max=[0.19, NAN], pk_min=[110e3, NAN],
            pk_max=[90e3, NAN],
        ),
        "line": table(
            "line", id=[30, 31, 32, 33, 34], from_node=[2, 3, 9, 4, 3], to_node=[3, 4, 5, 8, 5],
            from_status=[1, 1, 1, 1, 0], to_status=[1, 1, 1, 0, 0], r1=[0.3, 0.2, 0.25, 0.3, 0.1],
            x1=[0.2, 0.15, 0.1, 0.1, 0.1], c1=[3e-6, 1e-6, 2e-6, 5e-6, 0], tan1=[0.1, 0, 0.05, 0.02, 0], i_n=[300] * 5,
        ),
        "link": table("link", id=[38, 39], from_node=[9, 4], to_node=[4, 7], from_status=[1, 1], to_status=[1, 0]),
        "generic_branch": table(
            "generic_branch", id=[40], from_node=[3], to_node=[7], from_status=[1], to_status=[1], r1=[0.1], x1=[0.3],
            g1=[1e-4], b1=[2e-4], k=[1.02], theta=[0.05],
        ),
        "source": table(
            "source", id=[50], node=[1], status=[1], u_ref=[1.02], u_ref_angle=[0.1], sk=[2e9], rx_ratio=[0.2]
        ),
        "sym_load": table(
            "sym_load", id=[60, 61, 62, 63, 64], node=[4, 6, 7, 9, 3], status=[1, 1, 1, 1, 0], type=[0] * 5,
            p_specified=[1e6, 2e5, 3e5, 2e5, 9e6], q_specified=[2e5, 5e4, 1e5, 1e5, 0],
        ),
        "sym_gen": table("sym_gen", id=[70], node=[6], status=[1], type=[0], p_specified=[1e5], q_specified=[1e4]),
        "shunt": table("shunt", id=[80], node=[3], status=[1], g1=[1e-4], b1=[2e-3]),
    }  # fmt: skip


def imported(tmp_path: Path, data: Data, frequency_hz: float = 50.0) -> Imported:
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, data)
    return import_grid(path, frequency_hz=frequency_hz)


def problems_of(tmp_path: Path, data: Data) -> str:
    with pytest.raises(InvalidInputError) as caught:
        imported(tmp_path, data)
    assert "grid.json" in caught.value.what
    return "\n".join(caught.value.problems)


def voltages_there(grid: Imported, output: Data) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Our rows, their vm and va, of the nodes that are buses here."""
    known = [k for k, node in enumerate(output["node"]["id"]) if int(node) in grid.network.row]
    rows = np.array([grid.network.row[int(output["node"]["id"][k])] for k in known])
    return rows, output["node"]["u_pu"][known], output["node"]["u_angle"][known]


def check_power_flow(grid: Imported, data: Data, frequency_hz: float = 50.0) -> None:
    result = solve_power_flow(grid.network, tolerance=1e-12)
    model = pgm.PowerGridModel(data, system_frequency=frequency_hz)
    rows, vm, va = voltages_there(grid, model.calculate_power_flow(error_tolerance=1e-13, max_iterations=50))
    np.testing.assert_allclose(result.vm[rows], vm, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.exp(1j * result.va[rows]), np.exp(1j * va), rtol=0, atol=1e-8)


@pytest.mark.parametrize("frequency_hz", [50.0, 60.0])
def test_the_power_flow_is_power_grid_models(tmp_path: Path, frequency_hz: float) -> None:
    data = without_link(small_grid())
    check_power_flow(imported(tmp_path, data, frequency_hz), data, frequency_hz)


def without_link(data: Data) -> Data:
    """Links are nearly, not exactly, of no impedance there: 1e-8 needs a grid without."""
    data["line"]["from_node"][data["line"]["id"] == 32] = 4
    data["sym_load"]["node"][data["sym_load"]["id"] == 63] = 4
    data["link"]["from_status"] = 0
    data["link"]["to_status"] = 0
    return data


def test_links_fuse_nodes_open_ends_become_shunts_and_all_is_reported(tmp_path: Path) -> None:
    data = small_grid()
    grid = imported(tmp_path, data)
    assert list(grid.network.row) == [1, 2, 3, 4, 5, 6, 7, 10]
    reported = {(remark.what, remark.text) for remark in grid.remarks}
    assert ("fused", "bus 9 into bus 4, joined by links") in reported
    assert ("changed", "branch 33: open at one end, written as the shunt that it is") in reported
    assert ("left out", "branch 34: open at both ends") in reported
    assert ("note", "bus 10 is new: the inside of the source at bus 1") in reported
    assert any(what == "left out" and text.startswith("bus 8 with 0 MW") for what, text in reported)
    result = solve_power_flow(grid.network)
    rows, vm, _ = voltages_there(grid, pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-8))
    np.testing.assert_allclose(result.vm[rows], vm, atol=1e-5)


def test_constant_impedance_becomes_a_shunt(tmp_path: Path) -> None:
    data = without_link(small_grid())
    data["sym_load"]["type"][:3] = 1
    data["sym_gen"]["type"] = 1
    check_power_flow(imported(tmp_path, data), data)


def test_a_stiff_source_is_the_slack_itself(tmp_path: Path) -> None:
    data = without_link(small_grid())
    data["source"]["sk"] = 1e20
    grid = imported(tmp_path, data)
    assert grid.network.slack is not None
    assert grid.network.slack.bus == 1
    check_power_flow(grid, data)


def measured_grid(*, stiff: bool = False) -> Data:
    """``small_grid`` without link, with sensors of every kind that can be a meter, with noise."""
    data = without_link(small_grid())
    if stiff:
        data["source"]["sk"] = 1e20
    output = pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-12)
    rng = np.random.default_rng(1)
    at = [2, 4, 4, 6, 1, 3, 5, 7]
    u = output["node"]["u"][[NODES.index(node) for node in at]]
    sigma = np.array([50, 20, 30, 2.0, 900, 40, 40, 40])
    data["sym_voltage_sensor"] = table(
        "sym_voltage_sensor", id=list(range(101, 109)), measured_object=at, u_sigma=sigma,
        u_measured=u + sigma * rng.standard_normal(8),
    )  # fmt: skip
    places = [
        (20, BRANCH_FROM),
        (21, BRANCH_TO),
        (30, BRANCH_FROM),
        (31, BRANCH_TO),
        (32, BRANCH_FROM),
        (40, BRANCH_TO),
    ]
    places += [(60, LOAD), (61, LOAD), (62, LOAD), (63, LOAD), (70, GENERATOR), (50, SOURCE), (30, BRANCH_FROM)]
    places += [(6, NODE)]
    powers = np.array([power_at(output, *place) for place in places])
    noisy = powers + 2e4 * rng.standard_normal(powers.shape)
    p_sigma = np.where(np.arange(len(places)) % 3 == 1, 3e4, NAN)
    data["sym_power_sensor"] = table(
        "sym_power_sensor", id=list(range(200, 200 + len(places))), measured_object=[place for place, _ in places],
        measured_terminal_type=[terminal for _, terminal in places], p_measured=noisy[:, 0], q_measured=noisy[:, 1],
        power_sigma=[2e4] * len(places), p_sigma=p_sigma, q_sigma=2 * p_sigma,
    )  # fmt: skip
    return data


def power_at(output: Data, component: int, terminal: int) -> tuple[float, float]:
    """(p, q) in W and var where a sensor of that terminal type looks."""
    suffix = {BRANCH_FROM: "_from", BRANCH_TO: "_to"}.get(terminal, "")
    for rows in output.values():
        if f"p{suffix}" in rows.dtype.names and component in rows["id"]:
            row = rows[rows["id"] == component][0]
            return float(row[f"p{suffix}"]), float(row[f"q{suffix}"])
    raise AssertionError(component)


@pytest.mark.parametrize("stiff", [False, True])
def test_the_estimate_from_the_sensors_is_that_of_newton_raphson(tmp_path: Path, stiff: bool) -> None:
    data = measured_grid(stiff=stiff)
    if stiff:  # the source is an injection at node 1 then
        data["source"]["u_ref_angle"] = 0.0
    grid = imported(tmp_path, data)
    assert isinstance(grid.zero_injection, tuple)
    kinds = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    virtual = [
        Measurement(Meter(k, bus, source=Source.VIRTUAL), 0.0, 0.0) for bus in grid.zero_injection for k in kinds
    ]
    result = estimate_state(grid.network, [*grid.readings, *virtual], tolerance=1e-12)
    theirs = pgm.PowerGridModel(data).calculate_state_estimation(
        error_tolerance=1e-13, max_iterations=100, calculation_method=pgm.CalculationMethod.newton_raphson
    )
    rows, vm, va = voltages_there(grid, theirs)
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


def test_a_line_beside_a_closed_link_is_left_out_and_reported(tmp_path: Path) -> None:
    data = small_grid()
    extra = data["line"][:1].copy()
    extra["id"], extra["from_node"], extra["to_node"], extra["c1"] = 35, 4, 9, 4e-5
    data["line"] = np.concatenate([data["line"], extra])
    grid = imported(tmp_path, data)
    assert any(r.what == "left out" and r.text.startswith("branch 35: links join its two ends") for r in grid.remarks)
    result = solve_power_flow(grid.network)
    rows, vm, _ = voltages_there(grid, pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-8))
    np.testing.assert_allclose(result.vm[rows], vm, atol=1e-5)  # of which its charging makes 1e-4


@pytest.mark.parametrize(
    ("field", "value"), [("uk", 1.2), ("uk", 0.0005), ("i0", 1.5), ("i0", 1e-5), ("pk", 8e6), ("p0", 1e6)]
)
def test_a_transformer_that_power_grid_model_computes_with_is_not_rejected(
    tmp_path: Path, field: str, value: float
) -> None:
    data = without_link(small_grid())
    data["transformer"][field][0] = value
    data["transformer"][["uk_min", "uk_max"]][0] = NAN
    for name in ("uk_min", "uk_max", "pk_min", "pk_max"):
        data["transformer"][name][0] = NAN
    grid = imported(tmp_path, data)
    check_power_flow(grid, data)
    noted = [remark.text for remark in grid.remarks if remark.what == "note"]
    assert any(text.startswith("power-grid-model computes with it, but: ") and "20" in text for text in noted)


def test_the_type_of_a_load_is_not_asked_where_sensors_are(tmp_path: Path) -> None:
    data = measured_grid()
    expected = imported(tmp_path, data).readings
    data["sym_load"]["type"][0] = 4
    grid = imported(tmp_path, data)
    assert grid.readings == expected
    assert any("'type'" in remark.text and "60" in remark.text for remark in grid.remarks)
    del data["sym_power_sensor"], data["sym_voltage_sensor"]
    assert "60" in problems_of(tmp_path, data)


def test_sources_of_separate_islands_are_reported_how_to_be_split(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["from_status"][:2] = 0
    data["line"]["to_status"][:2] = 0
    data["generic_branch"]["from_status"] = 0
    data["source"] = table("source", id=[50, 51], node=[1, 6], status=[1, 1], u_ref=[1.0, 1.0])
    text = problems_of(tmp_path, data)
    assert "2 islands have a substation each; import them one by one: take the sources of the other islands" in text
    assert "the island of source 50 at bus 1: bus 1, 2" in text
    assert "the island of source 51 at bus 6: bus 4, 5, 6, 9" in text


def test_everything_that_the_model_cannot_hold_is_named(tmp_path: Path) -> None:
    data = small_grid()
    data["source"] = table("source", id=[50, 51], node=[1, 6], status=[1, 1], u_ref=[1.0, 1.0])
    data["sym_load"]["type"][0] = 2
    text = problems_of(tmp_path, data)
    assert "source 50 at bus 1, source 51 at bus 6 feed one island" in text
    assert "sym_load 60: constant current" in text


def test_components_that_are_not_balanced_are_rejected(tmp_path: Path) -> None:
    data = small_grid()
    data["asym_load"] = table(
        "asym_load", id=[90], node=[4], status=[1], type=[0], p_specified=[[1e3] * 3], q_specified=[[1e3] * 3]
    )
    assert "asym_load 90: the network model cannot hold it" in problems_of(tmp_path, data)


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


def test_data_that_power_grid_model_finds_wrong_is_rejected_with_its_words(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["from_node"][0] = 77
    assert "power-grid-model: " in problems_of(tmp_path, data)


def test_a_missing_package_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, small_grid())
    monkeypatch.setitem(sys.modules, "power_grid_model.utils", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'consensus-dsse\[power-grid-model\]'"):
        import_grid(path)


def test_branches_without_impedance_are_rejected_by_their_names(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["r1"][1], data["line"]["x1"][1] = 1e-9, 0.0
    data["source"]["sk"] = 5e14
    text = problems_of(tmp_path, data)
    assert "branch 3-4 (line 31) has |r + jx| = 1e-11 p.u., the median branch " in text
    assert "branch 10-1 (source 50) has |r + jx| = 2e-09 p.u." in text
    assert "put a link in its place" in text


def changed_file(tmp_path: Path, change: Callable[[Data], object]) -> Path:
    """The file of ``small_grid``, its JSON changed."""
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, small_grid())
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))
    return path


def test_no_attribute_is_dropped_in_silence(tmp_path: Path) -> None:
    def change(tree: Data) -> None:
        tree["data"]["source"][0]["Sk"] = tree["data"]["source"][0].pop("sk")
        for load in tree["data"]["sym_load"][:2]:
            load["foo"] = {"bar": [1]}

    with pytest.raises(InvalidInputError) as caught:
        import_grid(changed_file(tmp_path, change))
    assert sorted(caught.value.problems) == [
        "source 50: unknown attribute 'Sk', which power-grid-model would leave out; did you mean 'sk'?; correct or "
        "remove it, or put it under 'extra' if it describes",
        "sym_load 60, 61: unknown attribute 'foo', which power-grid-model would leave out; correct or remove it, or "
        "put it under 'extra' if it describes",
    ]


def test_an_unknown_attribute_of_compact_data_is_named_as_well(tmp_path: Path) -> None:
    path = changed_file(tmp_path, lambda tree: tree["attributes"].update(shunt=["id", "node", "status", "g1", "B1"]))
    with pytest.raises(InvalidInputError, match=r"shunt: unknown attribute 'B1'.*did you mean 'b1'"):
        import_grid(path)


def test_descriptions_are_left_out_and_reported(tmp_path: Path) -> None:
    def change(tree: Data) -> None:
        tree["data"]["node"][2]["extra"] = {"name": "Harbour"}
        tree["frequency"] = 60

    reported = {(remark.what, remark.text) for remark in import_grid(changed_file(tmp_path, change)).remarks}
    assert ("left out", "'extra' of node, which describes them") in reported
    assert ("left out", "beside the data: frequency, which power-grid-model does not know") in reported


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree["data"].update(source={"id": 2}),
        lambda tree: tree["data"]["source"][0].update(sk="a\nb"),
        lambda tree: tree["data"].update(foo=[{"id": 3}]),
        lambda tree: tree.update(data=[], attributes=7),
        lambda tree: tree["data"].update(source=[7, None, []]),
    ],
)
def test_another_librarys_words_stand_on_one_line(tmp_path: Path, change: Callable[[Data], object]) -> None:
    with pytest.raises(InvalidInputError, match="power-grid-model cannot read it: ") as caught:
        import_grid(changed_file(tmp_path, change))
    assert "\\n" not in str(caught.value)
