"""``dsse stop``: ends what is left of a run whose coordinator no longer does."""

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

from coordinator.process_run.fork_server import MODULE, STOP_ALL_S, STOP_S
from coordinator.run_folder import EVENTS, PARTS, describe_missing
from dsse_core import operating_system
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.drafts import remove_leftovers

PROC = Path("/proc")
SPARE_S = 2.0  # that a process may take longer than it is allowed to
RUN_FOLDER = "give the run folder of `dsse run`"
MARK = re.compile("[0-9a-f]{16}")


class StopError(DsseError):
    """Processes of a run could not be ended."""


@dataclass(frozen=True, slots=True)
class StartedRun:
    """What a run folder says of the processes of its run. ``mark``: stands in the command line of each."""

    id: str
    parent_pid: int
    mark: str


def stop_run(folder: Path) -> tuple[StartedRun | None, int]:
    """End what is left on this host of the run in ``folder``; the run, and how many processes that were.

    None for a run that was killed before it started a process. The parent of all is asked to stop all of them in order;
    what is left after its time is up is asked itself, and then killed. A process is known by its command line: its
    number may be another's by now. Files that its coordinator was writing are removed.

    Raises:
        InvalidInputError: ``folder`` is not that of a run of processes.
        StopError: processes are still there.
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
        raise StopError(f"processes of run {run.id} are still there: {numbers}; stop it as the user who started it")
    for place in (folder, *(folder / part for part in PARTS)):
        remove_leftovers(place)
    return run, len(found)


def _is_of_no_process(folder: Path) -> bool:
    """Whether ``folder`` is what a run leaves that was killed before its first event, which no process precedes."""
    try:
        entries = list(folder.iterdir())
        log = folder / EVENTS
        begun = log in entries and not (log.is_file() and log.stat().st_size == 0)  # a device has no size
        return (
            bool(entries) and not begun and all(e == log or (e.name in PARTS and not any(e.iterdir())) for e in entries)
        )
    except OSError:
        return False  # as is reported when the log is read


def read_started_run(folder: Path) -> StartedRun:
    """The run that ``folder`` is of, from the first line of its ``events.jsonl``.

    Raises:
        InvalidInputError: it cannot be read, or is not that of a run of processes.
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
    """Process ids of the living processes of this host that were forked for the run of ``mark``."""
    for pid, line in _command_lines():
        if f"-m {MODULE} " in line and line.endswith(f" {mark}"):
            yield pid


def has_processes(folder: Path) -> bool:
    """Whether processes of a run whose run folder lies in ``folder`` live."""
    for log in folder.glob(f"*/{EVENTS}"):
        with contextlib.suppress(InvalidInputError):  # before its first event, which no process precedes
            if any(find_marked(read_started_run(log.parent).mark)):
                return True
    return False


def _command_lines() -> Iterator[tuple[int, str]]:
    """Process id and command line of every process; of zombies it is empty or in brackets."""
    if (PROC / "self" / "cmdline").exists():
        for folder in PROC.iterdir():
            if folder.name.isdigit():
                with contextlib.suppress(OSError):  # it has ended meanwhile
                    words = (folder / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
                    yield int(folder.name), b" ".join(words).decode(errors="replace")
        return
    listed = subprocess.run(["ps", "-A", "-ww", "-o", "pid=", "-o", "args="], capture_output=True, check=True)
    for line in listed.stdout.decode(errors="replace").splitlines():
        pid, _, arguments = line.strip().partition(" ")
        yield int(pid), arguments.strip()


def _send(pids: Collection[int], number: int) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # another user's are named when they stay
            os.kill(pid, number)
            operating_system.go_on(pid)  # one that was paused could not handle it


def _wait_for_end(run: StartedRun, wait_s: float) -> None:
    deadline = time.monotonic() + wait_s
    while any(find_marked(run.mark)) and time.monotonic() < deadline:
        time.sleep(0.02)
