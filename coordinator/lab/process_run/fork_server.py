"""The warmed parent: imports once what router, plant and agents need, then forks each of them in milliseconds.
On a system without fork it starts ordinary processes instead, which import for themselves.

The parent obeys the coordinator over one socket:

- A coordinator that ends in order has its processes stopped.
- A coordinator that is killed stops nothing, unless it has bound the processes to its life: the areas go on until
  SIGTERM, SIGINT or SIGHUP reaches the parent, which then stops them.
- If the parent is killed, its children end by themselves.

The parent holds no thread and no Zenoh session, so forking is safe. The parent and its children are one process group,
so that Ctrl-C in a terminal reaches the coordinator only.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import importlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NoReturn

from coordinator.lab.process_run.lifeline import Lifeline
from coordinator.watch.interrupts import ENDS
from dsse_core import compiling, operating_system
from dsse_core.code_places import Whole, find_folder_to_keep_in, has_whole
from dsse_core.printable import printable_lines

STOP_S = 5.0  # from SIGTERM to SIGKILL
STOP_ALL_S = 2 * STOP_S  # the processes that routers serve first, then the routers
PARENT = "parent of all processes"
MODULE = "coordinator.lab.process_run.fork_server"
SPAWNED = "lifeline:"  # before the number of the lifeline's end, in the arguments of a process that is not forked
COMPILES: Mapping[str, Whole] = {
    "agents.runtime.warm_up:warm_up": "exchange",
    "agents.runtime.warm_up:warm_up_estimate": "estimate",
}
IO_ERROR_CODE = 74  # exit code of a process that could not write or read a file, as sysexits.h has it


@dataclass(frozen=True, slots=True)
class Preload:
    """Order to import the modules of ``targets`` and, of "module:function", to call the function with ``arguments``."""

    targets: tuple[str, ...]
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class Start:
    """Order to fork process ``name``, which calls ``target`` ("module:function") and exits with its return value.

    ``arguments``: pickled, so that only the process itself spends time on them. ``stop_last``: the process is stopped
    when the others have ended. ``nice``: niceness added to the process.
    """

    name: str
    target: str
    arguments: bytes
    log: Path
    stop_last: bool = False
    nice: int = 0


@dataclass(frozen=True, slots=True)
class Signal:
    """Order to send signal ``number`` to process ``name``; no effect if the process has ended."""

    name: str
    number: int


@dataclass(frozen=True, slots=True)
class Bind:
    """Order to stop all children and exit as soon as the coordinator has ended."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Order to stop all children and exit."""


Instruction = Preload | Start | Signal | Bind | Stop


@dataclass(frozen=True, slots=True)
class Started:
    """Update to the coordinator: process ``name`` runs."""

    name: str
    pid: int


@dataclass(frozen=True, slots=True)
class Ended:
    """Update to the coordinator: a process has ended. ``code``: exit code, or minus the signal that killed it."""

    name: str
    pid: int
    code: int


@dataclass(frozen=True, slots=True)
class Compiling:
    """Update to the coordinator: compiling begins or ends in the parent. ``folder``: of the code; None: not kept."""

    begins: bool
    folder: str | None


