"""Names from files that look like markup, formulas or orders to a terminal."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from agents.runtime.log import PrintableFormatter
from coordinator.lab.evaluation.result import RunResult
from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.show.figures.draw_areas import draw_areas
from coordinator.show.report.run_report import write_report
from coordinator.show.report.text import format_check, format_verdict
from coordinator.watch.observe.live import build_table
from coordinator.watch.observe.progress import AreaProgress, Progress
from dsse_core.printable import printable
from scenarios.files.network_file import load_network
from scenarios.scenario import Scenario, load_scenario
from tests.support.levels import further

CASE = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [ 1 3 0 0 0 0 1 1 0 20 1 1.1 0.9; 2 1 1 0.3 0 0 1 1 0 20 1 1.1 0.9 ];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [ 1 2 0.01 0.02 0 0 0 0 0 0 1 ];
"""
HOSTILE = ("$\\frac$", "[/nope]", "a$b", "\x1b[2J$x$", "\udcff")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return simulate_scenario("industrial13", tmp_path_factory.mktemp("runs") / "run")


def named(name: str) -> Scenario:
    scenario = load_scenario("industrial13")
    partition = replace(scenario.partition, network=replace(scenario.network, name=name))
    return replace(scenario, name=name, description=name, network=partition.network, partition=partition)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*HOSTILE[:1], *further(*HOSTILE[1:])])
def test_a_name_is_no_formula_in_a_picture(name: str, result: RunResult, tmp_path: Path):
    assert (
        write_report(replace(result, scenario=named(name), folder=tmp_path), ["png"], ["run", name]).unwritten is None
    )
    draw_areas(named(name).partition, tmp_path / "areas.png")
    assert len(list(tmp_path.glob("*.png"))) == 7
    assert all(path.stat().st_size > 0 for path in tmp_path.glob("*.png"))


@pytest.mark.parametrize("name", HOSTILE)
def test_a_verdict_and_a_check_are_printable_whatever_the_scenario_is_called(name: str, result: RunResult):
    noted = tuple(replace(area, notes=(f"{name}\nconsensus",)) for area in result.area_results)
    text = format_verdict(replace(result, scenario=named(name), area_results=noted)) + format_check(named(name))
    assert text.replace("\n", "").isprintable()
    assert not any(line.startswith("consensus\n") for line in text.splitlines(keepends=True))


@pytest.mark.parametrize("name", HOSTILE)
def test_the_table_of_a_run_takes_names_as_text(name: str):
    area = AreaProgress(name, "joined", 0, 0, None, None, 0, 0)
    console = Console(width=200, color_system=None)
    with console.capture() as captured:
        console.print(build_table(name, Progress(1.0, (area,), (f"{name} has no estimate: {name}",))))
    assert captured.get().replace("\n", "").isprintable()
    assert captured.get().count(printable(name)) == 4


def test_one_note_does_not_fill_the_terminal_of_a_run():
    console = Console(width=80, color_system=None)
    with console.capture() as captured:
        console.print(build_table("run", Progress(1.0, (), ("x" * 50_000,))))
    assert len(captured.get().splitlines()) < 20


def test_a_line_of_a_log_is_one_line_and_printable():
    record = logging.LogRecord("agents", logging.WARNING, __file__, 1, "%s", ("bad\x1b[2J\nmade-up line",), None)
    assert PrintableFormatter("%(message)s").format(record) == r"bad\x1b[2J\nmade-up line"


@pytest.mark.parametrize("name", ["net\udcff", "net\x1b[2J", "two\nlines"])
def test_a_file_name_that_is_no_text_does_not_become_the_name_of_a_network(dsse, tmp_path: Path, name: str):
    """Bytes that are no UTF-8 can stand in the name of a file, but not in a file."""
    case, folder = tmp_path / f"{name}.m", tmp_path / "imported"
    case.write_text(CASE, encoding="utf-8")
    code, _, err = dsse("import", case, "--out", folder)
    assert (code, err) == (0, "")
    assert load_network(folder / "network.toml").name == printable(name)
    assert printable(name) in (folder / "import.txt").read_text(encoding="utf-8")
    code, _, err = dsse("import", case, "--out", tmp_path / "named", "--name", f"my {name}")
    assert (code, err) == (0, "")
    assert load_network(tmp_path / "named" / "network.toml").name == printable(f"my {name}")


@pytest.mark.parametrize("name", ["sc\udcff", "sc\x1b[2J"])
def test_a_scenario_file_whose_name_is_no_text_is_called_what_can_be_written(dsse, tmp_path: Path, name: str):
    path = tmp_path / f"{name}.toml"
    shutil.copy(load_scenario("industrial13").path, path)
    assert load_scenario(path).name == printable(name)
    code, _, err = dsse("compare", path, "--out", tmp_path / "out")
    assert code == 0, err
    assert printable(name) in (tmp_path / "out" / "comparison.md").read_text(encoding="utf-8")
