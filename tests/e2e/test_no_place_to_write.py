"""Where a command cannot write: one clear error, and nothing half-written."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from dsse_command import COMMAND, ENVIRONMENT, ROOT
from waiting import DEADLINE_S

NOBODY = 65534
CASE = str(ROOT / "tests" / "data" / "feeder.m")
COMMANDS = {
    "import": ["import", "feeder.m", "--out"],
    "generate": ["generate", "--buses", "40", "--out"],
    "split": ["split", "ieee33", "--out"],
    "keys": ["keys", "create", "ieee33", "--out"],
    "sweep": ["sweep", "ieee33", "--vary", "seed=1,2", "--seeds", "1", "--strategies", "information", "--out"],
    "compare": ["compare", "ieee33", "--strategies", "information", "--out"],
    "simulate": ["simulate", "ieee33", "--no-plots", "--out"],
    "run": ["run", "ieee33", "--no-plots", "--out"],
}
LEAVES_NOTHING = ("import", "generate", "split", "keys")
FEEDER = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [ 1 3 0 0 0 0 1 1 0 20 1 1.1 0.9; 2 1 1.5 0.3 0 0 1 1 0 20 1 1.1 0.9 ];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [ 1 2 0.01 0.02 0 0 0 0 0 0 1 ];
"""


def run_there(
    folder: Path, arguments: list[str], prepare: Callable[[], None], **environment: str
) -> subprocess.CompletedProcess[str]:
    (folder / "feeder.m").write_text(FEEDER)
    return subprocess.run(
        [*COMMAND, *arguments],
        cwd=folder,
        env=ENVIRONMENT | environment,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        preexec_fn=prepare,
    )


def check_one_error(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert done.stderr.count("error: ") == 1, done.stderr
    assert "another place" in done.stderr or "make room" in done.stderr or "disk full" in done.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_is_one_error_and_leaves_nothing_half_written(tmp_path: Path, command: str) -> None:
    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (250, 250))

    done = run_there(tmp_path, [*COMMANDS[command], "deep/out"], fill)
    check_one_error(done)
    if command in LEAVES_NOTHING:
        assert [path.name for path in tmp_path.iterdir()] == ["feeder.m"]


@pytest.mark.skipif(os.geteuid() != 0, reason="to become another user takes root")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_cannot_be_written_is_one_error(open_folder: Path, command: str) -> None:
    (open_folder / "locked").mkdir(mode=0o755)
    done = run_there(open_folder, [*COMMANDS[command], "locked/out"], become_nobody)
    check_one_error(done)
    assert "locked/out" in done.stderr
    assert list((open_folder / "locked").iterdir()) == []


def become_nobody() -> None:
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
