"""Where a command cannot write: one clear error, and nothing half-written."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.dsse_command import COMMAND, WITH_LIMITS
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S

NOBODY = 65534
CAN_DROP = os.geteuid() != 0 or shutil.which("setpriv") is not None
SMALL = ["--seeds", "1", "--strategies", "information", "--jobs", "1"]
COMMANDS = {
    "import": ["import", "feeder.m", "--out"],
    "generate": ["generate", "--buses", "40", "--out"],
    "split": ["split", "ieee33", "--out"],
    "keys": ["keys", "create", "ieee33", "--out"],
    "sweep": ["sweep", "ieee33", "--vary", "faults.loss=0,0.1", *SMALL, "--out"],
    "compare": ["compare", "ieee33", "--strategies", "information", "--out"],
    "simulate": ["simulate", "ieee33", "--no-plots", "--out"],
    "run": ["run", "ieee33", "--no-plots", "--out"],
}
FEW = ("import", "sweep", "run")
LEAVES_NOTHING = ("import", "generate", "split", "keys")
FEEDER = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [ 1 3 0 0 0 0 1 1 0 20 1 1.1 0.9; 2 1 1.5 0.3 0 0 1 1 0 20 1 1.1 0.9 ];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [ 1 2 0.01 0.02 0 0 0 0 0 0 1 ];
"""


def lock(folder: Path) -> None:
    """Make a folder that only another user may write, or that nobody may where we are nobody special."""
    folder.mkdir(mode=0o555)
    if os.geteuid() == 0:
        os.chown(folder, NOBODY, NOBODY)


def run_there(
    folder: Path,
    arguments: list[str],
    prepare: Callable[[], None] | None = None,
    *,
    kept_out: bool = False,
    without_home: bool = False,
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """``dsse`` in ``folder``; ``kept_out``: without root's right to write everywhere."""
    (folder / "feeder.m").write_text(FEEDER)
    without = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search,-fowner"]
    variables = WITH_LIMITS | environment
    if without_home:
        del variables["HOME"]
    return subprocess.run(
        [*(without if kept_out and os.geteuid() == 0 else []), *COMMAND, *arguments],
        cwd=folder,
        env=variables,
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


@pytest.mark.parametrize("command", [*FEW, "keys", *further("generate", "split", "compare", "simulate")])
def test_a_full_disk_is_one_error_and_leaves_nothing_half_written(tmp_path: Path, command: str) -> None:
    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (250, 250))

    done = run_there(tmp_path, [*COMMANDS[command], "deep/out"], fill)
    check_one_error(done)
    if command in LEAVES_NOTHING:
        assert done.stderr.startswith("error: deep/out: File too large; ")
        assert [path.name for path in tmp_path.iterdir()] == ["feeder.m"]


@pytest.mark.skipif(not CAN_DROP, reason="to be kept out of a folder, root needs setpriv")
@pytest.mark.parametrize("command", ["import", *further(*(name for name in COMMANDS if name != "import"))])
def test_a_folder_that_cannot_be_written_is_one_error(tmp_path: Path, command: str) -> None:
    lock(tmp_path / "locked")
    done = run_there(tmp_path, [*COMMANDS[command], "locked/out"], kept_out=True)
    check_one_error(done)
    assert "locked/out" in done.stderr
    assert list((tmp_path / "locked").iterdir()) == []


@pytest.mark.skipif(not CAN_DROP, reason="to be kept out of a folder, root needs setpriv")
def test_compiled_code_that_can_be_kept_nowhere_is_one_error(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    lock(tmp_path / "locked")
    done = run_there(tmp_path, ["compile"], kept_out=True, NUMBA_CACHE_DIR=str(tmp_path / "locked" / "out"))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert str(tmp_path / "locked") in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(not CAN_DROP, reason="to be kept out of a folder, root needs setpriv")
@pytest.mark.parametrize("home", ["", *further("locked", "nowhere")])
def test_without_a_home_that_can_be_written_a_run_is_as_ever(tmp_path: Path, home: str) -> None:
    lock(tmp_path / "locked")
    environment = {"HOME": str(tmp_path / home) if home else "", "TMPDIR": str(tmp_path / "nowhere")}
    plots = [] if home == "locked" else ["--no-plots"]  # without a home, finding the fonts takes 3 s
    run = ["run", "ieee33", "--out", "out", "--timeout", str(DEADLINE_S), *plots]
    done = run_there(tmp_path, run, kept_out=True, without_home=not home, **environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("consensus after ")
    assert "Traceback" not in done.stderr
    assert list((tmp_path / "locked").iterdir()) == []


def test_a_folder_that_another_run_uses_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "out" / "areas").mkdir(parents=True)
    (tmp_path / "out" / "events.jsonl").write_text("{}")
    done = run_there(tmp_path, ["run", "ieee33", "--out", "out"])
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "error: run folder out: 1 problem\n  - is not empty; choose a new one, or remove its content\n"
    )


@pytest.mark.parametrize("room", [5_000, *further(12_000)])
def test_a_full_disk_leaves_no_part_of_any_file_of_a_run(tmp_path: Path, room: int) -> None:
    """The verdict is there, each table is complete or missing, every line of events is one."""

    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    done = run_there(tmp_path, ["simulate", "ieee33", "--out", "out"], fill)
    check_one_error(done)
    assert "out/" in done.stderr  # which file
    for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines():
        json.loads(line)
    assert json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]["consensus"] is True
    rows = {path.stem: len(path.read_text().splitlines()) - 1 for path in (tmp_path / "out").glob("*.csv")}
    assert rows.items() <= {"buses": 33, "branches": 37, "areas": 3}.items()
    assert {path.suffix for path in (tmp_path / "out").iterdir()} <= {".jsonl", ".json", ".csv"}


@pytest.mark.parametrize("closed", [*further((1,), (2,)), (0, 1, 2)])
@pytest.mark.parametrize(
    "command", [["simulate", "ieee33", "--no-plots", "--out", "out"], *further(["check", "ieee33"])]
)
def test_closed_standard_streams_end_no_command(tmp_path: Path, command: list[str], closed: tuple[int, ...]) -> None:
    done = subprocess.run(
        [*COMMAND, *command],
        cwd=tmp_path,
        env=WITH_LIMITS,
        stdout=None if 1 in closed else subprocess.PIPE,
        stderr=None if 2 in closed else subprocess.PIPE,
        timeout=DEADLINE_S,
        check=False,
        preexec_fn=lambda: [os.close(number) for number in closed] and None,
    )
    assert (done.returncode, done.stderr or b"") == (0, b"")
    if command[0] == "simulate":
        for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines():
            json.loads(line)  # nothing that was said has come into a file
        assert (tmp_path / "out" / "result.json").exists()