@dataclass(repr=False)  # ``signal.getsignal`` makes one of a bound method, in every child: it would list all children
class ForkServer:
    """Serves the commands that arrive on ``orders``."""

    orders: Connection[Any, Any]
    children: dict[int, Start] = field(default_factory=dict)  # by pid
    stopped: bool = False
    signalled: int = 0  # number of the signal that ordered the stop; 0: none
    bound: bool = False  # to the life of the coordinator
    lifeline: Lifeline = field(default_factory=Lifeline)
    _compiler: int = 0  # process id, while there is one
    _spawned: dict[int, subprocess.Popen[bytes]] = field(default_factory=dict)  # by pid, where nothing is forked

    def serve(self) -> None:
        """Obeys until an order to stop or a signal of ``ENDS``. If the coordinator has ended without binding its
        processes: until no child is left. Then stops all children.
        """
        wake_read, wake_write = os.pipe()
        os.set_blocking(wake_read, False)
        os.set_blocking(wake_write, False)
        signal.set_wakeup_fd(wake_write, warn_on_full_buffer=False)
        assert operating_system.CHILD is not None  # or the launcher has raised
        signal.signal(operating_system.CHILD, lambda *_: None)  # the byte on the pipe is enough
        for number in ENDS:
            if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
                signal.signal(number, self.stop)
        operating_system.unblock(ENDS)  # which the coordinator has blocked until now
        # children inherit the mask: these signals wait until a process has its handlers, and would end it before
        operating_system.block(n for n in (operating_system.USER_1, operating_system.USER_2) if n is not None)
        self._inherited = (wake_read, wake_write)
        compiling.listen(lambda begins, folder: self._report(Compiling(begins, folder)))
        gc.set_threshold(100_000, 50, 100)  # the plant of a large grid is millions of objects without cycles
        try:
            orphaned = False
            while not self.stopped and not (orphaned and not self.children):
                ready = wait([wake_read] if orphaned else [self.orders, wake_read])
                if wake_read in ready:
                    os.read(wake_read, 4096)
                    self._reap()
                if self.orders in ready:
                    try:
                        self._obey(self.orders.recv())
                    except (EOFError, ConnectionError):
                        orphaned, self.stopped = True, self.stopped or self.bound
                        _redirect(Path(os.devnull))  # readers of the coordinator's pipes must see their end
        finally:
            if self.signalled:  # before the ends of the children, which follow from it
                self._report(Ended(PARENT, os.getpid(), -self.signalled))
            self._stop_children()

    def stop(self, number: int, _: object) -> None:
        self.stopped, self.signalled = True, number
        if self._compiler:
            os.kill(self._compiler, operating_system.KILL)

    def _obey(self, order: Instruction) -> None:
        match order:
            case Preload(targets, arguments):
                for target in targets:
                    module, _, function = target.partition(":")
                    imported = importlib.import_module(module)
                    if function:
                        self.compile_in_child(target)
                        if not self.stopped:
                            getattr(imported, function)(*arguments)
                gc.collect()  # garbage is freed once here, not as copied pages in each child
                gc.freeze()  # the children share these pages as long as no collector touches them
            case Start():
                pid = self._fork(order) if operating_system.HAS_FORK else self._spawn(order)
                self.children[pid] = replace(order, arguments=b"")  # children forked later must not inherit them
                self._report(Started(order.name, pid))
            case Signal(name, number):
                for pid, child in self.children.items():
                    if child.name == name:
                        os.kill(pid, number)
            case Bind():
                self.bound = True
            case Stop():
                self.stopped = True

    def compile_in_child(self, target: str) -> None:
        """Forks a process that compiles the code of ``target``, if the code is not kept yet and a folder can keep it.

        The parent then loads the kept code. If the parent compiled, all its children would inherit the memory of the
        compiler, and each of them would copy 6 MiB of it, page by page.
        """
        what = COMPILES.get(target)
        if not operating_system.HAS_FORK or what is None or has_whole(what) or find_folder_to_keep_in() is None:
            return
        self._compiler = operating_system.fork()
        if self._compiler == 0:
            self._become_compiler(target)
        os.waitpid(self._compiler, 0)  # if it fails, the parent compiles
        self._compiler = 0

    def _become_compiler(self, target: str) -> NoReturn:
        """Turns the forked child into the compiler: calls ``target``, reports compiling to the coordinator, and exits.

        The parent waits meanwhile, and reports nothing.
        """
        try:
            _take_signals()
            self.lifeline.hold(0.0, STOP_S)
            module, _, function = target.partition(":")
            getattr(importlib.import_module(module), function)()
        except BaseException:
            _write_last(traceback.format_exc())
        finally:
            os._exit(0)

    def _fork(self, order: Start) -> int:
        pid = operating_system.fork()
        if pid == 0:
            become(order, self.lifeline, self._leave_parent)
        return pid

    def _leave_parent(self) -> None:
        _take_signals()
        self.orders.close()
        compiling.forget_listeners()
        for fd in self._inherited:
            os.close(fd)

    def _spawn(self, order: Start) -> int:
        """Starts an ordinary process, which imports itself the modules that a forked one inherits; returns its id."""
        end = self.lifeline.end
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", MODULE, f"{SPAWNED}{end}", *sys.argv[2:]],  # the mark comes last
            pass_fds=[end],
            stdin=subprocess.PIPE,
        )
        self._spawned[process.pid] = process  # kept until its end: ``subprocess`` reaps a process without reference
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin:  # the process has died; its end is reported later
            pickle.dump(order, process.stdin)
        return process.pid

    def _reap(self) -> None:
        while self.children:
            pid, code = operating_system.find_ended_child()
            if pid == 0:
                return
            if process := self._spawned.pop(pid, None):
                process.returncode = code
            self._report(Ended(self.children.pop(pid).name, pid, code))

    def _report(self, update: Started | Ended | Compiling) -> None:
        with contextlib.suppress(OSError):  # the coordinator has ended; the next receive shows it
            self.orders.send(update)

    def _stop_children(self) -> None:
        """Sends SIGTERM to all children but the routers, then to the routers, so that agents can still publish that
        they leave. Sends SIGKILL to children that are left after ``STOP_S`` each.
        """
        for last in (False, True):
            deadline = time.monotonic() + STOP_S
            group = [pid for pid, child in self.children.items() if child.stop_last == last]
            for pid in group:
                os.kill(pid, signal.SIGTERM)
                operating_system.go_on(pid)  # a paused process could not handle the signal
            while any(pid in self.children for pid in group) and time.monotonic() < deadline:
                self._reap()
                time.sleep(0.002)
        for pid in self.children:
            os.kill(pid, operating_system.KILL)
        while self.children:
            self._reap()
            time.sleep(0.002)


