"""What many areas go through is gone through once before they are forked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from agents.strategies.installed import list_strategies
from coordinator.lab.process_run.rehearsal import AREAS, LARGEST, rehearse
from tests.support.levels import further

LATE_IMPORTS = f"""
import sys, threading
import agents.__main__, coordinator.lab.plant.plant
from agents.runtime.warm_up import warm_up
from coordinator.lab.process_run.rehearsal import rehearse

warm_up()
assert rehearse("information", {LARGEST})
before = set(sys.modules)
assert rehearse("information", {LARGEST} - 7)
assert threading.active_count() == 1
print(sorted(set(sys.modules) - before))
"""

KILLED = """
rehearsal.load_area_file = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
rehearsal.rehearse("information", 12)
"""


@pytest.mark.parametrize("n_bus", [1, *further(12, 45), 500])
def test_a_rehearsal_that_does_not_reach_the_estimate_would_leave_code_that_never_ran(n_bus: int):
    assert rehearse("information", n_bus) == dict.fromkeys(AREAS, "good")


@pytest.mark.parametrize("strategy", sorted(list_strategies()))
def test_areas_of_every_strategy_publish_a_state_in_the_rehearsal(strategy: str):
    assert set(rehearse(strategy, 12)) == set(AREAS)


def test_a_strategy_that_fails_in_the_rehearsal_does_not_end_the_parent_of_all_processes():
    assert rehearse("no such strategy", 12) == {}


def test_a_rehearsal_removes_what_a_killed_one_has_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    killed = f"import os, signal\nfrom coordinator.lab.process_run import rehearsal\n{KILLED}"
    done = subprocess.run([sys.executable, "-c", killed], env={**os.environ, "TMPDIR": str(tmp_path)}, check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    assert rehearse("information", 12)
    assert list(tmp_path.iterdir()) == []


def test_what_has_been_rehearsed_imports_nothing_late_and_leaves_no_thread():
    done = subprocess.run([sys.executable, "-c", LATE_IMPORTS], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr
