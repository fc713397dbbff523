"""What is easily mistaken on the command line is answered with what was given and what is wanted."""

from __future__ import annotations

from pathlib import Path

import pytest

from coordinator.cli.main import run_command
from scenarios.files.shipped_files import find_shipped

NETWORK, SCENARIO = find_shipped("cases")["ieee33"], find_shipped("shipped")["ieee33"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that commands run in: a file of each kind, and a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "network.toml").write_text(NETWORK.read_text())
    (tmp_path / "scenario.toml").write_text(SCENARIO.read_text())
    twisted = SCENARIO.read_text().replace('network = "ieee33"', 'network = "scenario.toml"')
    (tmp_path / "twisted.toml").write_text(twisted)
    (tmp_path / "a-file").write_text("")
    (tmp_path / "a-folder").mkdir()
    assert run_command(["split", "ieee33", "--out", "areas"]) == 0
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            "estimate network.toml",
            'is a network file, which a scenario file names by network = "network.toml"; give a scenario file',
        ),
        ("run areas/area1.toml", "is an area file, which `dsse agent` takes; give a scenario file"),
        ("flows network.toml", "is a network file, which a scenario file names by"),
        ("check twisted.toml", "scenario.toml: is a scenario file, which `dsse run` takes; give a network file"),
        ("import network.toml --out new", "a network in TOML needs no import"),
        ("check IEEE33", "did you mean 'ieee33'?"),
        ("check a-folder", "the file or folder 'a-folder' is not looked at"),
        ("run ieee33 --strategy infomation", "did you mean 'information'?"),
        ("compare ieee33 --strategies admn", "did you mean 'admm'?"),
        ("check ieee33 --set loss=0.3", "did you mean 'faults.loss'"),
        ("sweep ieee33 --vary areas=3", "areas: must be a table, found 3 (one [areas.NAME] with its buses for each"),
        ("simulate ieee33 --out a-file", "run folder a-file: 1 problem\n  - cannot be made: a file is in its way"),
        ("simulate ieee33 --out a-file/new", "cannot be made: a file is in its way; choose another place"),
        ("keys create ieee33 --out a-file", "keys a-file: 1 problem\n  - cannot be made: a file is in its way"),
    ],
)
def test_a_likely_mistake_is_answered_with_what_to_do(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: str, expected: str
):
    assert run_command(arguments.split()) == 2
    output = capsys.readouterr().err
    assert expected in output
    assert len(output.splitlines()) == 2


@pytest.mark.parametrize(
    ("arguments", "instead"),
    [
        ("watch --grid ieee33", "dsse watch SCENARIO"),
        ("record --scenario ieee33", "dsse record SCENARIO"),
        ("replay a-folder --scenario ieee33", "dsse replay FOLDER SCENARIO"),
        ("router --scenario ieee33", "dsse router SCENARIO"),
        ("partition ieee33 --count 3", "--areas N"),
        *((f"{command} --timeout 3", "--wait S") for command in ("watch", "scan", "plant ieee33", "gateway map.toml")),
    ],
)
def test_a_former_option_is_refused_with_what_took_its_place(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: str, instead: str
):
    assert run_command(arguments.split()) == 2
    output = capsys.readouterr().err
    assert " is gone; " in output
    assert instead in output
    run_command([arguments.split()[0], "--help"])
    assert "removed" not in capsys.readouterr().out


def test_the_former_option_of_an_agent_is_refused_too(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        run_command(["agent", "areas/area1.toml", "--timeout", "3"])
    assert "--timeout: is gone; --wait S" in capsys.readouterr().err


def test_a_time_that_is_no_number_is_quoted(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        run_command(["agent", "areas/area1.toml", "--wait", "soon"])
    assert "--wait: 'soon' is no number of seconds" in capsys.readouterr().err


@pytest.mark.parametrize("vary", ["areas=" + "[" * 5000, "faults.loss=" + "9" * 5000, f"x[{'9' * 5000}].loss=1"])
def test_values_to_vary_that_no_reader_takes_are_one_error(capsys: pytest.CaptureFixture[str], vary: str):
    assert run_command(["sweep", "ieee33", "--vary", vary]) == 2
    output = capsys.readouterr().err
    assert output.startswith("error: ")
    assert len(output) < 5000


def test_an_area_file_that_was_edited_or_states_no_split_is_named_as_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
):
    path = folder / "areas" / "area1.toml"
    original = path.read_text()
    stated = original[original.index("[split]") : original.index("[", original.index("[split]") + 1)]
    edits = (
        (("beat_s = ", "tolerance = 1e-7\nbeat_s = "), "was edited after its split"),
        ((stated, ""), "states no split"),
    )
    for (old, new), why in edits:
        path.write_text(original.replace("tolerance", "#").replace(old, new))
        assert run_command(["check", "areas/area1.toml"]) == 0
        shown = capsys.readouterr().out
        assert "area1 of run ieee33 can be used, and no area will be good" in shown
        assert f"the file of this area {why}" in shown


def test_an_area_file_is_checked_as_its_agent_would(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["check", "areas/area2.toml"]) == 0
    assert "area2 of run ieee33 is sound: strategy information, neighbours area1" in capsys.readouterr().out
    path = folder / "areas" / "area2.toml"
    path.write_text(path.read_text().replace('"information"', '"infomation"').replace("beat_s", "baet_s"))
    assert run_command(["check", "areas/area2.toml"]) == 2
    output = capsys.readouterr().err
    assert "area file areas/area2.toml, which `dsse split SCENARIO --out DIR` writes: 1 problem" in output
    assert "baet_s: unknown key; allowed here: " in output
