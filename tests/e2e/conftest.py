"""The command ``dsse`` as a user runs it: real processes, real Zenoh on loopback."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.dsse_command import COMMAND, ENVIRONMENT
from tests.support.forked import end_parent, parent
from tests.support.waiting import DEADLINE_S, is_gone, wait_until

for number in (signal.SIGHUP, signal.SIGQUIT):  # what nohup and background jobs ignore, commands would ignore, too
    signal.signal(number, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


@dataclass
class RunUnderWay:
    """``dsse run`` in the background, in a session of its own as in a terminal."""

    process: subprocess.Popen[str]
    folder: Path

    def events(self) -> list[dict[str, object]]:
        path = self.folder / "events.jsonl"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        return [json.loads(line) for line in lines if line.endswith("\n")]

    def pids(self) -> dict[str, int]:
        """Name -> process id of all that the run has started."""
        events = self.events()
        parent = {"parent": events[0]["parent_pid"]} if events else {}
        return parent | {e["name"]: e["pid"] for e in events if e["event"] == "process started"}  # type: ignore

    def wait_until_joined(self, *names: str) -> None:
        """Until the areas ``names`` and the plant are on the bus."""
        wanted = {*names, "plant"}
        wait_until(lambda: wanted <= {e["name"] for e in self.events() if e["event"] == "appeared"})

    def end(self) -> tuple[int, str, str]:
        """Wait for the end: exit code, standard output, standard error."""
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, err


@pytest.fixture(scope="session", autouse=True)
def forked_processes_end() -> Iterator[None]:
    yield
    end_parent()


@pytest.fixture
def dsse(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run ``dsse`` with arguments in an empty folder, in a forked process, and wait for its end."""
    logs = tmp_path_factory.mktemp("logs")

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = list(map(str, arguments))
        out, err = logs / "out", logs / "err"
        for file in (out, err):
            file.write_text("")
        process = parent().start(command, tmp_path, ENVIRONMENT, out, err)
        try:
            code = process.wait(DEADLINE_S)
        finally:
            process.kill()
        return subprocess.CompletedProcess(command, code, out.read_text(), err.read_text())

    return run


@pytest.fixture
def dsse_from_nothing(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """The same in a process that starts as a user's does: Python finds and imports what it needs."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*COMMAND, *map(str, arguments)],
            cwd=tmp_path,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )

    return run


@pytest.fixture
def start_run(tmp_path: Path) -> Iterator[Callable[..., RunUnderWay]]:
    """Start ``dsse run`` with arguments, its run folder being ``out``, and a time limit that a slow machine keeps; all
    of it is killed after the test.
    """
    started = []

    def start(*arguments: object) -> RunUnderWay:
        folder = tmp_path / "out"
        limit = () if "--timeout" in arguments else ("--timeout", DEADLINE_S)
        process = subprocess.Popen(
            [*COMMAND, "run", *map(str, (*arguments, *limit)), "--out", str(folder), "--no-plots"],
            cwd=tmp_path,
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(RunUnderWay(process, folder))
        return started[-1]

    yield start
    for run in started:
        run.process.kill()
        run.process.communicate()
        if parent := run.pids().get("parent"):  # outlasts the killed run, with its process group
            with contextlib.suppress(ProcessLookupError):
                os.killpg(parent, signal.SIGKILL)


@pytest.fixture
def assert_nothing_left() -> Callable[[dict[str, int]], None]:
    """Check that processes end within the deadline; names those that do not."""

    def check(pids: dict[str, int]) -> None:
        assert pids
        wait_until(lambda: all(is_gone(pid) for pid in pids.values()))

    return check


@pytest.fixture
def deaf_scenario(edited_scenario: Callable[..., Path]) -> Path:
    """A scenario that never reaches consensus: every message between areas is lost."""
    return edited_scenario("industrial13-lossy", ("loss = 0.3", "loss = 1.0"))
