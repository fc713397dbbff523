"""The benchmark of commands: exponents without the start of Python, and inputs that the commands take."""

import math
from pathlib import Path

import pytest

from benchmarks.commands.command import COMMANDS, Cost, find_exponent, find_n_log_n, format_rows
from benchmarks.commands.inputs import write_inputs
from dsse_core.files.strict_table import load_strict
from scenarios.files.scenario_file import ScenarioFile
from scenarios.importers import import_grid
from scenarios.scenario import load_scenario

SIZES = [1000, 10_000, 100_000]


@pytest.mark.parametrize("k", [0.5, 1.0, 1.3, 2.0])
def test_the_start_of_python_does_not_make_growth_look_slow(k):
    assert find_exponent(SIZES, [0.1 + 1e-3 * n**k for n in SIZES]) == pytest.approx(k, abs=1e-3)
    assert find_exponent([1000, 3000, 20_000], [0.1 + 1e-3 * n**k for n in (1000, 3000, 20_000)]) == pytest.approx(
        k, abs=1e-3
    )


def test_figures_that_do_not_grow_have_no_exponent():
    assert find_exponent(SIZES, [1.0, 1.001, 1.002]) is None
    assert find_exponent(SIZES[:2], [1.0, 2.0]) is None


def test_what_grows_with_the_square_is_named():
    square, log = ({n: Cost(f(n), 100.0) for n in SIZES} for f in (lambda n: n * n / 1e6, lambda n: n * math.log(n)))
    rows = format_rows({"square": square, "log": log})
    assert next(row for row in rows if "square" in row).endswith("**yes** |")
    assert next(row for row in rows if "| log" in row).endswith("no |")
    assert find_n_log_n(SIZES) == pytest.approx(1.1, abs=0.05)


def test_all_inputs_are_the_same_feeder(tmp_path: Path):
    write_inputs(tmp_path, 40)
    made, measured = (load_scenario(tmp_path / name) for name in ("scenario.toml", "measured.toml"))
    assert {m.id for m in measured.meters} == {m.id for m in made.meters}
    imported = import_grid(tmp_path / "case.m").network
    assert [(b.from_bus, b.to_bus, b.r, b.x) for b in imported.branches] == [
        (b.from_bus, b.to_bus, b.r, b.x) for b in made.network.branches
    ]


@pytest.mark.parametrize("n_bus", [40, 2500])
def test_the_format_of_the_network_does_not_change_with_its_size(tmp_path: Path, n_bus: int):
    write_inputs(tmp_path, n_bus)
    for name in ("scenario.toml", "measured.toml"):
        assert load_strict(tmp_path / name, ScenarioFile).network == "network.json"


def test_every_command_about_a_grid_is_measured():
    assert {"generate", "check", "estimate", "powerflow", "partition", "split", "simulate", "import"} <= set(COMMANDS)
