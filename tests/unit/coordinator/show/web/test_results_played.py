"""Tables of results are played on the page as a recording is: of many scans, and of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.evaluation.result import RunResult
from coordinator.lab.evaluation.scan_estimates import estimate_scans
from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.show.web.playback.source import play_recording
from coordinator.watch.tables import write_tables
from dsse_core.errors import InvalidInputError
from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import Source
from dsse_core.grid.meter_table import read_meters_of
from dsse_core.results.results import Results
from dsse_core.results.scans import ScanTables
from scenarios.files.readings.file import Scans
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.served import client

SCENARIO = load_scenario("ieee33")
NAMES = ("2026-11-26T10:00Z", "2026-11-26T10:15Z", "2026-11-26T10:30Z")
WRONG, FAILED = 1, 2  # the scan with a gross error, and the one without an estimate


def estimate(names: tuple[str, ...]) -> ScanTables:
    scans = [make_telemetry(SCENARIO, k + 1).union for k in range(len(names))]
    values, sigmas = (np.array([read_column(scan, name, float) for scan in scans]) for name in ("value", "sigma"))
    meters = read_meters_of(scans[0])
    assert all(meter.source is not Source.VIRTUAL for meter in meters)
    values[WRONG, 5] += 40 * sigmas[WRONG, 5]
    values[FAILED, 3:] = np.nan
    return estimate_scans(SCENARIO, Scans(names, meters, values, sigmas)).tables


@pytest.fixture(scope="module")
def tables() -> ScanTables:
    return estimate(NAMES)


@pytest.fixture
def folder(tables: ScanTables, tmp_path: Path) -> Path:
    write_tables(tmp_path, tables)
    return tmp_path


def test_every_scan_is_a_moment_at_its_time_with_its_voltages_and_meters(folder: Path, tables: ScanTables) -> None:
    notes: list[str] = []
    asked = client(play_recording(folder, SCENARIO, notes))
    frames = asked.get("/api/frames").json()
    assert notes == []
    assert frames["times"] == [0.0, 900.0, 1800.0]
    assert frames["since"] == tables.scans.time[0].astype("int64") / 1000
    of_scan = len(tables.meters) // len(NAMES)
    for k in (0, WRONG):
        moment = asked.get(f"/api/frame/{k}").json()
        assert moment["buses"]["vm_pu"] == np.round(tables.buses.vm_pu[33 * k : 33 * (k + 1)], 5).tolist()
        loss = np.array(asked.get(f"/api/rows?kind=branch&frame={k}&count=100").json()["rows"]["loss_kw"], dtype=float)
        n = len(tables.branches) // len(NAMES)
        np.testing.assert_allclose(loss, tables.branches.loss_kw[n * k : n * (k + 1)], atol=1e-4)
        rows = asked.get(f"/api/rows?kind=meter&frame={k}&count=200").json()["rows"]
        assert len(rows["id"]) == of_scan
        expected = dict(
            zip(tables.meters.meter[:of_scan], tables.meters.normalised_residual[of_scan * k :], strict=False)
        )
        shown = {
            name: np.nan if x is None else x for name, x in zip(rows["id"], rows["normalised_residual"], strict=True)
        }
        for name, value in expected.items():
            assert shown[name] == pytest.approx(np.nan_to_num(value), abs=1e-3), name
        assert {area["quality"] for area in moment["view"]["areas"].values()} == {"good"}
        assert all(link["alive"] for link in moment["links"])
    removed = [name for area in moment["view"]["areas"].values() for name in area["removed"]]
    assert removed == tables.scans.removed_meters[WRONG].split()


def test_a_scan_without_an_estimate_shows_its_reason_and_no_numbers(folder: Path, tables: ScanTables) -> None:
    asked = client(play_recording(folder, SCENARIO, []))
    moment = asked.get(f"/api/frame/{FAILED}").json()
    areas = moment["view"]["areas"].values()
    assert {area["quality"] for area in areas} == {"none"}
    assert {note for area in areas for note in area["notes"]} == {tables.scans.reason[FAILED]}
    assert not [value for value in moment["buses"].get("vm_pu", []) if value is not None]


def test_a_scan_in_which_bad_data_are_left_says_so_in_all_areas(folder: Path, tables: ScanTables) -> None:
    for name, old, new in [("areas", ",good", ",degraded"), ("scans", ",false,", ",true,")]:
        path = folder / f"{name}.csv"
        path.write_text(path.read_text().replace(old, new))
    moment = client(play_recording(folder, SCENARIO, [])).get("/api/frame/0").json()
    notes = [area["notes"] for area in moment["view"]["areas"].values()]
    assert notes == [["bad data are left: J exceeds its limit, and no meter stands out"]] * 3
    assert "no reason is stated" not in str(moment["causes"])


def test_scans_without_times_are_a_second_apart(tmp_path: Path) -> None:
    write_tables(tmp_path, estimate(("first", "second", "third")))
    assert client(play_recording(tmp_path, SCENARIO, [])).get("/api/frames").json()["times"] == [0.0, 1.0, 2.0]


def test_the_tables_of_a_run_are_played_as_one_moment(tmp_path: Path) -> None:
    result = simulate_scenario(SCENARIO, out=tmp_path / "run")
    asked = client(play_recording(tmp_path / "run", SCENARIO, []))
    (at,) = asked.get("/api/frames").json()["times"]
    assert at == 0.0
    assert asked.get("/api/now").json()["buses"]["vm_pu"] == np.round(result.buses.vm_pu, 5).tolist()


def test_the_tables_of_a_run_keep_what_was_old_and_why(tmp_path: Path) -> None:
    killed = {"faults.events": [{"at_s": 1.0, "kill": "area2"}], "run.timeout_s": 20.0}
    result = simulate_scenario(load_scenario("ieee33", changes=killed), out=tmp_path / "run")
    moment = client(play_recording(tmp_path / "run", SCENARIO, [])).get("/api/now").json()
    areas = moment["view"]["areas"]
    assert {name: area["quality"] for name, area in areas.items()} == {
        area.name: area.quality for area in result.area_results
    }
    assert areas["area2"]["quality"] == "stale"
    assert areas["area1"]["notes"] == list(result.area_results[0].notes)
    assert moment["summary"]["voltage"]["known"] == 33 - areas_owned(result, "area2")


def areas_owned(result: RunResult, area: str) -> int:
    return int(result.areas.owned_buses[result.areas.area.index(area)])


@pytest.mark.parametrize(
    ("table", "old", "new", "words"),
    [
        ("buses", "vm_pu", "voltage", "has no column vm_pu"),
        ("buses", "\n7,", "\nseven,", "line 8: bus: 'seven' is no number"),
        ("buses", "\n33,", "\n99,", "buses are not those of 'ieee33'"),
        ("meters", "\nvm@1,", "\nvm@1,,", "line 2: 31 columns, but the header has 30"),
    ],
)
def test_a_damaged_table_is_named_with_its_line(folder: Path, table: str, old: str, new: str, words: str) -> None:
    path = folder / f"{table}.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InvalidInputError, match=words) as caught:
        play_recording(folder, SCENARIO, [])
    assert path.name in str(caught.value)


def test_without_a_scenario_the_cure_is_named(folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="dsse serve SCENARIO --recording FOLDER"):
        play_recording(folder, None, [])


def test_results_have_the_tables_that_are_played() -> None:
    assert set(Results.names) < set(ScanTables.names)
