"""What ``dsse estimate`` and ``dsse powerflow`` print for others to read on, and the files that they write."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from coordinator.cli import outputs
from coordinator.lab.simulator.simulate import simulate_scenario
from dsse_core.results import results
from dsse_core.results.scans import ScanTables
from scenarios.files.shipped_files import find_shipped

COMMANDS = ("estimate", "powerflow")
FILES = {"result.json", "buses.csv", "branches.csv", "meters.csv", "areas.csv"}


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text, newline="")))


def test_the_tables_that_options_name_are_those_of_results():
    assert outputs.TABLES == results.TABLES
    assert set(outputs.CHOICES) == {*results.TABLES, *ScanTables.names}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("table", outputs.TABLES)
def test_csv_is_the_table_and_nothing_else(dsse, command: str, table: str):
    code, out, err = dsse(command, "ieee33", "--csv", table)
    rows = read(out)
    assert (code, err) == (0, "")
    assert len(rows) == {"buses": 33, "branches": 37, "meters": 134, "areas": 3}[table]
    assert None not in rows[0]
    assert {row["phase"] for row in rows} == {"abc"}


@pytest.mark.parametrize("command", COMMANDS)
def test_json_is_one_document_with_the_numbers_of_the_csv(dsse, command: str):
    content = json.loads(dsse(command, "ieee33", "--json")[1])
    rows = read(dsse(command, "ieee33", "--csv", "branches")[1])
    assert [branch["i_from_a"] for branch in content["branches"]] == [float(row["i_from_a"]) for row in rows]
    assert content["scenario"]["name"] == "ieee33"
    assert content["branches"][0]["loading_percent"] is None
    assert ("power_flow" in content) == (command == "powerflow")


def test_a_network_file_needs_no_scenario_to_have_flows(dsse):
    network = str(find_shipped("cases")["ieee33"])
    assert dsse("powerflow", network, "--csv", "branches")[1] == dsse("powerflow", "ieee33", "--csv", "branches")[1]
    content = json.loads(dsse("powerflow", network, "--json")[1])
    assert content["network"] == {"name": "ieee33", "buses": 33}
    assert "scenario" not in content
    assert content["areas"][0]["area"] == ""
    code, _, err = dsse("powerflow", network, "--set", "seed=3")
    assert code == 2
    assert "give a scenario file" in err


def test_files_have_one_layout_whatever_they_come_from(dsse, tmp_path: Path):
    for command in COMMANDS:
        assert dsse(command, "ieee33", "--out", tmp_path / command)[0] == 0
        assert {path.name for path in (tmp_path / command).iterdir()} == FILES
    simulate_scenario("ieee33", tmp_path / "run")
    for name in FILES - {"result.json"}:
        heads = {(tmp_path / kind / name).read_text().split("\n", 1)[0] for kind in (*COMMANDS, "run")}
        assert len(heads) == 1


def test_parquet_is_written_beside_where_it_is_asked_for(dsse, tmp_path: Path):
    pytest.importorskip("pyarrow")
    assert dsse("estimate", "ieee33", "--out", tmp_path / "e", "--parquet")[0] == 0
    assert dsse("simulate", "ieee33", "--quiet", "--no-plots", "--out", tmp_path / "s", "--parquet")[0] == 0
    for folder in ("e", "s"):
        assert {path.stem for path in (tmp_path / folder).glob("*.parquet")} == set(outputs.TABLES)


@pytest.mark.parametrize("command", [*COMMANDS, "run", "simulate"])
def test_parquet_without_pyarrow_is_one_error_before_anything_is_done(
    dsse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    code, out, err = dsse(command, "ieee33", "--out", tmp_path / "out", "--parquet")
    assert (code, out) == (2, "")
    assert "[parquet]'" in err
    assert not (tmp_path / "out").exists()


def test_options_that_contradict_each_other_are_named(dsse, tmp_path: Path):
    assert "give one of them" in dsse("estimate", "ieee33", "--json", "--csv", "buses")[2]
    assert "--out DIR" in dsse("powerflow", "ieee33", "--parquet")[2]
    code, _, err = dsse("estimate", "ieee33", "--csv", "lines")
    assert code == 2
    assert "branches" in err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "there").touch()
    assert "is not empty" in dsse("estimate", "ieee33", "--out", tmp_path / "full")[2]


def test_notes_do_not_stand_in_what_is_piped(dsse, tmp_path: Path):
    shipped = find_shipped("shipped")["ieee33"].read_text(encoding="utf-8")
    scenario = tmp_path / "gross.toml"
    scenario.write_text(f'{shipped}\n[[telemetry.gross_error]]\nmeter = "p_injection@24"\nsigmas = 30.0\n')
    assert "removed as bad data: p_injection@24" in dsse("estimate", scenario)[1]
    code, out, err = dsse("estimate", scenario, "--csv", "meters", "--out", tmp_path / "out")
    assert code == 0
    assert "note: removed as bad data: p_injection@24" in err
    assert f"files: {tmp_path / 'out'}" in err
    rows = {row["meter"]: row for row in read(out)}
    assert rows["p_injection@24"]["status"] == "removed"
    assert float(rows["p_injection@24"]["normalised_residual"]) > 20
    assert rows["p_injection@25"]["status"] == "used"


def test_the_text_has_kilowatts_amperes_and_losses(dsse):
    for command in COMMANDS:
        out = dsse(command, "ieee33")[1]
        assert "injection kW" in out
        assert "I A" in out
        assert "loss kW" in out
    assert "losses 214.06 kW" in out


def test_a_reader_that_goes_away_is_no_error():
    command = [sys.executable, "-m", "coordinator", "powerflow", "ieee33", "--csv", "branches"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()  # before anything is printed
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=600), err) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_under_standard_output_is_one_line():
    command = [sys.executable, "-m", "coordinator", "powerflow", "ieee33", "--json"]
    with open("/dev/full", "w") as full:
        found = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=600, check=False)
    assert found.returncode == 2
    assert "Traceback" not in found.stderr
    assert "No space left" in found.stderr


@pytest.mark.parametrize(
    "arguments", [("estimate", "nosuch"), ("powerflow", "nosuch"), ("thesis", "--table", "9.9"), ("estimate", ".")]
)
def test_a_command_that_finds_nothing_leaves_no_folder(dsse, tmp_path: Path, arguments: tuple[str, ...]) -> None:
    code, _, err = dsse(*arguments, "--out", tmp_path / "new" / "out")
    assert code == 2
    assert "error: " in err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_was_there_stays_where_a_command_finds_nothing(dsse, tmp_path: Path) -> None:
    assert dsse("estimate", "nosuch", "--out", tmp_path)[0] == 2
    assert tmp_path.is_dir()
