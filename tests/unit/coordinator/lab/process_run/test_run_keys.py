"""Private keys of a run do not outlast its processes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from coordinator.lab.process_run.processes import Launcher
from coordinator.lab.process_run.run_keys import folder_of_keys, remove_keys_of_dead_runs

HOLDER = """
import sys, time
from coordinator.lab.process_run.run_keys import folder_of_keys
with folder_of_keys(sys.argv[1]):
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def kill_a_run_with_keys(mark: str) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER, mark], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.kill()


def test_keys_of_a_killed_run_are_removed_by_the_next_one(temporary: Path) -> None:
    kill_a_run_with_keys("0123456789abcdef")
    (left,) = temporary.iterdir()
    assert left.name.startswith("dsse-keys-0123456789abcdef-")
    with folder_of_keys("fedcba9876543210") as folder:
        assert list(temporary.iterdir()) == [folder]
    assert list(temporary.iterdir()) == []


def test_keys_are_not_taken_from_processes_that_outlive_the_coordinator(temporary: Path) -> None:
    with Launcher() as launcher:
        kill_a_run_with_keys(launcher.mark)
        remove_keys_of_dead_runs()
        assert len(list(temporary.glob("dsse-keys-*"))) == 1
    remove_keys_of_dead_runs()
    assert list(temporary.glob("dsse-keys-*")) == []
