"""Studies on executors: rows are those of the local pool, also where workers are killed or the study is."""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import consensus_dsse as dsse
from coordinator.cli.main import run_command
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.studies import sweep as sweep_module
from coordinator.lab.studies.executors import RUNS_OF_UNIT, WorkerError, open_executor, run_units
from coordinator.lab.studies.sweep_plan import hash_scenario
from dsse_core.errors import InvalidInputError
from tests.support.dsse_command import ENVIRONMENT, ROOT, free_port
from tests.support.waiting import wait_until

STUDY = ["sweep", "industrial13", "--vary", "faults.loss=0,0.3", "--strategies", "information", "--quiet", "--no-plots"]


@dataclass
class Dask:
    """A scheduler and its workers on loopback."""

    address: str
    workers: list[subprocess.Popen[bytes]]


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    pytest.importorskip("distributed")
    port = free_port()
    with contextlib.ExitStack() as stack:

        def start(*arguments: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
                env=ENVIRONMENT | {"PYTHONPATH": str(ROOT)},
                cwd=tmp_path,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        start("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        local = ("--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        workers = [start("dask_worker", f"tcp://127.0.0.1:{port}", *local) for _ in range(2)]
        yield Dask(f"dask://127.0.0.1:{port}", workers)


def rows_in(folder: Path) -> list[dict[str, str]]:
    """Rows of the table but for the host, in the order of value and seed."""
    with (folder / "sweep.csv").open() as file:
        rows = [{key: cell for key, cell in row.items() if key != "host"} for row in csv.DictReader(file)]
    return sorted(rows, key=lambda row: (row["faults.loss"], int(row["seed"])))


def count_lines(folder: Path) -> int:
    path = folder / "sweep.csv"
    return path.read_bytes().count(b"\n") if path.exists() else 0


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.n_cases(few=40, long=40, many=200)
def test_a_sweep_goes_on_after_kill_9_and_the_death_of_a_worker_with_the_rows_of_the_local_pool(
    tmp_path: Path, dask: Dask, n_cases: int
):
    options = [*STUDY, "--seeds", str(n_cases)]
    assert run_command([*options, "--jobs", "2", "--out", str(tmp_path / "local")]) == 0
    folder = tmp_path / "far"
    far = [*options, "--executor", dask.address, "--out", str(folder)]
    study = subprocess.Popen([sys.executable, "-P", "-m", "coordinator", *far], env=ENVIRONMENT)
    try:
        wait_until(lambda: count_lines(folder) > 1)
        dask.workers[0].kill()  # in the middle of a unit, which the other worker runs again
        wait_until(lambda: count_lines(folder) > 1 + RUNS_OF_UNIT)
    finally:
        study.kill()
        study.wait()
    assert rows_in(folder)
    assert subprocess.run([sys.executable, "-P", "-m", "coordinator", *far], env=ENVIRONMENT).returncode == 0
    assert len(rows_in(folder)) == 2 * n_cases
    assert rows_in(folder) == rows_in(tmp_path / "local")


def test_a_study_by_any_executor_has_the_rows_of_one_process():
    here = dsse.sweep("industrial13", {"faults.loss": [0.0, 0.3]}, strategies=["information"], seeds=2)
    side_by_side = dsse.compare("industrial13", strategies=["information", "angle-offset"])
    with ThreadPoolExecutor(1) as executor:
        far = dsse.sweep(
            "industrial13", {"faults.loss": [0.0, 0.3]}, strategies=["information"], seeds=2, executor=executor
        )
        compared = dsse.compare("industrial13", strategies=["information", "angle-offset"], executor=executor)
    for expected, found in ((here, far), (side_by_side, compared)):
        for name in expected.columns:
            np.testing.assert_array_equal(getattr(expected, name), getattr(found, name))


def test_the_hash_of_a_scenario_stays_when_it_has_run():
    scenario = choose_scenario("industrial13")
    before = hash_scenario(scenario)
    sweep_module.run_on_simulator(scenario)
    assert hash_scenario(scenario) == before


def test_a_unit_has_no_more_runs_than_a_scheduler_is_to_lose():
    units = []

    def run(unit):
        units.append(len(unit))
        return unit

    with ThreadPoolExecutor(1) as executor:
        assert sorted(run_units(executor, run, range(45))) == list(range(45))
    assert sorted(units) == [5, RUNS_OF_UNIT, RUNS_OF_UNIT]


def _die(_: object) -> list[int]:
    os.kill(os.getpid(), signal.SIGKILL)
    return []


def test_a_dead_worker_that_nothing_replaces_is_an_error_of_one_line():
    with ProcessPoolExecutor(1, get_context("spawn")) as executor, pytest.raises(WorkerError, match="worker has ended"):
        list(run_units(executor, _die, [1]))


def test_rows_of_a_worker_with_other_versions_are_refused(monkeypatch: pytest.MonkeyPatch):
    real = sweep_module.run_on_simulator
    monkeypatch.setattr(sweep_module, "run_on_simulator", lambda s: replace(real(s), versions="numpy 1.0", host="far"))
    with ThreadPoolExecutor(1) as executor, pytest.raises(WorkerError, match="worker on far has numpy"):
        dsse.compare("industrial13", strategies=["information"], executor=executor)


def test_a_row_of_other_versions_in_the_table_is_refused_with_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    options = [*STUDY, "--seeds", "1", "--out", str(tmp_path / "s"), "--jobs", "1"]
    assert run_command(options) == 0
    path = tmp_path / "s" / "sweep.csv"
    path.write_text(path.read_text().replace("numpy ", "numpy 0.", 1))
    assert run_command(options) == 2
    assert "line 2 is a row of" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "dask://127.0.0.1", "slurm://x:1"])
def test_an_executor_of_another_form_is_refused(address: str):
    with pytest.raises(InvalidInputError, match="give dask://HOST:PORT"), open_executor(address):
        pass


def test_a_comparison_side_by_side_has_the_rows_of_one_after_the_other():
    scenario = choose_scenario("industrial13", None)
    names = ("admm", "angle-offset", "information")
    content = hash_scenario(scenario)
    alone = [sweep_module.run_on_simulator(replace(scenario, strategy=name)) for name in names]
    assert sweep_module.compare_side_by_side(scenario, names) == tuple(
        replace(row, scenario_sha256=content) for row in alone
    )
