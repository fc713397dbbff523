"""The coordinator's end of the warmed parent: starts processes, receives their ends, leaves none behind."""

from __future__ import annotations

import contextlib
import os
import pickle
import secrets
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Pipe
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from agents.runtime.heap import LARGE
from coordinator.lab.process_run.compile_clock import clock
from coordinator.lab.process_run.fork_server import (
    IO_ERROR_CODE,
    MODULE,
    PARENT,
    STOP_ALL_S,
    Bind,
    Compiling,
    Ended,
    Instruction,
    Preload,
    Signal,
    Start,
    Started,
    Stop,
)
from coordinator.watch.interrupts import ENDS
from dsse_core import operating_system
from dsse_core.errors import DsseError

ONE_THREAD = {
    name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
}
FILES_OF_A_PROCESS = 32  # beside one for the link of each area; measured: a router with three areas runs with 24
# glibc's allocator: one heap for all threads, and free memory goes back to the system. The matrices of an area of 500
# buses stay below the limit; above it, each of them would be made of freshly cleared pages
ONE_HEAP = {"MALLOC_ARENA_MAX": "1", "MALLOC_TRIM_THRESHOLD_": str(LARGE), "MALLOC_MMAP_THRESHOLD_": str(LARGE)}
ROOT = Path(__file__).resolve().parents[3]  # where this package was imported from


class LaunchError(DsseError):
    """Processes cannot be started here."""


class Launcher:
    """Starts the processes of a run from one warmed parent. Leaving the block stops all of them.

    ``update``, if given, is called with every ``Started`` and ``Ended``, on a thread of its own. ``bound``: the
    processes also end if this process is killed; otherwise they go on.
    """

    def __init__(self, update: Callable[[Started | Ended], None] | None = None, *, bound: bool = False) -> None:
        if not operating_system.HAS_CHILDREN_SIGNAL:
            raise LaunchError("this system has no SIGCHLD; use `dsse simulate`, or run under WSL on Windows")
        self.on_update = update or (lambda _: None)
        self.mark = secrets.token_hex(8)  # in the command lines of all its processes
        self._orders, theirs = Pipe()
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
        # the parent inherits the mask: signals that end it wait until it has its handlers
        with operating_system.blocked(ENDS):
            self._fork_server = subprocess.Popen(
                # -P: a folder "agents" or "scenarios" of the user must not replace the package of this name
                [sys.executable, "-P", "-m", MODULE, str(theirs.fileno()), self.mark],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, **ONE_THREAD, **ONE_HEAP, "PYTHONPATH": path},
            )
        theirs.close()
        self._any_started = False
        self._stopping = False
        self._closed = False
        self._reader = threading.Thread(target=self._read_updates, name="process updates", daemon=True)
        self._reader.start()
        if bound:
            self._send(Bind())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the warmed parent, and id of the process group of all."""
        return self._fork_server.pid

    def preload(self, *targets: str, arguments: tuple[Any, ...] = ()) -> None:
        """Has the parent import modules ("module"), or call functions ("module:function") with ``arguments``, now."""
        self._send(Preload(targets, arguments))

    def start(self, name: str, target: str, *arguments: Any, log: Path, stop_last: bool = False, nice: int = 0) -> None:
        """Starts process ``name``, which calls ``target`` ("module:function") and writes its output to ``log``.

        ``stop_last``: stopped after the others when the block ends. ``nice``: niceness added to the process.
        """
        self._any_started = True
        self._send(Start(name, target, pickle.dumps(arguments), log, stop_last, nice))

    def signal(self, name: str, number: int | None) -> None:
        """Sends a signal to process ``name``; no effect if the process has ended.

        Raises:
            LaunchError: ``number`` is None, because this system lacks the signal.
        """
        if number is None:
            raise LaunchError(f"this system has no signal that pauses or silences {name}; use `dsse simulate`")
        self._send(Signal(name, number))

    def stop(self) -> None:
        """Orders every process to end, without waiting for the end."""
        if self._any_started and not self._stopping:
            self._stopping = True
            with contextlib.suppress(LaunchError):
                self._send(Stop())

    def close(self) -> None:
        """Stops every process and waits for their ends; later calls do nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self.stop()
            if self._stopping:
                self._fork_server.wait(STOP_ALL_S + 2.0)
        except subprocess.TimeoutExpired:
            pass
        finally:  # also on a second Ctrl-C
            if self._fork_server.poll() != 0:
                self._kill_group()
            self._reader.join(1.0)
            self._orders.close()

    def _kill_group(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            operating_system.signal_group(self.pid, operating_system.KILL)
        self._fork_server.wait()

    def _send(self, order: Instruction) -> None:
        try:
            self._orders.send(order)
        except OSError:
            raise LaunchError(
                f"the parent of all processes has ended with {describe_end(self._fork_server.wait())}"
            ) from None

    def _read_updates(self) -> None:
        reported_end = compiles = False
        try:
            while True:
                update = self._orders.recv()
                if isinstance(update, Compiling):
                    compiles = update.begins
                    clock.take(update.begins, update.folder)
                    continue
                reported_end |= update.name == PARENT
                self.on_update(update)  # looked up now: it may have been set during the wait
        except (EOFError, OSError):
            if compiles:
                clock.take(False, None)
            if not (self._stopping or self._closed or reported_end):
                self.on_update(Ended(PARENT, self.pid, self._fork_server.wait()))


def check_open_files(areas: int) -> None:
    """Raises LaunchError if a process may not open as many files as the links of ``areas`` areas need."""
    limit, needed = operating_system.find_limit_of_open_files(), FILES_OF_A_PROCESS + areas
    if limit is not None and limit < needed:
        raise LaunchError(
            f"a process may open {limit} files here, and {areas} areas need {needed}; "
            f"raise the limit (ulimit -n {needed})"
        )


def describe_end(code: int) -> str:
    """The end of a process in words, from its exit code; a negative code is a signal."""
    if code == IO_ERROR_CODE:
        return f"exit code {code}, as a file could not be written or read; is the disk full?"
    return f"exit code {code}" if code >= 0 else f"signal {operating_system.name_signal(-code)}"


def read_end(log: Path, lines: int = 24, width: int = 160) -> str:
    """The last ``lines`` lines of a log file, cut at ``width`` characters; empty if it cannot be read."""
    try:
        last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:]
    except OSError:
        return ""
    return "\n".join(line if len(line) <= width else line[: width - 3] + "..." for line in last)
