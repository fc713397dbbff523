"""The first run on a machine compiles: it says so, loses no time by it, and the next one finds what it has kept."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.support.dsse_command import COMMAND, ENVIRONMENT

pytest.importorskip("numba")
pytestmark = pytest.mark.xdist_group("compiling")  # in one place, once

FIRST_RUN_S = 1800.0  # compiling takes a minute of a processor, of which a loaded machine gives a tenth
LINE = "compiling the solvers of large radial networks"
Dsse = Callable[..., subprocess.CompletedProcess[str]]
COUNTING_FROM = "its time limit counts so many seconds later: "
RUN = f"""
import sys, time
from coordinator.__main__ import main
from coordinator.lab.process_run.compile_clock import clock
started = time.monotonic()
code = main(sys.argv[1:])
print({COUNTING_FROM!r}, clock.find_start(started) - started)
sys.exit(code)
"""
WITHOUT_A_PLACE_TO_KEEP_IN = """
import os, sys
os.access = lambda *_: False  # as in an administrator's folder; root may write everywhere
from dsse_core import compiling
from dsse_core.code_places import find_folder_to_keep_in
from agents.runtime.warm_up import warm_up, warm_up_estimate
compiling.listen(lambda begins, folder: sys.exit("compiles"))
assert find_folder_to_keep_in() is None
warm_up()
warm_up_estimate()
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("compiled")


@pytest.fixture(scope="module")
def feeders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two areas of 70 buses, and of 600: those are estimated by compiled code in each area, too."""
    folder = tmp_path_factory.mktemp("feeders")
    for buses in (140, 1200):
        made = ["generate", "--buses", str(buses), "--areas", "2", "--out", str(folder / str(buses))]
        subprocess.run([*COMMAND, *made], env=ENVIRONMENT, capture_output=True, check=True)
    return folder


@pytest.fixture
def dsse(place: Path, tmp_path: Path) -> Dsse:
    def run(*arguments: str, command: Sequence[str] = COMMAND) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *arguments],
            cwd=tmp_path,
            env={**ENVIRONMENT, "NUMBA_CACHE_DIR": str(place)},
            capture_output=True,
            text=True,
            timeout=FIRST_RUN_S,
            check=False,
        )

    return run


@pytest.mark.long
def test_compiling_does_not_count_against_the_time_limit_and_is_reported_once(dsse: Dsse, feeders: Path, place: Path):
    scenario = str(feeders / "140" / "scenario.toml")
    run = ("run", scenario, "--timeout", str(FIRST_RUN_S), "--no-plots")
    first = dsse(*run, command=(sys.executable, "-P", "-c", RUN))
    assert first.returncode == 0, first.stdout + first.stderr
    assert float(first.stdout.rpartition(COUNTING_FROM)[2]) > 0.0
    assert first.stderr.count(LINE) == 1
    assert f"this happens once: the code is kept in {place}" in first.stderr
    second = dsse(*run, command=(sys.executable, "-P", "-c", RUN))
    assert second.returncode == 0, second.stdout + second.stderr
    assert float(second.stdout.rpartition(COUNTING_FROM)[2]) == 0.0
    assert LINE not in second.stderr


def test_a_single_estimate_does_not_wait_for_a_compiler(feeders: Path, tmp_path: Path):
    scenario = str(feeders / "1200" / "scenario.toml")
    environment = {**ENVIRONMENT, "NUMBA_CACHE_DIR": str(tmp_path / "empty")}
    done = subprocess.run([*COMMAND, "estimate", scenario], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert "back end sparse: the compiled solver is not there yet; `dsse compile` makes it" in done.stdout
    assert list(tmp_path.rglob("*.nb?")) == []


@pytest.mark.long
def test_what_was_compiled_ahead_is_not_compiled_again(dsse: Dsse, feeders: Path, place: Path):
    ahead = dsse("compile")
    assert ahead.returncode == 0, ahead.stderr
    assert f"kept in {place}" in ahead.stdout
    again = dsse("compile")
    assert f"is compiled already, in {place}" in again.stdout
    assert again.stderr == ""
    scenario = str(feeders / "1200" / "scenario.toml")
    for strategy in ("information", "angle-offset"):
        done = dsse("simulate", scenario, "--strategy", strategy, "--no-plots", "--out", strategy)
        assert done.returncode in (0, 1), done.stderr
        assert LINE not in done.stderr
    estimated = dsse("estimate", scenario)
    assert estimated.stderr == ""
    assert "back end radial" in estimated.stdout
    environment = {**ENVIRONMENT, "NUMBA_CACHE_DIR": str(place)}
    code = [sys.executable, "-P", "-c", WITHOUT_A_PLACE_TO_KEEP_IN]
    done = subprocess.run(code, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_compiled_code_is_not_loaded_from_where_others_can_write(dsse: Dsse, feeders: Path, place: Path):
    place.chmod(0o777)
    try:
        for command in ("compile", f"estimate {feeders / '1200' / 'scenario.toml'}"):
            done = dsse(*command.split())
            assert done.returncode == 2
            assert "error: NUMBA_CACHE_DIR: 1 problem\n  - compiled code is not loaded from" in done.stderr
            assert "Traceback" not in done.stderr
    finally:
        place.chmod(0o700)
