"""pandapower networks: power flow and estimate are pandapower's own; what the model cannot hold is rejected by name."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.messages.keys import default_run_id
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.state import find_state, read_state
from scenarios.importers import Imported, import_grid
from scenarios.importers.imported_files import write_imported
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.pandapower_tables import ONE_WORKER, LoadedLate, made_once

pp: Any = LoadedLate("pandapower")
networks: Any = LoadedLate("pandapower.networks")
estimation: Any = LoadedLate("pandapower.estimation")

pytestmark = [
    ONE_WORKER,
    pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas"),
    pytest.mark.slow,
]

BUNDLED: dict[str, Callable[[], Any]] = {
    "case33bw, radial": lambda: networks.case33bw(),
    "case4gs, meshed": lambda: networks.case4gs(),
    "case9, generators": lambda: networks.case9(),
    "case118, taps and shunts": lambda: networks.case118(),
    "CIGRE MV with DER": lambda: networks.create_cigre_network_mv(with_der="pv_wind"),
    "CIGRE LV, closed switches": lambda: networks.create_cigre_network_lv(),
    "MV Oberrhein": lambda: networks.mv_oberrhein(separation_by_sub=True)[1],
    "Kerber": lambda: networks.create_kerber_landnetz_freileitung_1(),
    "open ring": lambda: networks.simple_mv_open_ring_net(),
    "Great Britain, taps that do not cancel around loops": lambda: networks.GBnetwork(),
}


def imported(tmp_path: Path, net: Any) -> Imported:
    path = tmp_path / "net.json"
    pp.to_json(net, str(path))
    return import_grid(path)


def problems_of(tmp_path: Path, net: Any) -> str:
    with pytest.raises(InvalidInputError) as caught:
        imported(tmp_path, net)
    assert "net.json" in caught.value.what
    return "\n".join(caught.value.problems)


@made_once
def small_grid() -> Any:
    """110 / 20 kV, Dyn5 with tap changer, a ring, a closed bus switch (14 to 15), an open line end, a dark island."""
    net = pp.create_empty_network(sn_mva=10)
    for bus in (5, 10, 11, 12, 13, 14, 15, 16, 30, 31):
        pp.create_bus(net, 110 if bus == 5 else 20, index=bus, name=f"B{bus}")
    pp.create_ext_grid(net, 5, vm_pu=1.02, va_degree=7)
    pp.create_transformer(net, 5, 10, "25 MVA 110/20 kV", tap_pos=-3)
    for ends in ((10, 11), (11, 12), (12, 13), (13, 10), (12, 14), (15, 16), (16, 11), (30, 31)):
        pp.create_line(net, *ends, 2.5, "NA2XS2Y 1x185 RM/25 12/20 kV", parallel=2 if ends == (10, 11) else 1)
    pp.create_switch(net, 14, 15, et="b")
    pp.create_switch(net, 16, 6, et="l", closed=False)
    pp.create_line(net, 13, 15, 1, "NAYY 4x50 SE", in_service=False)
    for bus, p, q in ((11, 1, 0.3), (13, 2, 0.5), (14, 0.5, 0.1), (15, 0.7, 0.2), (16, 0.4, 0.1), (31, 5, 1)):
        pp.create_load(net, bus, p, q, scaling=0.9)
    pp.create_sgen(net, 16, 1.2, -0.1, scaling=0.8)
    pp.create_shunt(net, 12, -0.4, 0.02, step=2)
    pp.create_ward(net, 13, 0.1, 0.05, 0.2, 0.1)
    return net


FEW = ("case9, generators", "case118, taps and shunts", "CIGRE LV, closed switches", "open ring")


@pytest.mark.parametrize("name", [*FEW, *further(*(name for name in BUNDLED if name not in FEW))])
def test_the_power_flow_of_bundled_networks_is_pandapowers(tmp_path: Path, name: str) -> None:
    net = BUNDLED[name]()
    check_power_flow(imported(tmp_path, net), net)


@pytest.mark.parametrize(("given", "name"), [("Town of\nLakes", "Town of Lakes"), ("", "net"), (None, "net")])
def test_an_imported_scenario_has_the_name_of_its_network_else_that_of_its_file(
    tmp_path: Path, given: str | None, name: str
) -> None:
    net = small_grid()
    net.name = given
    path, _ = write_imported(tmp_path / "town", imported(tmp_path, net), 1)
    scenario = load_scenario(path)
    assert (scenario.name, scenario.network.name) == (name, name)
    assert default_run_id(scenario.name) == name.lower().replace(" ", "-")


def check_power_flow(grid: Imported, net: Any) -> None:
    """Compare all buses at 1e-8 p.u. and rad with runpp."""
    result = solve_power_flow(grid.network, tolerance=1e-11)
    pp.runpp(net, calculate_voltage_angles=True, tolerance_mva=1e-9, numba=False)
    buses = list(grid.network.row)
    theirs = net.res_bus.loc[buses]
    np.testing.assert_allclose(result.vm, theirs.vm_pu, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.exp(1j * result.va), np.exp(1j * np.radians(theirs.va_degree)), rtol=0, atol=1e-8)


def test_switches_islands_open_ends_and_taps_are_as_in_pandapower_and_reported(tmp_path: Path) -> None:
    net = small_grid()
    net.bus.loc[14, "geo"] = '{"type": "Point", "coordinates": [8.5, 47, 410]}'
    net.bus.loc[13, "geo"] = '{"type": "Point", "coordinates": ["east", 47]}'
    idle = pp.create_load(net, 14, 1.0, in_service=False)
    grid = imported(tmp_path, net)
    check_power_flow(grid, net)
    assert [(bus.x, bus.y) for bus in map(grid.network.bus, (12, 13, 14))] == [(None, None), (None, None), (8.5, 47.0)]
    assert list(grid.network.row) == [5, 10, 11, 12, 13, 14, 16]
    assert grid.network.bus(16).name == "B16"
    reported = {(remark.what, remark.text) for remark in grid.remarks}
    assert ("fused", "bus 15 into bus 14, joined by closed switches") in reported
    assert ("changed", "line 6: open at one end, written as the shunt that it is") in reported
    assert ("left out", "bus 30, 31 with 4.5 MW of load: out of service or unsupplied") in reported
    assert ("left out", "line 7, 8: out of service, open at both ends or unsupplied") in reported
    assert any(what == "left out" and text.startswith("load") and f"{idle}: out" in text for what, text in reported)


def test_loads_of_constant_impedance_become_shunts(tmp_path: Path) -> None:
    net = small_grid()
    net.load.loc[0, ["const_z_p_percent", "const_z_q_percent"]] = 40.0
    grid = imported(tmp_path, net)
    check_power_flow(grid, net)
    assert grid.network.bus(11).p_load == pytest.approx(0.6 * 0.9 / 10)


def test_static_generators_are_not_cut_to_their_limits(tmp_path: Path) -> None:
    net = small_grid()
    net.sgen["min_q_mvar"], net.sgen["max_q_mvar"] = -0.01, 0.01
    grid = imported(tmp_path, net)
    check_power_flow(grid, net)


def test_everything_that_the_model_cannot_hold_is_named_at_once(tmp_path: Path) -> None:
    net = small_grid()
    pp.create_xward(net, 12, 0, 0, 0, 0, 0.1, 0.1, 1.0, name="x")
    pp.create_dcline(net, 11, 13, 1, 1, 0, 1, 1)
    pp.create_ext_grid(net, 13)
    net.load.loc[0, "const_i_p_percent"] = 10.0
    text = problems_of(tmp_path, net)
    for words in ("xward 0", "dcline 0", "ext_grid 1 at bus 13", "load 0: const_i_p_percent"):
        assert words in text


def test_an_impedance_that_differs_by_direction_is_rejected(tmp_path: Path) -> None:
    net = small_grid()
    pp.create_impedance(net, 11, 13, 0.01, 0.02, 10, rtf_pu=0.03)
    assert "impedance 0: its two ends differ" in problems_of(tmp_path, net)


@made_once
def measured_grid() -> Any:
    """``small_grid`` with every kind of measurement, both ends of lines and transformer, some twice, with noise."""
    net = small_grid()
    pp.runpp(net, calculate_voltage_angles=True, numba=False)
    rng = np.random.default_rng(3)

    def measure(
        kind: str, element_type: str, value: float, sigma: float, element: int, side: str | None = None
    ) -> None:
        noisy = value + sigma * rng.standard_normal()
        pp.create_measurement(net, kind, element_type, noisy, sigma, element, side=side, check_existing=False)

    for bus in (5, 11, 13, 13, 15):
        measure("v", "bus", net.res_bus.vm_pu[bus], 0.003, bus)
    measure("va", "bus", net.res_bus.va_degree[13], 0.05, 13)
    consumed = net.res_bus[["p_mw", "q_mvar"]].copy()  # of what is connected, shunts included; a meter sees none
    consumed.loc[12] -= net.res_shunt.loc[0, ["p_mw", "q_mvar"]]
    consumed.loc[13] -= [
        net.ward.pz_mw[0] * net.res_bus.vm_pu[13] ** 2,
        net.ward.qz_mvar[0] * net.res_bus.vm_pu[13] ** 2,
    ]
    for bus in (5, 10, 11, 12, 13, 14, 15, 16, 11):
        measure("p", "bus", consumed.p_mw[bus], 0.05, bus)
        measure("q", "bus", consumed.q_mvar[bus], 0.05, bus)
    for line, side in ((0, "from"), (1, "to"), (2, "from"), (3, "to"), (4, "from"), (5, "from")):
        measure("p", "line", net.res_line[f"p_{side}_mw"][line], 0.02, line, side)
        measure("q", "line", net.res_line[f"q_{side}_mvar"][line], 0.02, line, side)
    measure("i", "line", net.res_line.i_from_ka[0], 0.002, 0, "from")
    for side in ("hv", "lv"):
        measure("p", "trafo", net.res_trafo[f"p_{side}_mw"][0], 0.02, 0, side)
        measure("q", "trafo", net.res_trafo[f"q_{side}_mvar"][0], 0.02, 0, side)
    measure("i", "trafo", net.res_trafo.i_lv_ka[0], 0.002, 0, "lv")
    measure("v", "bus", 1.0, 0.003, 31)
    return net


def test_the_estimate_from_the_measurement_table_is_pandapowers(tmp_path: Path) -> None:
    net = measured_grid()
    grid = imported(tmp_path, net)
    result = estimate_state(grid.network, grid.readings, tolerance=1e-10)
    assert estimation.estimate(net, init="results", tolerance=1e-9, maximum_iterations=50)
    theirs = net.res_bus_est.loc[list(grid.network.row)]
    np.testing.assert_allclose(result.vm, theirs.vm_pu, rtol=0, atol=1e-6)
    np.testing.assert_allclose(result.va, np.radians(theirs.va_degree), rtol=0, atol=1e-6)
    assert grid.zero_injection == "measured"
    reported = {remark.text for remark in grid.remarks}
    assert "2 readings of vm@13: their weighted mean" in reported
    assert any("unsupplied" in text and text.startswith("measurement ") for text in reported)


@pytest.mark.parametrize("side", ["from", "to"])
def test_a_line_open_at_one_end_keeps_its_meters_which_perfect_readings_satisfy(tmp_path: Path, side: str) -> None:
    net = small_grid()
    net.line.loc[6, "c_nf_per_km"] *= 100
    pp.runpp(net, calculate_voltage_angles=True, numba=False, tolerance_mva=1e-9)
    measured = measured_grid()
    measured.line.loc[6, "c_nf_per_km"] *= 100
    for kind, column in (("p", "p_{}_mw"), ("q", "q_{}_mvar")):
        pp.create_measurement(measured, kind, "line", net.res_line[column.format(side)][6], 1e-6, 6, side=side)
    grid = imported(tmp_path, measured)
    (end,) = grid.zero_injection
    text = f"line 6: open at one end and metered, kept as a branch to bus {end}, where nothing is injected"
    assert ("changed", text) in {(remark.what, remark.text) for remark in grid.remarks}
    (branch,) = grid.network.branches_at[end]
    readings = [m for m in grid.readings if m.meter.branch == branch.id]
    assert {m.meter.bus for m in readings} == {end if side == "from" else 11}
    true = solve_power_flow(grid.network, tolerance=1e-11)
    read = read_state(find_state(grid.network, true.vm, true.va), [m.meter for m in readings])
    np.testing.assert_allclose([m.value for m in readings], read, rtol=0, atol=1e-8)
    path, _ = write_imported(tmp_path / "town", grid, 1)
    assert Meter(MeasurementKind.P_INJECTION, end, source=Source.VIRTUAL) in load_scenario(path).meters


def test_a_half_measured_bus_of_closed_switches_is_rejected(tmp_path: Path) -> None:
    net = measured_grid()
    net.measurement = net.measurement[~((net.measurement.element == 14) & (net.measurement.measurement_type == "p"))]
    text = problems_of(tmp_path, net)
    assert "p_injection@14: closed switches join bus 14, 15, but bus 14, where something feeds or consumes" in text


def test_every_measurement_that_no_meter_can_be_is_named(tmp_path: Path) -> None:
    net = measured_grid()
    pp.create_measurement(net, "ia", "line", 0.0, 0.1, 0, side="to")
    net.measurement.loc[0, "std_dev"] = 0.0
    text = problems_of(tmp_path, net)
    assert "measurement 0: value" in text
    assert "'ia' of a line is no kind of meter" in text


def test_a_missing_package_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "net.json"
    pp.to_json(small_grid(), str(path))
    monkeypatch.setitem(sys.modules, "pandapower", None)
    with pytest.raises(InvalidInputError, match=r"pip install .*\[pandapower\]'"):
        import_grid(path)


def test_a_line_without_impedance_is_rejected_by_its_name(tmp_path: Path) -> None:
    net = small_grid()
    net.line.loc[[2, 4], "length_km"] = 1e-8
    text = problems_of(tmp_path, net)
    assert "branch 12-13 (line 2) has |r + jx| = " in text
    assert "branch 12-14 (line 4) has |r + jx| = " in text
    assert "put a closed switch between its two buses in its place" in text


def test_broken_data_are_named_by_table_index_and_column_all_at_once(tmp_path: Path) -> None:
    net = small_grid()
    net.load = net.load.astype({"bus": int})
    net.load.loc[[0, 2], "bus"] = [99, 98]
    net.line.loc[3, "to_bus"] = 77
    net.line.loc[1, "length_km"] = 0.0
    net.line.loc[2, "r_ohm_per_km"] = np.nan
    net.trafo.loc[0, ["sn_mva", "vk_percent"]] = 0.0
    net.switch.loc[0, "element"] = 44
    net.switch.loc[1, "et"] = "x"
    net.sgen = net.sgen.drop(columns=["scaling", "q_mvar"])
    net.sn_mva = 0.0
    text = problems_of(tmp_path, net)
    for words in (
        "sn_mva is 0.0; a positive number is expected",
        "load 0, 2: bus is 99, 98; the index of a bus is expected",
        "line 3: to_bus is 77; the index of a bus is expected",
        "line 1: length_km is 0.0; a positive number is expected",
        "line 2: r_ohm_per_km is nan; a number is expected",
        "trafo 0: sn_mva is 0.0; a positive number is expected",
        "trafo 0: vk_percent is 0.0; a positive number is expected",
        "switch 0: element is 44; the index of a bus (et is 'b') is expected",
        "switch 1: et is x; one of b, l, t is expected",
        "table sgen has 1 elements but no column q_mvar, scaling",
    ):
        assert words in text


def test_a_transformer_out_of_service_is_divided_by_too(tmp_path: Path) -> None:
    net = small_grid()
    pp.create_transformer(net, 5, 10, "25 MVA 110/20 kV", in_service=False)
    net.trafo.loc[1, "vk_percent"] = 0.0
    assert "trafo 1: vk_percent is 0.0; a positive number is expected" in problems_of(tmp_path, net)


def test_short_circuit_losses_above_the_short_circuit_voltage_are_named(tmp_path: Path) -> None:
    net = small_grid()
    net.trafo.loc[0, "vkr_percent"] = 50.0
    assert "trafo 0: vkr_percent is 50.0; a number that is at most vk_percent is expected" in problems_of(tmp_path, net)


def test_a_branch_out_of_service_may_lack_numbers_a_load_may_not_since_pandapower_multiplies_it_by_0(
    tmp_path: Path,
) -> None:
    net = small_grid()
    net.line.loc[8, "length_km"] = np.nan
    check_power_flow(imported(tmp_path, net), net)
    net.load.loc[0, "in_service"] = False
    net.load.loc[0, "p_mw"] = np.nan
    assert "load 0: p_mw is nan; a number is expected" in problems_of(tmp_path, net)


@pytest.mark.parametrize(("table", "column"), [("bus", "name"), ("measurement", "std_dev"), ("line", "in_service")])
def test_a_table_without_a_column_is_named(tmp_path: Path, table: str, column: str) -> None:
    net = measured_grid()
    net[table] = net[table].drop(columns=column)
    assert f"table {table} has {len(net[table])} elements but no column {column}" in problems_of(tmp_path, net)


def test_a_line_beside_a_closed_switch_is_left_out_and_reported(tmp_path: Path) -> None:
    net = measured_grid()
    pp.create_line(net, 14, 15, 3, "NA2XS2Y 1x185 RM/25 12/20 kV")
    pp.create_measurement(net, "p", "line", 0.1, 0.02, 9, side="from")
    grid = imported(tmp_path, net)
    check_power_flow(grid, net)  # its charging included
    reported = {(remark.what, remark.text) for remark in grid.remarks}
    text = "line 9: closed switches join its two ends, it carries nothing; its own consumption stays as a shunt"
    assert ("left out", text) in reported
    last = net.measurement.index[-1]
    assert ("left out", f"measurement {last}: of a branch whose two ends closed switches join") in reported
    assert grid.network.bus(14).b_shunt > 0


def test_measurements_without_a_value_or_a_weight_are_left_out_and_reported(tmp_path: Path) -> None:
    net = measured_grid()
    whole = {m.meter.id for m in imported(tmp_path, net).readings}
    kinds = net.measurement.measurement_type
    at_5, at_11 = (net.measurement.index[(kinds == "v") & (net.measurement.element == bus)][0] for bus in (5, 11))
    p_5 = net.measurement.index[(kinds == "p") & (net.measurement.element == 5)][0]
    net.measurement.loc[at_5, ["value", "std_dev"]] = np.nan
    net.measurement.loc[at_11, "std_dev"] = 1e200
    net.measurement.loc[p_5, "std_dev"] = np.inf
    grid = imported(tmp_path, net)
    assert whole - {m.meter.id for m in grid.readings} >= {"vm@5", "vm@11", "p_injection@5"}
    reported = {remark.text for remark in grid.remarks if remark.what == "left out"}
    assert f"measurement {at_5}, {p_5}: without a value or a std_dev" in reported  # to_json writes no inf
    text = "with a standard deviation above 1e+06 p.u., infinite ones included, which says nothing"
    assert any(remark.endswith(text) and str(at_11) in remark for remark in reported)


def test_two_external_grids_of_separate_islands_are_reported_how_to_be_split(tmp_path: Path) -> None:
    net = small_grid()
    pp.create_ext_grid(net, 30)
    text = problems_of(tmp_path, net)
    assert "2 islands have a substation each; import them one by one: take the ext_grids" in text
    assert "the island of ext_grid 0 at bus 5: bus 5, 10, 11, 12, 13, 14, 15, 16" in text
    assert "the island of ext_grid 1 at bus 30: bus 30, 31" in text
    net.ext_grid.loc[0, "in_service"] = False
    assert list(imported(tmp_path, net).network.row) == [30, 31]
    net.ext_grid["in_service"] = False
    assert "no source in service holds voltage and angle" in problems_of(tmp_path, net)


def test_two_external_grids_of_one_island_are_reported_so(tmp_path: Path) -> None:
    net = small_grid()
    pp.create_ext_grid(net, 13)
    assert "ext_grid 0 at bus 5, ext_grid 1 at bus 13 feed one island" in problems_of(tmp_path, net)


def test_no_column_or_table_that_pandapower_does_not_know_is_left_out_in_silence(tmp_path: Path) -> None:
    net = small_grid()
    assert not any("does not know" in remark.text for remark in imported(tmp_path, net).remarks)
    net.load["const_z_percent"] = 0.0
    net.load["profile"] = "H0"
    net.line["max_loading_percent"] = 100.0  # pandapower knows it
    net["streets"] = net.bus.copy()[["name"]]
    pp.control.ContinuousTapControl(net, 0, 1.0)
    reported = {remark.text for remark in imported(tmp_path, net).remarks if remark.what == "left out"}
    assert (
        "columns of table load that pandapower does not know: const_z_percent; did you mean 'const_z_q_percent'?, "
        "profile"
    ) in reported
    assert "table streets: pandapower has no elements of this name" in reported
    assert "controller 0: not run, taps stay where they are" in reported


@pytest.mark.parametrize("controllers", [[1, 2], *further("none", {"a": 1}, None)])
def test_controllers_that_are_no_table_are_no_traceback(tmp_path: Path, controllers: object) -> None:
    net = small_grid()
    net["controller"] = controllers
    assert not any("controller" in remark.text for remark in imported(tmp_path, net).remarks)
