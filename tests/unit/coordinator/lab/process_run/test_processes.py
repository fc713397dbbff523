"""The warmed parent: processes start, their end is reported, and none is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from coordinator.lab.process_run.fork_server import IO_ERROR_CODE, Ended, Started
from coordinator.lab.process_run.processes import Launcher, LaunchError, describe_end, read_end
from coordinator.watch.observe.updates import Updates

DEADLINE_S = 180.0


def take_until(updates: Updates, kind: type, name: str):
    """The first ``kind`` of updates about process ``name``."""
    return take_all(updates, kind, name)[name]


def take_all(updates: Updates, kind: type, *names: str):
    """Name -> the first ``kind`` of updates about it, however the updates came together."""
    deadline = time.monotonic() + DEADLINE_S
    found = {}
    while not found.keys() >= set(names):
        assert time.monotonic() < deadline, f"no {kind.__name__} of {set(names) - found.keys()} within {DEADLINE_S} s"
        found |= {item.name: item for item in updates.take(0.1) if isinstance(item, kind) and item.name not in found}
    return found


def is_gone(pid: int) -> bool:
    """Whether the process ends within the deadline; one that init has not collected yet counts as gone."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.01)
    return False


def test_a_process_runs_its_target_with_its_output_in_its_log(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "builtins:print", "hello", log=tmp_path / "one.log")
        assert take_until(updates, Ended, "one").code == 0
    assert read_end(tmp_path / "one.log") == "hello"


def test_an_exception_ends_in_the_log_and_in_exit_code_1(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "builtins:int", "no number", log=tmp_path / "one.log")
        assert take_until(updates, Ended, "one").code == 1
    assert "ValueError" in read_end(tmp_path / "one.log")


