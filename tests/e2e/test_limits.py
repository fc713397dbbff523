"""Where the machine gives no more: one clear error, and no result is lost."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from dsse_command import COMMAND, ENVIRONMENT
from waiting import DEADLINE_S

from coordinator.events import EventLog


def run_limited(folder: Path, limit: int, value: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``dsse run`` in ``folder``, whose processes may have no more than ``value`` of ``limit``."""
    return subprocess.run(
        [*COMMAND, "run", *arguments, "--no-plots"],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
    )


def test_a_run_whose_events_no_longer_fit_on_the_disk_still_ends_with_its_verdict(tmp_path: Path):
    done = run_limited(tmp_path, resource.RLIMIT_FSIZE, 5000, "ieee33-lossy", "--out", "out")  # its area files just fit
    assert done.returncode == 2
    assert done.stdout.startswith("consensus after ")
    assert "error: files of the run are missing: out/events.jsonl: File too large; make room there" in done.stderr
    assert json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]["consensus"] is True


def test_a_run_folder_without_room_for_the_area_files_is_refused(tmp_path: Path):
    done = run_limited(tmp_path, resource.RLIMIT_FSIZE, 1000, "ieee33", "--out", "out")
    assert done.returncode == 2
    assert "File too large; choose another place, or make room there" in done.stderr
    assert "Traceback" not in done.stderr


def test_too_few_open_files_for_the_links_of_all_areas_are_told_before_anything_starts(tmp_path: Path):
    done = run_limited(tmp_path, resource.RLIMIT_NOFILE, 30, "ieee33", "--out", "out")
    assert done.returncode == 2
    assert "a process may open 30 files here, and 3 areas need 35; raise the limit (ulimit -n 35)" in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a device that is always full")
def test_an_event_log_on_a_full_disk_goes_on_and_says_why_it_is_not_complete():
    with EventLog(Path("/dev/full"), 0.0) as events:
        events.write("something happened", 1.0)
        events.write("something else happened", 2.0)
    assert events.failure == "/dev/full: No space left on device"
