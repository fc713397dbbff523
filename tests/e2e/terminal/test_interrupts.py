"""Ctrl-C and SIGTERM at any moment of a command: one word, no traceback, and a verdict that was given stands."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from dsse_core.files.drafts import DRAFT
from tests.support.dsse_command import COMMAND, ENVIRONMENT
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S

LIMIT = ("--timeout", str(DEADLINE_S))
INTERRUPT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPT_AT"] and os.environ["INTERRUPTED"] in sys.orig_argv:
            os.kill(os.getpid(), int(os.environ["INTERRUPT_BY"]))
sys.meta_path.insert(0, Finder())
"""


@pytest.fixture
def interrupted_at(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run ``dsse`` with a signal that reaches it while it imports a module; its run folder, if any, is ``out``."""
    (tmp_path / "hook").mkdir()
    (tmp_path / "hook" / "sitecustomize.py").write_text(INTERRUPT)
    path = os.pathsep.join([str(tmp_path / "hook"), ENVIRONMENT["PYTHONPATH"]])

    def run(
        module: str, *arguments: str, number: signal.Signals = signal.SIGINT, who: str = "coordinator"
    ) -> subprocess.CompletedProcess[str]:
        where = {"INTERRUPTED": who, "INTERRUPT_AT": module, "INTERRUPT_BY": str(int(number)), "PYTHONPATH": path}
        return subprocess.run(
            [*COMMAND, *arguments],
            cwd=tmp_path,
            env={**ENVIRONMENT, **where},
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )

    return run


@pytest.mark.parametrize(
    ("command", "module"),
    [
        ("check ieee33", "click"),
        pytest.param("check ieee33", "coordinator.cli.main", marks=pytest.mark.long),
        pytest.param("check ieee33", "numpy", marks=pytest.mark.long),
        pytest.param("check ieee33", "numpy._core.multiarray", marks=pytest.mark.long),
        ("check ieee33", "numpy._core._exceptions"),  # by compiled code, which makes an ImportError of it
        pytest.param("estimate ieee33", "scipy.sparse", marks=pytest.mark.long),
        ("agent areas/area1.toml", "agents.transport.zenoh_bus"),
        pytest.param("plant ieee33", "numpy", marks=pytest.mark.long),
        ("run ieee33 --out out", "coordinator.lab.process_run.run_scenario"),
        pytest.param("run ieee33 --out out", "numpy", marks=pytest.mark.long),
        pytest.param("run ieee33 --out out", "zenoh", marks=pytest.mark.long),
        pytest.param("run ieee33 --out out", "scenarios.telemetry", marks=pytest.mark.long),
    ],
)
def test_ctrl_c_while_modules_are_loaded_shows_no_traceback(interrupted_at, command: str, module: str):
    done = interrupted_at(module, *command.split())
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "interrupted")


@pytest.mark.long
def test_ctrl_c_while_workers_of_a_sweep_load_their_modules_is_left_to_the_command(interrupted_at):
    sweep = ["sweep", "ieee33", "--vary", "faults.loss=0:0.2:2", "--seeds", "1", "--strategies", "information"]
    sweep += ["--jobs", "2", "--out", "out"]
    done = interrupted_at("numpy", *sweep, who="--multiprocessing-fork")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, *further(signal.SIGTERM)])
def test_a_signal_after_the_verdict_does_not_change_the_exit_code(interrupted_at, number: signal.Signals):
    done = interrupted_at("matplotlib.figure", "run", "ieee33", "--out", "out", "--quiet", *LIMIT, number=number)
    assert done.stdout.startswith("consensus after")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGTERM, *further(signal.SIGINT)])
def test_a_signal_while_a_figure_is_written_leaves_no_part_of_it(
    interrupted_at, tmp_path: Path, number: signal.Signals
):
    options = ["--out", "out", "--quiet", "--format", "pdf"]
    done = interrupted_at("matplotlib.backends.backend_pdf", "simulate", "industrial13", *options, number=number)
    assert done.stdout.startswith("consensus after")
    assert (done.returncode, done.stderr) == (0, "")
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert "report.html" in left  # written before the figures
    assert not [name for name in left if name.startswith(DRAFT) or name.endswith(".pdf")]


def test_sigterm_when_the_interpreter_ends_does_not_change_the_exit_code(tmp_path: Path):
    """Where Python has given its signals back to the system, which would end the process with -15."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        "class AtTheEnd:\n"
        "    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.SIGTERM):\n"
        "        kill(pid, number)\n"
        "sys.kept_to_the_end = AtTheEnd()\n"
    )
    path = os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]])
    done = subprocess.run(
        [*COMMAND, "scenarios"],
        env={**ENVIRONMENT, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
