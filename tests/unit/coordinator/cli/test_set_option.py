"""``--set KEY=VALUE``: the scenario's keys on the command line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from coordinator.cli.main import run_command
from coordinator.cli.terminal import changed
from coordinator.lab.studies.sweep_plan import make_plan, parse_vary
from dsse_core.errors import InvalidInputError
from scenarios.files.key_values import parse_settings
from scenarios.scenario import Scenario, load_scenario


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("faults.loss=0.3", 0.3),
        ("areas = {count = 4}", {"count": 4}),
        ("strategy=admm", "admm"),
        ('strategy="admm"', "admm"),
        ("telemetry.noise=false", False),
        ("measurements.voltage.buses=[1, 2]", [1, 2]),
    ],
)
def test_a_value_is_what_toml_reads_and_words_need_no_quotes(text: str, value: object) -> None:
    assert list(parse_settings([text], "--set").values()) == [value]


def test_settings_that_are_none_or_given_twice_are_named_all_at_once() -> None:
    with pytest.raises(InvalidInputError) as caught:
        parse_settings(["faults.loss", "seed=1", "seed=2", "=3"], "--set")
    assert len(caught.value.problems) == 3
    assert "seed is given twice" in str(caught.value)


def test_every_kind_of_run_takes_settings_and_its_files_say_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ("--set", "faults.loss=0.1", "--set", "telemetry.noise=false")
    assert run_command(["simulate", "ieee33", *settings, "--quiet", "--no-plots", "--out", str(tmp_path / "a")]) == 0
    content: Mapping[str, Any] = json.loads((tmp_path / "a" / "result.json").read_text(encoding="utf-8"))
    assert content["scenario"]["changes"] == {"faults.loss": 0.1, "telemetry.noise": False}
    assert content["verdict"]["lost"] > 0
    assert run_command(["compare", "ieee33", "--strategies", "information", "--set", "areas={count=4}"]) == 0
    assert "33 buses in 4 areas" in capsys.readouterr().out


def test_faults_of_all_links_have_options_of_their_own(tmp_path: Path) -> None:
    options = ("--loss", "0.2", "--delay-ms", "3", "--quiet", "--no-plots", "--out", str(tmp_path / "a"))
    assert run_command(["simulate", "industrial13", *options]) == 0
    content: Mapping[str, Any] = json.loads((tmp_path / "a" / "result.json").read_text(encoding="utf-8"))
    assert content["verdict"]["lost"] > 0
    scenario = changed("industrial13", {}, {"loss": 0.2, "delay_s": 0.003})
    assert isinstance(scenario, Scenario)
    assert {(faults.loss, faults.delay_s) for faults in scenario.faults.links.values()} == {(0.2, 0.003)}


@pytest.mark.parametrize("command", ["run", "simulate", "compare", "check", "sweep"])
@pytest.mark.parametrize(
    ("setting", "expected"), [("fault.loss=0.3", "faults"), ("faults.lss=0.3", "faults.lss"), ("faults.loss=2", "2")]
)
def test_no_command_takes_a_key_that_does_not_exist_or_a_value_that_does_not_fit(
    command: str, setting: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    vary = ["--vary", "run.beat_s=0.1,0.2"] if command == "sweep" else []
    assert run_command([command, "ieee33", "--set", setting, *vary]) == 2
    message = capsys.readouterr().err
    assert f"with {setting.partition('=')[0]} set" in message or command == "sweep"
    assert expected in message


def test_what_a_sweep_sets_holds_in_all_its_runs_and_is_not_varied() -> None:
    plan = make_plan("ieee33", [parse_vary("faults.loss=0,0.5")], ("information",), 1, changes={"areas": {"count": 4}})
    assert {len(scenario.partition.areas) for scenario in plan.scenarios.values()} == {4}
    with pytest.raises(InvalidInputError, match="varied beside the option that sets it for all links"):
        make_plan("ieee33", [parse_vary("faults.delay_ms=0,5")], ("information",), 1, links={"delay_s": 0.1})
    with pytest.raises(InvalidInputError, match="varied and set"):
        make_plan("ieee33", [parse_vary("faults.loss=0,0.5")], ("information",), 1, changes={"faults.loss": 0.1})


def test_one_key_is_the_load_error_of_all_areas_but_those_that_have_their_own() -> None:
    error = {"all": {"p_mw": 0.3, "q_mvar": 0.2}, "area2": {"p_mw": 0.0, "q_mvar": 0.1}}
    scenario = load_scenario("ieee33", changes={"faults.load_error": error})
    assert scenario.load_error == {"area1": 0.03 + 0.02j, "area2": 0.01j, "area3": 0.03 + 0.02j}
