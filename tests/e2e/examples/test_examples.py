"""The script of every tutorial runs as its user starts it, and leaves what it promises."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT, ROOT
from tests.support.foreign_distribution import write_example
from tests.support.levels import further

pytestmark = pytest.mark.xdist_group("examples")  # each script once

EXAMPLES = ROOT / "examples"
LONGEST_S = 1800.0
OF_GATEWAYS = {"gateway/meters.py", "own_source/udp_source.py"}  # run by tests/e2e/gateway
SCRIPTS: dict[str, tuple[list[str], list[str], list[str]]] = {  # arguments, what it says, files that it leaves
    "first_run.py": ([], ["p.u. from the centralised estimate", "angle-offset"], ["runs"]),
    "own_feeder.py": (
        ["feeder"],
        ["branch 1-2:", "bus 9:"],
        ["feeder/network.json", "feeder/voltages.pdf", "feeder/run/branches.csv"],
    ),
    "own_strategy/compare.py": ([], ["boundary-average  8.3e-04 p.u."], []),
    "study.py": (
        ["paper", "2"],
        ["16 runs, 0 without consensus", r"\begin{tabular}"],
        ["paper/figure.pdf", "paper/table.tex"],
    ),
    "thesis.py": ([], ["table 5.24", "misprint: angle 0.0953 for -0.0953"], []),
}


def run_script(name: str, folder: Path) -> str:
    """What example ``name`` prints; it must end well."""
    installed = write_example(folder / "installed")
    path = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(installed)])
    run = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *SCRIPTS[name][0]],
        cwd=folder,
        env={**ENVIRONMENT, "PYTHONPATH": path, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, str]]:
    """Runs an example once: its folder, and what it printed."""

    @cache
    def run(name: str) -> tuple[Path, str]:
        folder = tmp_path_factory.mktemp("example")
        return folder, run_script(name, folder)

    return run


# in the default set are the tests of what they call; `.ci/wheel` runs all of them, too
FURTHER = ("first_run.py", "own_strategy/compare.py", "study.py", "thesis.py")


@pytest.mark.parametrize("name", [*(name for name in SCRIPTS if name not in FURTHER), *further(*FURTHER)])
def test_the_script_of_a_tutorial_runs(name: str, ran: Callable[[str], tuple[Path, str]]):
    _, expected, left = SCRIPTS[name]
    folder, out = ran(name)
    assert [text for text in expected if text not in out] == []
    assert [file for file in left if not (folder / file).exists()] == []


def test_no_script_is_left_out_and_each_has_its_tutorial():
    scripts = {str(path.relative_to(EXAMPLES)) for path in EXAMPLES.rglob("*.py")}
    assert scripts == {*SCRIPTS, "own_strategy/boundary_average.py", *OF_GATEWAYS}
    pages = "".join(
        page.read_text() for room in ("tutorials", "how-to") for page in (ROOT / "docs" / room).glob("*.md")
    )
    assert [name for name in scripts if f"examples/{name}" not in pages] == []


@pytest.mark.long
def test_the_rows_of_the_study_are_one_per_run(ran: Callable[[str], tuple[Path, str]]):
    folder, _ = ran("study.py")
    with (folder / "paper" / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["faults.loss"], row["strategy"], row["seed"]) for row in rows} == {
        (loss, strategy, seed)
        for loss in ("0.0", "0.2", "0.4", "0.6")
        for strategy in ("information", "admm")
        for seed in ("1", "2")
    }
    assert all(float(row["gap_vm_pu"]) < 1e-6 for row in rows)
