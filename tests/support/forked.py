"""``dsse`` in processes that a warmed parent forks, as `dsse run` has its agents forked: to start Python and to import
what a command needs takes a second of a processor, for each of some hundred processes of the tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

from coordinator.lab.process_run.fork_server import Ended, Started
from coordinator.lab.process_run.processes import Launcher
from tests.support.waiting import DEADLINE_S

IMPORTED_ONCE = (
    "agents.__main__",
    "coordinator.cli.main",
    "coordinator.watch.observe.attachment",
    "coordinator.lab.deployment.certificates",
    "coordinator.lab.deployment.split",
    "coordinator.lab.plant.plant",
    "coordinator.lab.process_run.router_process",
    "coordinator.lab.process_run.run_scenario",
)


class ForkedProcess:
    """What tests use of ``subprocess.Popen``."""

    def __init__(self) -> None:
        self.pid = 0
        self.returncode: int | None = None
        self.started, self.ended = threading.Event(), threading.Event()

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if not self.ended.wait(timeout) or self.returncode is None:
            raise subprocess.TimeoutExpired("dsse", timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            with suppress(ProcessLookupError):  # its end is about to be reported
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Parent:
    """The warmed parent of this worker of the tests."""

    def __init__(self) -> None:
        self._processes: dict[str, ForkedProcess] = {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # where it finds ``become``
            self._launcher = Launcher(self._take)
        self._launcher.preload(*IMPORTED_ONCE)

    def start(
        self, arguments: Sequence[str], folder: Path, environment: Mapping[str, str], out: Path, err: Path
    ) -> ForkedProcess:
        """Start ``dsse`` with ``arguments`` in ``folder``; it appends to the files ``out`` and ``err``."""
        for file in (out, err):
            file.touch()  # now: the process itself opens it some time later
        name = str(len(self._processes))
        process = self._processes[name] = ForkedProcess()
        become = (list(arguments), folder.absolute(), dict(environment), out.absolute())
        self._launcher.start(name, "tests.support.forked:become", *become, log=err.absolute())
        assert process.started.wait(DEADLINE_S), "the parent of forked processes does not answer"
        return process

    def close(self) -> None:
        self._launcher.close()

    def _take(self, update: Started | Ended) -> None:
        process = self._processes.get(update.name)
        if process is not None and isinstance(update, Started):
            process.pid = update.pid
            process.started.set()
        elif process is not None and isinstance(update, Ended):
            process.returncode = update.code
            process.ended.set()


@cache
def parent() -> Parent:
    """That of this worker, from its first use on until ``end_parent``."""
    return Parent()


def end_parent() -> None:
    if parent.cache_info().currsize:
        parent().close()


def become(arguments: Sequence[str], folder: Path, environment: Mapping[str, str], out: Path) -> int:
    """In the forked process, whose output all goes to a log: the command ``dsse``."""
    from coordinator.__main__ import main

    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGUSR1, signal.SIGUSR2))
    file = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(file, sys.stdout.fileno())
    os.close(file)
    sys.argv = ["dsse", *arguments]
    return main(arguments)