def test_a_process_that_cannot_write_its_log_ends_without_a_traceback_and_is_no_second_parent(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    updates, tmp = Updates(), tmp_path / "no folder" / "two.log"
    with Launcher(updates.put) as launcher:
        launcher.start("one", "builtins:print", "hello", log=Path("/dev/full"))
        launcher.start("two", "builtins:print", "hello", log=tmp)
        codes = {name: ended.code for name, ended in take_all(updates, Ended, "one", "two").items()}
        assert psutil.Process(launcher.pid).children() == []
        launcher.start("three", "builtins:print", "hello", log=tmp_path / "three.log")
        assert take_until(updates, Ended, "three").code == 0
    assert codes == {"one": IO_ERROR_CODE, "two": IO_ERROR_CODE}
    assert "is the disk full?" in describe_end(IO_ERROR_CODE)
    output = capfd.readouterr().err
    assert "Traceback" not in output
    assert f"error: {tmp}: No such file or directory" in output


def test_the_exit_code_of_a_process_is_reported(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "sys:exit", 7, log=tmp_path / "one.log")
        launcher.start("two", "builtins:int", 5, log=tmp_path / "two.log")
        codes = {}
        while len(codes) < 2:
            codes |= {item.name: item.code for item in updates.take(DEADLINE_S) if isinstance(item, Ended)}
    assert codes == {"one": 7, "two": 5}


def test_a_nice_process_gives_way_to_the_others(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("usual", "os:nice", 0, log=tmp_path / "usual.log")
        launcher.start("nice", "os:nice", 0, log=tmp_path / "nice.log", nice=3)
        niceness = {name: ended.code for name, ended in take_all(updates, Ended, "usual", "nice").items()}
    assert niceness == {"usual": os.nice(0), "nice": min(os.nice(0) + 3, 19)}


def test_a_killed_process_is_reported_with_its_signal(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "time:sleep", 3600, log=tmp_path / "one.log")
        os.kill(take_until(updates, Started, "one").pid, signal.SIGKILL)
        assert describe_end(take_until(updates, Ended, "one").code) == "signal SIGKILL"


def test_leaving_the_block_stops_all_processes(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        for name in ("one", "two"):
            launcher.start(name, "time:sleep", 3600, log=tmp_path / f"{name}.log")
        pids = [started.pid for started in take_all(updates, Started, "one", "two").values()]
    assert all(is_gone(pid) for pid in [*pids, launcher.pid])


def start_deaf(launcher: Launcher, updates: Updates, folder: Path) -> int:
    """The pid of a process that ignores SIGTERM, once it does."""
    ignore = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf'); time.sleep(3600)"
    launcher.start("deaf", "builtins:exec", ignore, log=folder / "deaf.log")
    pid = take_until(updates, Started, "deaf").pid
    deadline = time.monotonic() + DEADLINE_S
    while read_end(folder / "deaf.log") != "deaf" and time.monotonic() < deadline:
        updates.take(0.02)
    return pid


def test_a_process_that_ignores_sigterm_is_killed(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        pid = start_deaf(launcher, updates, tmp_path)
    assert is_gone(pid)


def test_an_exception_in_the_block_leaves_nothing_behind(tmp_path: Path):
    updates = Updates()
    with pytest.raises(RuntimeError, match="mine"), Launcher(updates.put) as launcher:  # noqa: PT012
        launcher.start("one", "time:sleep", 3600, log=tmp_path / "one.log")
        pid = take_until(updates, Started, "one").pid
        raise RuntimeError("mine")
    assert is_gone(pid)
    assert is_gone(launcher.pid)


def test_the_end_of_the_parent_is_reported_and_its_children_are_stopped(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "time:sleep", 3600, log=tmp_path / "one.log")
        pid = take_until(updates, Started, "one").pid
        os.kill(launcher.pid, signal.SIGKILL)
        assert take_until(updates, Ended, "parent of all processes").code == -signal.SIGKILL
        with pytest.raises(LaunchError, match="SIGKILL"):
            launcher.start("two", "time:sleep", 3600, log=tmp_path / "two.log")
    assert is_gone(pid)


def test_a_launcher_that_started_nothing_closes_at_once():
    with Launcher() as launcher:
        launcher.preload("json", "time:monotonic")
    assert is_gone(launcher.pid)


def test_an_order_to_a_process_that_is_not_ready_for_it_waits_and_does_not_end_it(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        launcher.start("one", "signal:sigwait", {signal.SIGUSR1}, log=tmp_path / "one.log")
        launcher.signal("one", signal.SIGUSR1)  # long before it waits for it
        assert take_until(updates, Ended, "one").code == signal.SIGUSR1


def test_a_process_that_ignores_sigterm_does_not_outlive_its_killed_parent(tmp_path: Path):
    updates = Updates()
    with Launcher(updates.put) as launcher:
        pid = start_deaf(launcher, updates, tmp_path)
        os.kill(launcher.pid, signal.SIGKILL)
        assert is_gone(pid)  # inside the block: on leaving it the launcher would kill the group


COORDINATOR = """
import os, signal, sys
from pathlib import Path
from coordinator.lab.process_run.fork_server import Started
from coordinator.lab.process_run.processes import Launcher
from coordinator.watch.observe.updates import Updates

updates = Updates()
launcher = Launcher(updates.put, bound=sys.argv[1] == "bound")
launcher.start("one", "time:sleep", 600, log=Path(os.devnull))
started = [item.pid for item in updates.take(60.0) if isinstance(item, Started)]
print(launcher.pid, *started, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("bound", [True, False])
def test_only_processes_that_are_bound_end_with_a_killed_coordinator(bound: bool):
    how = "bound" if bound else "free"
    done = subprocess.run([sys.executable, "-c", COORDINATOR, how], capture_output=True, text=True, check=False)
    parent, child = map(int, done.stdout.split())
    if not bound:
        assert psutil.Process(child).status() != psutil.STATUS_ZOMBIE
        os.kill(parent, signal.SIGTERM)
    assert is_gone(parent)
    assert is_gone(child)
