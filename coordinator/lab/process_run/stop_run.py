"""``dsse stop``: ends the processes that are left of a run whose coordinator is gone."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coordinator.lab.process_run.fork_server import MODULE, STOP_ALL_S, STOP_S
from coordinator.watch.run_folder import EVENTS, PARTS, describe_missing
from dsse_core import operating_system
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.drafts import remove_leftovers

PROC = Path("/proc")
SPARE_S = 2.0  # added to the time that a process has for its end
RUN_FOLDER = "give the run folder of `dsse run`"
MARK = re.compile("[0-9a-f]{16}")


class StopError(DsseError):
    """Processes of a run could not be ended."""


@dataclass(frozen=True, slots=True)
class StartedRun:
    """The processes of a run, from its run folder. ``mark``: last word of the command line of each process."""

    id: str
    parent_pid: int
    mark: str


def stop_run(folder: Path) -> tuple[StartedRun | None, int]:
    """Ends the processes on this host that are left of the run in ``folder``. Returns the run and their count.

    The run is None if it was killed before it started a process. The parent of all processes gets SIGTERM, and stops
    them in order. Processes left after its time get SIGTERM themselves, then SIGKILL. Processes are identified by their
    command lines, because another process may have their id by now. Unfinished files of the coordinator are removed.

    Raises:
        InvalidInputError: ``folder`` is not that of a run of processes.
        StopError: processes are still running.
    """
    if _is_of_no_process(folder):
        return None, 0
    run = read_started_run(folder)
    found = set(find_marked(run.mark))
    if run.parent_pid in found:
        _send([run.parent_pid], signal.SIGTERM)
        _wait_for_end(run, STOP_ALL_S + SPARE_S)
    for number, wait_s in ((signal.SIGTERM, STOP_S), (operating_system.KILL, SPARE_S)):
        left = set(find_marked(run.mark))
        _send(left, number)
        found |= left
        _wait_for_end(run, wait_s)
    if still := sorted(find_marked(run.mark)):
        numbers = ", ".join(map(str, still))
        raise StopError(f"processes of run {run.id} are still there: {numbers}; stop it as the user that started it")
    for place in (folder, *(folder / part for part in PARTS)):
        remove_leftovers(place)
    return run, len(found)


def _is_of_no_process(folder: Path) -> bool:
    """True where ``folder`` is that of a run killed before its first event, and so before its first process."""
    try:
        entries = list(folder.iterdir())
        log = folder / EVENTS
        begun = log in entries and not (log.is_file() and log.stat().st_size == 0)  # a device has no size
        return (
            bool(entries) and not begun and all(e == log or (e.name in PARTS and not any(e.iterdir())) for e in entries)
        )
    except OSError:
        return False  # the error is reported when the log is read


def read_started_run(folder: Path) -> StartedRun:
    """The run of the run folder ``folder``, from the first line of its ``events.jsonl``.

    Raises:
        InvalidInputError: the folder cannot be read, or is not that of a run of processes.
    """
    path = folder / EVENTS
    if missing := describe_missing(folder, EVENTS):
        raise InvalidInputError(f"run folder {folder}", [f"{missing}; {RUN_FOLDER}"])
    try:
        event: dict[str, Any] = parse_json((read_text(path).splitlines() or [""])[0])
        run = StartedRun(str(event["run"]), int(event["parent_pid"]), str(event["mark"]))
    except (ValueError, KeyError, TypeError):
        run = None
    if run is None or not MARK.fullmatch(run.mark):
        problem = f"does not begin with the start of a run of processes; {RUN_FOLDER}"
        raise InvalidInputError(str(path), [problem])
    return run


def find_marked(mark: str) -> Iterator[int]:
    """Process ids of the processes of the run of ``mark`` that run on this host: its parent and all children."""
    for pid, line in _command_lines():
        if f"-m {MODULE} " in line and line.endswith(f" {mark}"):
            yield pid


def has_processes(folder: Path) -> bool:
    """True where a process is still running of a run whose run folder lies in ``folder``."""
    for log in folder.glob(f"*/{EVENTS}"):
        with contextlib.suppress(InvalidInputError):  # before its first event, which no process precedes
            if any(find_marked(read_started_run(log.parent).mark)):
                return True
    return False


def _command_lines() -> Iterator[tuple[int, str]]:
    """Process id and command line of every process; the command line of a zombie is empty or in brackets."""
    if (PROC / "self" / "cmdline").exists():
        for folder in PROC.iterdir():
            if folder.name.isdigit():
                with contextlib.suppress(OSError):  # the process has ended meanwhile
                    words = (folder / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
                    yield int(folder.name), b" ".join(words).decode(errors="replace")
        return
    listed = subprocess.run(["ps", "-A", "-ww", "-o", "pid=", "-o", "args="], capture_output=True, check=True)
    for line in listed.stdout.decode(errors="replace").splitlines():
        pid, _, arguments = line.strip().partition(" ")
        yield int(pid), arguments.strip()


def _send(pids: Collection[int], number: int) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # named in the error at the end
            os.kill(pid, number)
            operating_system.go_on(pid)  # a paused process could not handle the signal


def _wait_for_end(run: StartedRun, wait_s: float) -> None:
    deadline = time.monotonic() + wait_s
    while any(find_marked(run.mark)) and time.monotonic() < deadline:
        time.sleep(0.02)
