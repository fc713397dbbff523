"""Where the machine gives no more: one clear error, and no result is lost."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from coordinator.watch.observe.event_log import EventLog
from tests.support.dsse_command import COMMAND, WITH_LIMITS
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S


def run_limited(folder: Path, limit: int, value: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``dsse run`` in ``folder``, whose processes may have no more than ``value`` of ``limit``."""
    return subprocess.run(
        [*COMMAND, "run", *arguments, "--no-plots", "--timeout", str(DEADLINE_S)],
        cwd=folder,
        env=WITH_LIMITS,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
    )


def test_a_run_whose_events_no_longer_fit_on_the_disk_still_ends_with_its_verdict(tmp_path: Path):
    many_events = ("--strategy", "admm", "--set", "faults.delay_ms=10", "--set", "faults.jitter_ms=300")
    done = run_limited(tmp_path, resource.RLIMIT_FSIZE, 9500, "industrial13", "--out", "out", *many_events)
    assert done.returncode == 2
    assert done.stdout.startswith("consensus after ")
    assert "error: files of the run are missing: out/events.jsonl: File too large; make room there" in done.stderr
    assert json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]["consensus"] is True


def test_a_run_folder_without_room_for_the_area_files_is_rejected(tmp_path: Path):
    done = run_limited(tmp_path, resource.RLIMIT_FSIZE, 1000, "ieee33", "--out", "out")
    assert done.returncode == 2
    assert "File too large; choose another place, or make room there" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("room", [0, *further(300)])
def test_a_router_without_room_for_its_first_words_is_no_traceback(tmp_path: Path, room: int):
    done = run_limited(tmp_path, resource.RLIMIT_FSIZE, room, "ieee33", "--out", "out")
    assert done.returncode == 2
    assert "make room" in done.stderr or "is the disk full?" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Mount a disk of so many KiB, where the system allows it."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(kib: int) -> Path:
        options = ["-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(folder)]
        if (
            not shutil.which("mount")
            or subprocess.run(["mount", *options], capture_output=True, check=False).returncode
        ):
            pytest.skip("nothing can be mounted here; it takes root")
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("kib", [4, *further(12)])
def test_a_tiny_disk_is_one_error_and_no_traceback(small_disk: Callable[[int], Path], tmp_path: Path, kib: int):
    done = run_limited(tmp_path, resource.RLIMIT_CORE, 0, "ieee33", "--out", str(small_disk(kib) / "out"))
    assert done.returncode == 2
    assert "make room" in done.stderr or "is the disk full?" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_too_few_open_files_for_the_links_of_all_areas_are_reported_before_anything_starts(tmp_path: Path):
    done = run_limited(tmp_path, resource.RLIMIT_NOFILE, 30, "ieee33", "--out", "out")
    assert done.returncode == 2
    assert "a process may open 30 files here, and 3 areas need 35; raise the limit (ulimit -n 35)" in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a device that is always full")
def test_an_event_log_on_a_full_disk_goes_on_and_says_why_it_is_not_complete():
    with EventLog(Path("/dev/full"), 0.0) as events:
        events.write("something happened", 1.0)
        events.write("something else happened", 2.0)
    assert events.failure == "/dev/full: No space left on device"
