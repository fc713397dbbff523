"""The estimate of a whole grid in one place: columns from the file to the result."""

from pathlib import Path

import pytest

from dsse_core.estimation.bad_data import process_bad_data_with_plan
from scenarios.check import plan_whole_grid
from scenarios.generate.generated_files import write_generated
from scenarios.scenario import load_scenario
from scenarios.telemetry import read_meters


def test_from_file_to_estimate_no_bus_no_branch_and_no_meter_is_visited(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    scenario = load_scenario(write_generated(tmp_path, 600, 3, n_area=2), whole=True)
    scan = read_meters(scenario)
    report = process_bad_data_with_plan(plan_whole_grid(scenario), scan.values, scan.sigmas)
    report.result.state_sigma()
    network = scenario.network
    assert report.result.backend == "radial"
    assert not [part for part in (network.buses, network.branches, scenario.meters) if "objects" in vars(part)]