def become(order: Start, lifeline: Lifeline, leave_parent: Callable[[], None] = lambda: None) -> NoReturn:
    """Turns the child into the process of ``order``: leaves the parent's state behind, calls the target, exits."""
    code = 1
    try:
        operating_system.be_nice(order.nice)
        leave_parent()
        _redirect(order.log)
        lifeline.hold(STOP_S if order.stop_last else 0.0, STOP_S)
        faulthandler.enable(all_threads=False)
        code = _call(order)
        logging.shutdown()
        sys.stdout.flush()
    except OSError as error:  # on a full disk the message cannot be written either; the exit code tells it, too
        code = IO_ERROR_CODE
        where = f"{error.filename}: " if error.filename else ""
        _write_last(f"error: {where}{error.strerror or error}; make room there, or choose another place\n")
    except BaseException:
        _write_last(traceback.format_exc())
    finally:
        os._exit(code)  # nothing of the parent's stack may run here


def _take_signals() -> None:
    """Restores, in a child, the default actions of the signals that end it, except signals ignored, as under nohup."""
    signal.set_wakeup_fd(-1)
    for number in filter(None, (operating_system.CHILD, *ENDS)):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def _write_last(text: str) -> None:
    """Writes to standard error directly, because the buffers may hold text that could not be written."""
    with contextlib.suppress(OSError):
        os.write(sys.stderr.fileno(), printable_lines(text).encode(errors="backslashreplace"))


def _redirect(log: Path) -> None:
    """Directs standard output and error to ``log``, and makes standard input empty."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for source, target in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(source, target)
    os.close(nothing)
    os.close(file)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]


def _call(order: Start) -> int:
    module, function = order.target.split(":")
    try:
        return int(getattr(importlib.import_module(module), function)(*pickle.loads(order.arguments)) or 0)
    except SystemExit as request:
        if isinstance(request.code, str):
            print(request.code, file=sys.stderr)
            return 1
        return request.code or 0


if __name__ == "__main__":  # arguments: the socket; the mark by which `dsse stop` finds this process and its children
    from coordinator.lab.process_run import fork_server

    if sys.argv[1].startswith(SPAWNED):
        fork_server.become(pickle.load(sys.stdin.buffer), Lifeline(int(sys.argv[1].removeprefix(SPAWNED))))
    fork_server.ForkServer(Connection(int(sys.argv[1]))).serve()
    os._exit(0)  # the coordinator waits, and there is nothing to tidy up
