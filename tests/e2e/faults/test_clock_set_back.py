"""An agent that is started again while its host's clock is behind: real processes, whose clocks are moved by Python."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.support.system_by_hand import SystemByHand, Watcher, agreeing_system

MOVED_CLOCK = """
import os, time
now, now_ns, behind_s = time.time, time.time_ns, int(os.environ["BEHIND_S"])
time.time = lambda: now() - behind_s
time.time_ns = lambda: now_ns() - behind_s * 10**9
"""


@pytest.fixture
def behind(tmp_path: Path):
    """``prefix`` of a command whose clock is so many seconds behind."""
    (tmp_path / "moved").mkdir()
    (tmp_path / "moved" / "sitecustomize.py").write_text(MOVED_CLOCK)
    return lambda seconds: ["env", f"PYTHONPATH={tmp_path / 'moved'}", f"BEHIND_S={seconds}"]


@pytest.fixture
def system(dsse, tmp_path: Path):
    """industrial13, whose areas agree, and its watcher; area2 has just been killed."""
    with agreeing_system(dsse, tmp_path) as (system, watcher, _, _):
        system.end("area2", signal.SIGKILL)
        yield system, watcher


def test_five_minutes_behind_its_former_incarnation_it_is_received_again(system: tuple[SystemByHand, Watcher], behind):
    processes, watcher = system
    former = watcher.states["area2"].header.incarnation
    processes.start("area2", "agent", "areas/area2.toml", prefix=behind(300))
    watcher.wait_until(lambda: watcher.states["area2"].header.incarnation < former)
    gap = watcher.wait_for_consensus()
    assert gap.vm_pu is not None
    assert gap.vm_pu <= 1e-8


def test_an_hour_behind_it_says_that_its_clock_may_be_and_the_others_go_on(
    system: tuple[SystemByHand, Watcher], behind
):
    processes, watcher = system
    processes.start("area2", "agent", "areas/area2.toml", prefix=behind(3600))
    watcher.wait_until(lambda: any("clock" in note for note in watcher.states["area2"].notes))
    assert watcher.states["area2"].quality != "good"
    watcher.wait_until(lambda: watcher.states["area1"].quality in ("degraded", "relative-angle"))
    assert watcher.states["area1"].buses
    assert processes.processes["area1"].poll() is None
