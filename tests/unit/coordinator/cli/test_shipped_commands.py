"""``dsse scenarios``, and files of other projects where a scenario is expected."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from coordinator.cli.main import run_command
from coordinator.lab.process_run import compile_ahead
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.files.network_file import load_case
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import load_scenario


def test_a_scenario_is_shown_as_it_is_shipped(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["scenarios", "show", "ieee33-lossy"]) == 0
    assert capsys.readouterr().out == find_shipped("shipped")["ieee33-lossy"].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", find_shipped("shipped"))
def test_a_copy_stands_by_itself_and_is_the_same_scenario(name: str, tmp_path: Path) -> None:
    assert run_command(["scenarios", "copy", name, str(tmp_path / "my")]) == 0
    copied, shipped = load_scenario(tmp_path / "my" / f"{name}.toml"), load_scenario(name)
    assert copied.name == name
    assert copied.network == shipped.network
    assert copied.meters == shipped.meters
    assert 'network = "network.toml"' in (tmp_path / "my" / f"{name}.toml").read_text(encoding="utf-8")


def test_a_copy_overwrites_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "network.toml").write_text("mine", encoding="utf-8")
    assert run_command(["scenarios", "copy", "ieee33", str(tmp_path)]) == 2
    assert "network.toml is there already" in capsys.readouterr().err
    assert (tmp_path / "network.toml").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["network.toml"]


@pytest.mark.parametrize("command", ["show", "copy"])
def test_an_unknown_scenario_is_named_with_the_one_that_was_meant(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["scenarios", command, "iee33", *([str(tmp_path)] if command == "copy" else [])]) == 2
    assert "did you mean 'ieee33'?" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "check", "simulate"])
@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("x.m", "function mpc = x\n", "MATPOWER case"),
        ("x.json", '{"_module": "pandapower.auxiliary", "_class": "pandapowerNet"}', "pandapower network"),
        ("x.json", '{"version": "1.0", "type": "input", "is_batch": false, "data": {}}', "power-grid-model file"),
    ],
)
def test_a_file_of_another_project_is_answered_by_the_command_that_imports_it(
    command: str,
    name: str,
    content: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(content, encoding="utf-8")
    assert run_command([command, name]) == 2
    message = capsys.readouterr().err
    assert kind in message
    assert f"dsse import {name} --out DIR" in message


def test_the_plain_feeder_loses_what_the_literature_says() -> None:
    network = load_case("case33bw")
    result = solve_power_flow(network)
    losses_kw = 1000 * network.base_mva * result.losses.real
    assert losses_kw == pytest.approx(202.68, abs=0.005)
    assert min(result.vm) == pytest.approx(0.9131, abs=5e-5)
    thesis = load_case("ieee33")
    assert thesis.branches == network.branches
    changed = [(a.id, a.q_load) for a, b in zip(network.buses, thesis.buses, strict=True) if a != b]
    assert changed == [(28, pytest.approx(0.002))]


def test_the_next_command_is_one_that_a_shell_takes(dsse, tmp_path: Path) -> None:
    code, out, _ = dsse("scenarios", "copy", "ieee33", tmp_path / "my feeder's")
    assert code == 0
    assert shlex.split(out) == ["next:", "dsse", "run", str(tmp_path / "my feeder's" / "ieee33.toml")]


def test_where_compiled_code_is_kept_is_printed_as_all_else_is(dsse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "compile_ahead", lambda: compile_ahead.CompiledAhead("/a\x1b[2Jfolder", ()))
    assert dsse("compile")[:2] == (0, r"kept in /a\x1b[2Jfolder" + "\n")
