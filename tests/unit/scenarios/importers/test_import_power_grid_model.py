"""Networks of power-grid-model: the power flow is its own."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import results_of_power_flow
from tests.support.power_grid_model_grids import (
    NAN,
    check_power_flow,
    imported,
    pgm,
    small_grid,
    voltages_there,
    without_link,
)


@pytest.mark.parametrize("frequency_hz", [50.0, 60.0])
def test_the_power_flow_is_power_grid_models(tmp_path: Path, frequency_hz: float) -> None:
    data = without_link(small_grid())
    check_power_flow(imported(tmp_path, data, frequency_hz), data, frequency_hz)


def test_links_fuse_nodes_open_ends_become_shunts_and_all_is_reported(tmp_path: Path) -> None:
    data = small_grid()
    grid = imported(tmp_path, data)
    assert list(grid.network.row) == [1, 2, 3, 4, 5, 6, 7, 10]
    reported = {(remark.what, remark.text) for remark in grid.remarks}
    assert ("fused", "bus 9 into bus 4, joined by links") in reported
    assert ("changed", "branch 33: open at one end, written as the shunt that it is") in reported
    assert ("left out", "branch 34: open at both ends") in reported
    assert ("left out", "sym_load 64: out of service") in reported
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


@pytest.mark.parametrize("missing", ["rx_ratio", "sk", "u_ref_angle"])
def test_a_source_without_a_value_has_power_grid_models_default(tmp_path: Path, missing: str) -> None:
    data = without_link(small_grid())
    data["source"][missing] = NAN
    check_power_flow(imported(tmp_path, data), data)


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


def test_the_loading_of_lines_and_transformers_is_power_grid_models(tmp_path: Path) -> None:
    data = small_grid()
    grid = imported(tmp_path, data)
    branches = results_of_power_flow(solve_power_flow(grid.network, tolerance=1e-12)).branches
    output = pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-9, max_iterations=50)
    theirs = {int(row["id"]): 100 * float(row["loading"]) for kind in ("line", "transformer") for row in output[kind]}
    ours = dict(zip(branches.branch, branches.loading_percent, strict=True))
    branch_of = {30: "2-3", 31: "3-4", 32: "4-5", 20: "1-2", 21: "5-6"}
    found = [ours[branch] for branch in branch_of.values()]
    np.testing.assert_allclose(found, [theirs[component] for component in branch_of], rtol=1e-6)
    assert math.isnan(ours["3-7"])  # no rating is given
