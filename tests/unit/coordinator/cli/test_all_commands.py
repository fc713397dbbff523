"""All commands alike: their help, their exit codes, and their places in ``dsse --help``."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest

from coordinator.cli.command import PARTS, Command, list_leaves
from coordinator.cli.main import commands
from coordinator.field.gateway import check
from coordinator.field.gateway.check import CheckReport
from coordinator.field.gateway.maps import map_file
from coordinator.lab.process_run import compile_ahead
from coordinator.lab.stages import play
from coordinator.watch.replay.replay import Comparison

LEAVES = list(list_leaves(commands))
ALL_COMMANDS = pytest.mark.parametrize(("words", "command"), LEAVES, ids=[" ".join(words) for words, _ in LEAVES])
ITS_OWN_HELP = "agent"  # passes its arguments on to a parser that starts faster


def test_help_lists_every_command_in_one_of_four_parts(dsse):
    code, out, _ = dsse("--help")
    assert code == 0
    sections = dict(zip(PARTS, out.split("\n\n")[-len(PARTS) :], strict=True))
    for part, section in sections.items():
        assert section.startswith(f"{part} ")
    for name, command in commands.commands.items():
        assert f"\n  {name} " in sections[command.part]  # type: ignore[attr-defined]
    assert "..." not in "".join(sections.values()), "a line is cut short"


@ALL_COMMANDS
def test_a_command_explains_itself_with_an_example_and_its_exit_codes(dsse, words: tuple[str, ...], command):
    if words[0] == ITS_OWN_HELP:
        assert "Example:" in (command.help or "")
        return
    code, out, _ = dsse(*words, "--help")
    assert code == 0
    assert f"dsse {' '.join(words)}" in out.split("Example")[-1]
    if isinstance(command, Command):
        listed = out.split("Exit codes:")[-1].split("\n")
        assert [int(line.split()[0]) for line in listed if line[:3].strip()] == list(command.codes)


@ALL_COMMANDS
def test_an_option_has_one_meaning_in_all_commands(words: tuple[str, ...], command: click.Command):
    options = {o for p in command.params if isinstance(p, click.Option) and not p.hidden for o in p.opts}
    assert not options & {"--scenario", "--grid"}, "a scenario is an argument"
    assert not {"--timeout", "--wait"} <= options
    assert ("--timeout" in options) == (words[0] in ("run", "simulate", "compare", "sweep"))


@ALL_COMMANDS
def test_an_option_that_does_not_exist_is_wrong_input(dsse, words: tuple[str, ...], command: click.Command):
    if words[0] == ITS_OWN_HELP:
        with pytest.raises(SystemExit, match="2"):
            dsse(*words, "--no-such-option")
        return
    code, out, err = dsse(*words, "--no-such-option")
    assert (code, out) == (2, "")
    assert "No such option" in err


CASE = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [ 1 3 0 0 0 0 1 1 0 20 1 1.1 0.9; 2 1 1.5 0.3 0 0 1 1 0 20 1 1.1 0.9 ];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [ 1 2 0.01 0.02 0 0 0 0 0 0 1 ];
"""
JSON = {
    "simulate": ("simulate industrial13 --no-plots --quiet", "verdict"),
    "scenarios": ("scenarios", "scenarios"),
    "scenarios show": ("scenarios show ieee33", "network"),
    "scenarios copy": ("scenarios copy ieee33 my", "scenario"),
    "check": ("check industrial13", "areas"),
    "compare": ("compare industrial13 --strategies information", "rows"),
    "sweep": ("sweep industrial13 --vary faults.loss=0 --seeds 1 --strategies information --jobs 1 --no-plots", "rows"),
    "thesis": ("thesis --table 5.1", "rows"),
    "estimate": ("estimate industrial13", "buses"),
    "powerflow": ("powerflow industrial13", "buses"),
    "partition": ("partition ieee33", "areas"),
    "generate": ("generate --buses 12 --out new", "scenario"),
    "import": ("import case.m --out new", "scenario"),
    "split": ("split industrial13 --out areas", "files"),
    "keys create": ("keys create industrial13", "processes"),
    "gateway": ("gateway map.toml --check", "is_sound"),
    "compile": ("compile", "kept_in"),
    "replay": ("replay .", "agrees"),
}
OF_A_SYSTEM = {"run", "watch", "flows", "meter off", "meter on", "switch open", "switch close", "scan", "stop"}
"""Tested in tests/e2e/terminal and tests/e2e/security/test_operator.py, where there is one."""


def test_every_command_that_gives_an_answer_gives_it_as_json() -> None:
    answering = {" ".join(words) for words, command in LEAVES if not getattr(command, "serves", False)}
    has_json = {" ".join(words) for words, command in LEAVES if any("--json" in p.opts for p in command.params)}
    assert answering <= has_json
    assert set(JSON) | OF_A_SYSTEM == has_json


@pytest.mark.parametrize(("line", "key"), JSON.values(), ids=JSON)
def test_with_json_a_command_prints_one_object_and_nothing_else(
    dsse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, key: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compile_ahead, "compile_ahead", lambda: compile_ahead.CompiledAhead("cache", ()))
    monkeypatch.setattr(play, "play_on_simulator", lambda *_: Comparison(scans=2, compared=6))
    monkeypatch.setattr(map_file, "load_map", lambda _: None)
    monkeypatch.setattr(check, "check_map", lambda *_: CheckReport("text"))
    Path("case.m").write_text(CASE, encoding="utf-8")
    code, out, _ = dsse(*line.split(), "--json")
    assert code == 0
    assert out.count("\n") == 1
    assert key in json.loads(out)
