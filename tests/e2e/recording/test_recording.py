"""Recordings of real processes: nothing is missing, kill -9 loses the end at most, and a replay agrees."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from agents.security.access import PLANT
from coordinator.watch.recording.folder import LOGS
from coordinator.watch.replay.ticks import read_ticks
from tests.support.dsse_command import ENVIRONMENT, ROOT
from tests.support.levels import SECURED_FURTHER
from tests.support.system_by_hand import SystemByHand, Watcher, prepare_by_hand
from tests.support.waiting import wait_until

Dsse = Callable[..., subprocess.CompletedProcess[str]]
DEADLINE_S = 600.0
SCANS = 6
LIMIT = ("--timeout", str(DEADLINE_S))
AREAS = ("area1", "area2")


@pytest.fixture
def recording(dsse: Dsse, tmp_path: Path) -> Path:
    """Of industrial13 from its first scan on."""
    endpoint, _ = prepare_by_hand(dsse, secured=False)
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        where = "--connect", endpoint
        system.start("recorder", "record", "industrial13", *where, "--run", "industrial13", "--out", "rec")
        wait_until(lambda: any((tmp_path / "rec" / LOGS).glob("*.log")))
        for name in AREAS:
            system.start(name, "agent", f"areas/{name}.toml")
        with Watcher("industrial13", [endpoint]) as watcher:
            watcher.wait_until(lambda: len(watcher.states) == len(AREAS))
            system.start(PLANT, "plant", "industrial13", *where, "--every", "0.5")
            watcher.wait_for_consensus()
            seen: set[int] = set()
            watcher.wait_until(lambda: seen.update(s.header.scan for s in watcher.states.values()) or len(seen) > SCANS)
        for name in (PLANT, *AREAS, "recorder"):
            assert system.end(name) == 0, system.read_log(name)
    return tmp_path / "rec"


def test_a_recording_of_processes_is_whole_and_plays_back(dsse: Dsse, recording: Path) -> None:
    notes: list[str] = []
    ticks = list(read_ticks(recording, notes))
    assert not notes
    assert len(ticks) >= SCANS
    assert [tick.readings.keys() >= tick.estimates.keys() for tick in ticks] == [True] * len(ticks)
    assert not list((recording / LOGS).iterdir())  # the recorder has closed what it has written
    on_simulator = dsse("replay", recording)
    assert on_simulator.returncode == 0, on_simulator.stdout + on_simulator.stderr
    assert "to the bit" in on_simulator.stdout
    on_processes = dsse("replay", recording, "--processes", "--speed", "20")
    assert on_processes.returncode == 0, on_processes.stdout + on_processes.stderr
    assert "played on processes" in on_processes.stdout


@pytest.mark.parametrize("secured", SECURED_FURTHER)
def test_a_run_with_a_record_table_leaves_its_recording(dsse: Dsse, secured: bool) -> None:
    done = dsse("run", "ieee33", "--set", "record={}", "--out", "run", *LIMIT, "--no-plots", *["--secure"] * secured)
    assert done.returncode == 0, done.stderr
    played = dsse("replay", "run/recording")
    assert played.returncode == 0, played.stdout + played.stderr
    assert "3 good states compared" in played.stdout
    assert "to the bit" in played.stdout


def test_kill_9_of_the_recorder_loses_the_end_at_most_and_it_goes_on(tmp_path: Path) -> None:
    """How long that end is, a second at most, depends on the machine: the benchmark alone complains of that."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.recorder_kills", "--kills", "2", "--out", str(tmp_path)],
        cwd=ROOT,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    seen = json.loads(done.stdout)
    assert seen["kills"] == 2
    assert seen["scans of areas while a recorder ran"] > 0
    for fault in ("messages lost before one that was not", "damaged logs", "notes of closing", "ended unasked"):
        assert not seen[fault], done.stdout + done.stderr


def test_a_folder_of_another_run_is_one_clear_error(dsse: Dsse, tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "recording.json").write_text('{"format": 1, "run": "other", "areas": []}')
    done = dsse("replay", "rec")
    assert done.returncode == 2
    assert "give the scenario of the split: dsse replay FOLDER SCENARIO" in done.stderr
    assert "Traceback" not in done.stderr
