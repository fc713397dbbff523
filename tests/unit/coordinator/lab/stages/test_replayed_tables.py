"""``dsse replay --out``: the tables of a run with the rows of all scans of a recording."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.lab.simulator.subscriber import SimulatedRecording
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

pytestmark = pytest.mark.slow
SCENARIO = load_scenario("ieee33")
SCANS = 3
Dsse = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "recording"
    files = area_files(SCENARIO, "replayed", ["tcp/127.0.0.1:7447"])
    writer = SimulatedRecording(folder, STARTED_AT, None)
    writer.begin("replayed", files)
    telemetry = [make_telemetry(SCENARIO, scan + 1).by_area for scan in range(SCANS)]
    bus = SimulatedBus(files, telemetry[0], writer.take_state, on_readings=writer.take_readings)
    for scan in range(SCANS):
        if scan:
            bus.next_scan(telemetry[scan])
        bus.run(1.0)
    writer.close()
    return folder


def read(path: Path, scan: str, *columns: str) -> np.ndarray:
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["scan"] == scan]
    return np.array([[float(row[column] or "nan") for column in columns] for row in rows]).T


def test_each_scan_has_the_tables_of_its_centralised_estimate(recording: Path, tmp_path: Path, dsse: Dsse) -> None:
    out = tmp_path / "out"
    code, said, _ = dsse("replay", str(recording), "ieee33", "--out", str(out), "--no-plots", "--quiet")
    assert code == 0
    assert f"{SCANS} scans played" in said
    with (out / "scans.csv").open(newline="", encoding="utf-8") as file:
        scans = list(csv.DictReader(file))
    assert [row["scan"] for row in scans] == [str(scan + 1) for scan in range(SCANS)]
    assert [row["time"] for row in scans] == sorted({row["time"] for row in scans})
    for scan, row in enumerate(scans):
        readings = make_telemetry(SCENARIO, scan + 1).union
        report = process_bad_data(SCENARIO.network, readings, tolerance=1e-9)
        alone = results_of_estimate(report, partition=SCENARIO.partition, meters=SCENARIO.meters)
        assert float(row["objective"]) == pytest.approx(report.objective, rel=1e-6)
        for table, columns in {
            "buses": ("vm_pu", "sigma_vm_pu", "p_kw", "sigma_p_kw"),
            "branches": ("p_from_kw", "i_to_a", "sigma_p_from_kw"),
            "areas": ("loss_kw", "sigma_loss_kw"),
            "meters": ("value_kw", "estimate_kw", "normalised_residual"),
        }.items():
            found, expected = read(out / f"{table}.csv", row["scan"], *columns), getattr(alone, table)
            np.testing.assert_allclose(found, [expected[name] for name in columns], rtol=1e-5, atol=1e-5, err_msg=table)
    content = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert content["scenario"]["name"] == "ieee33"
    assert content["replay"]["scans"] == SCANS
    assert not (out / "report.html").exists()


def test_tables_of_a_replay_need_a_scenario_and_parquet_a_folder(recording: Path, tmp_path: Path, dsse: Dsse) -> None:
    code, _, words = dsse("replay", str(recording), "--out", str(tmp_path / "out"))
    assert code == 2
    assert "dsse replay FOLDER SCENARIO --out DIR" in words
    assert not (tmp_path / "out").exists()
    for option in (["--parquet"], ["--format", "pdf"]):
        code, _, words = dsse("replay", str(recording), "ieee33", *option)
        assert code == 2
        assert f"{option[0]} writes files; say where with --out DIR" in words
