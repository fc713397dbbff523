"""``dsse import`` as a user meets it, and what follows on real readings: estimate and run without a truth."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.keys import default_run_id
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from scenarios.files.network_file import load_case
from scenarios.files.readings.file import save_readings
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

CASE = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [
  1 3 0   0    0 0 1 1 0 20 1 1.1 0.9
  2 1 0   0    0 0 1 1 0 20 1 1.1 0.9
  3 1 1.5 0.3  0 0 1 1 0 20 1 1.1 0.9
  4 1 0.5 0.1  0 0 1 1 0 20 1 1.1 0.9
  5 1 9   9    0 0 1 1 0 20 1 1.1 0.9
];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [
  1 2 0.01 0.02 0 0 0 0 0 0 1
  2 3 0.02 0.03 0 0 0 0 0 0 1
  2 4 0.02 0.03 0 0 0 0 0 0 1
  4 3 0.02 0.03 0 0 0 0 0 0 0
];
"""
PNG = b"\x89PNG"


@pytest.fixture
def case(tmp_path: Path) -> Path:
    path = tmp_path / "feeder.m"
    path.write_text(CASE, encoding="utf-8")
    return path


def test_an_imported_case_is_reported_checked_and_runs(dsse, tmp_path: Path, case: Path) -> None:
    code, out, _ = dsse("import", case, "--out", tmp_path / "new", "--areas", 2, "--name", "town")
    assert code == 0
    assert out.splitlines() == [
        "source     MATPOWER case feeder.m",
        "converted  4 buses, 4 branches, 1 generators",
        "left out   bus 5 with 9 MW of load, 0 sources and 0 branches: no closed branch joins them to the substation",
        "note       branch 4-3: out of service, kept as open branches; write `switch = true` where one may be closed",
        f"next: dsse run {tmp_path / 'new' / 'scenario.toml'}",
    ]
    assert load_scenario(tmp_path / "new" / "scenario.toml", strategies=("information",)).network.name == "town"
    code, out, _ = dsse(
        "simulate", tmp_path / "new" / "scenario.toml", "--out", tmp_path / "run", "--no-plots", "--quiet"
    )
    assert code == 0
    assert "decentralised to truth" in out


def test_files_that_are_there_are_not_overwritten(dsse, tmp_path: Path, case: Path) -> None:
    assert dsse("import", case, "--out", tmp_path / "new")[0] == 0
    code, _, err = dsse("import", case, "--out", tmp_path / "new")
    assert code == 2
    assert all(f"{name} is there already" in err for name in ("network.toml", "scenario.toml", "import.txt"))


def test_more_areas_than_the_network_has_are_rejected(dsse, tmp_path: Path, case: Path) -> None:
    code, _, err = dsse("import", case, "--out", tmp_path / "new", "--areas", 9)
    assert code == 2
    assert "3" in err
    assert not (tmp_path / "new").exists()


def test_an_import_that_cannot_be_estimated_leaves_no_folder_behind(
    dsse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Path
) -> None:
    from scenarios.importers.matpower import reader as matpower

    read = matpower.read_matpower
    one = (Measurement(Meter(MeasurementKind.VM, 1), 1.0, 0.01),)
    monkeypatch.setattr(matpower, "read_matpower", lambda path: replace(read(path), readings=one))
    code, out, err = dsse("import", case, "--out", tmp_path / "new" / "deep")
    assert (code, out) == (2, "")
    assert "feeder.m is read, but cannot be estimated as it is" in err
    assert "do not determine the state of bus" in err
    assert not (tmp_path / "new").exists()
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "note.txt").touch()
    assert dsse("import", case, "--out", tmp_path / "new")[0] == 2
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["note.txt"]


def test_runs_of_two_imports_do_not_share_a_name(dsse, tmp_path: Path, case: Path) -> None:
    other = case.rename(tmp_path / "Harbour East.m")
    assert dsse("import", other, "--out", tmp_path / "a")[0] == 0
    assert dsse("import", other, "--out", tmp_path / "b", "--name", 't"own\n' + 300 * "n")[0] == 0
    one, two = (load_scenario(tmp_path / folder / "scenario.toml") for folder in "ab")
    assert (one.name, one.network.name, default_run_id(one.name)) == ("Harbour East", "Harbour East", "harbour-east")
    assert two.name.startswith(r't"own\nnnn')
    assert default_run_id(two.name) == "t-own-" + 58 * "n"


def test_a_case_that_is_not_understood_leaves_nothing_behind(dsse, tmp_path: Path, case: Path) -> None:
    case.write_text(CASE + "mpc.bus(2, 3) = 7;\n", encoding="utf-8")
    code, _, err = dsse("import", case, "--out", tmp_path / "new")
    assert code == 2
    assert "line 18" in err
    assert not (tmp_path / "new").exists()


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """A scenario whose readings come from a file."""
    readings = [m for m in make_telemetry(load_scenario("ieee33")).union if m.meter.source is not Source.VIRTUAL]
    save_readings(tmp_path / "readings.csv", load_case("ieee33"), readings)
    path = tmp_path / "real.toml"
    path.write_text(
        'version = 1\ndescription = "real"\nnetwork = "ieee33"\nstrategy = "information"\nareas = { count = 3 }\n'
        '[telemetry]\nsource = "file"\nfile = "readings.csv"\n',
        encoding="utf-8",
    )
    return path


def test_estimate_and_check_work_on_real_readings_and_print_no_truth(dsse, real: Path) -> None:
    assert dsse("check", real)[0] == 0
    code, out, _ = dsse("estimate", real)
    assert code == 0
    assert out.splitlines()[0].split() == [
        "bus", "vm", "p.u.", "sigma", "va", "deg", "sigma", "injection", "kW", "sigma", "kvar", "sigma",
    ]  # fmt: skip
    assert dsse("estimate", "ieee33")[1].splitlines()[0].split().count("true") == 2


@pytest.mark.slow
def test_a_run_on_real_readings_has_gaps_but_no_errors(dsse, tmp_path: Path, real: Path) -> None:
    code, out, _ = dsse("simulate", real, "--out", tmp_path / "run", "--quiet")
    assert code == 0
    assert "decentralised to centralised" in out
    assert "truth" not in out
    assert "error" not in out
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    for table in (result["verdict"], result["centralised"], *result["areas"].values()):
        assert (table["error_vm_pu"], table["error_va_deg"]) == (None, None)
    assert result["verdict"]["gap_vm_pu"] < 1e-8
    assert result["scenario"]["telemetry"] == "file"
    with (tmp_path / "run" / "buses.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["true_vm_pu"] for row in rows} == {""}
    assert "" not in {row["centralised_vm_pu"] for row in rows}
    for name in ("magnitudes", "angles", "errors", "gap"):
        assert (tmp_path / "run" / f"{name}.png").read_bytes().startswith(PNG)
