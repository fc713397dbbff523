"""A system whose processes a test starts one by one, and a watcher that compares what its areas say with the centre."""

from __future__ import annotations

import queue
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from agents.messages.checks import MessageError
from agents.messages.keys import all_live, all_states, name_of_live
from agents.messages.packing import StateMessage, decode
from agents.runtime.presence import Presence
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from coordinator.lab.evaluation.comparison import Gap, compare
from coordinator.lab.evaluation.evaluation import estimate_centralised, make_observer
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.dsse_command import COMMAND, ENVIRONMENT, free_endpoint
from tests.support.forked import ForkedProcess, parent
from tests.support.waiting import DEADLINE_S


def prepare_by_hand(dsse: Callable[..., subprocess.CompletedProcess[str]], secured: bool) -> tuple[str, list[str]]:
    """The area files of industrial13 in ``areas``, its credentials in ``keys`` if ``secured``.

    Returns where the router is to listen, and the options that name the credentials.
    """
    endpoint = free_endpoint("tls" if secured else "tcp")
    if secured:
        assert dsse("keys", "create", "industrial13", "--out", "keys").returncode == 0
    assert dsse("split", "industrial13", "--out", "areas", "--connect", endpoint).returncode == 0
    return endpoint, ["--keys", "keys"] if secured else []


WAIT_FOR_A_BUS = ("agent", "gateway", "plant", "record", "serve")


class SystemByHand:
    """``dsse`` processes by name, each with a log file; those that are left are killed at the end of the block."""

    def __init__(self, folder: Path, environment: Mapping[str, str] | None = None) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes] | ForkedProcess] = {}
        self._environment = {**ENVIRONMENT, **(environment or {})}

    def start(self, name: str, *arguments: object, prefix: Sequence[str] = (), python: Path | None = None) -> None:
        """Start ``dsse`` with ``arguments``, in a forked process.

        ``prefix``: the command that runs it elsewhere; ``python``: that of another environment, which then runs it.
        """
        log_path, words = self.log_of(name), list(map(str, arguments))
        if words[0] in WAIT_FOR_A_BUS and "--wait" not in words:
            words += ["--wait", str(DEADLINE_S)]  # the router may be on its way as long as a test waits
        if not prefix and python is None:
            self.processes[name] = parent().start(words, self.folder, self._environment, log_path, log_path)
            return
        with log_path.open("ab") as log:
            command = [str(python or COMMAND[0]), *COMMAND[1:]]
            self.processes[name] = subprocess.Popen(
                [*prefix, *command, *words], cwd=self.folder, env=self._environment, stdout=log, stderr=log
            )

    def log_of(self, name: str) -> Path:
        return self.folder / f"{name}.log"

    def read_log(self, name: str) -> str:
        """All that a process has logged."""
        return self.log_of(name).read_text(errors="replace")

    def end(self, name: str, number: signal.Signals = signal.SIGTERM) -> int:
        """End one process and return its exit code."""
        process = self.processes.pop(name)
        process.send_signal(number)
        return process.wait(DEADLINE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self.processes.values():
            process.kill()
        for process in self.processes.values():
            process.wait()


class Watcher:
    """Sees a running system of ``scenario`` from outside, from the moment on when it is made."""

    def __init__(self, scenario: str, endpoints: Sequence[str], keys: Path | None = None) -> None:
        self.scenario = load_scenario(scenario)
        self.telemetry = make_telemetry(self.scenario)
        self.leave_out()
        self._observer = make_observer(self.scenario, self.scenario.name)
        self._presence = Presence()
        self._updates: queue.SimpleQueue[bytes | tuple[str, bool]] = queue.SimpleQueue()
        self._session = Session.connect(endpoints, DEADLINE_S, load_keys(keys, "coordinator"))
        run = self.scenario.name
        self._session.subscribe(all_states(run), lambda key, payload: self._updates.put(payload))
        self._session.watch_presence(all_live(run), lambda key, alive: self._updates.put((key, alive)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._session.close()

    @property
    def states(self) -> Mapping[str, StateMessage]:
        """Area -> its newest state."""
        return self._observer.states

    @property
    def present(self) -> set[str]:
        """The names of all that are there."""
        return {name for _, name in self._presence.names}

    def leave_out(self, *meters: str) -> None:
        """Compare from now on with the centralised estimate without the readings of ``meters``."""
        by_area = {name: [m for m in part if m.meter.id not in meters] for name, part in self.telemetry.by_area.items()}
        union = [m for m in self.telemetry.union if m.meter.id not in meters]
        used = replace(self.telemetry, by_area=by_area, union=union)
        self._centralised = estimate_centralised(self.scenario, used).report

    def wait_for_consensus(self, deadline_s: float = DEADLINE_S) -> Gap:
        """Until all areas are there and agree; their largest difference to the centralised estimate."""
        self.wait_until(lambda: not self.obstacles(), deadline_s)
        return self.gap()

    def gap(self) -> Gap:
        """Of the areas' largest difference to the centralised estimate."""
        return compare(self.scenario.partition, self.states, self.telemetry.truth, self._centralised).gap

    def obstacles(self) -> tuple[str, ...]:
        """What is missing for consensus."""
        return self._observer.standing(time.monotonic()).obstacles

    def wait_until(self, holds: object, deadline_s: float = DEADLINE_S) -> None:
        """Take in what areas say until ``holds()``."""
        assert callable(holds)
        deadline = time.monotonic() + deadline_s
        while not holds():
            assert time.monotonic() < deadline, f"not within {deadline_s} s: {self.obstacles()}"
            try:
                self._take(self._updates.get(timeout=0.05))
            except queue.Empty:
                continue

    def _take(self, updates: bytes | tuple[str, bool]) -> None:
        now = time.monotonic()
        if isinstance(updates, bytes):
            with suppress(MessageError):  # a stranger's
                self._observer.take_state(decode(updates), now)
        elif self._presence.take(*updates):
            role, name = name_of_live(updates[0])
            if role == "area":
                self._observer.take_presence(name, updates[1], now)


@contextmanager
def agreeing_system(
    dsse: Callable[..., subprocess.CompletedProcess[str]], folder: Path, secured: bool = False
) -> Iterator[tuple[SystemByHand, Watcher, str, list[str]]]:
    """industrial13, whose areas agree, and its watcher; and what ``prepare_by_hand`` returns."""
    endpoint, keys = prepare_by_hand(dsse, secured)
    with SystemByHand(folder) as system:
        system.start("router", "router", "--listen", endpoint, *keys)
        for name in ("area1", "area2"):
            system.start(name, "agent", f"areas/{name}.toml", *keys)
        system.start("plant", "plant", "industrial13", "--connect", endpoint, *keys)
        with Watcher("industrial13", [endpoint], folder / "keys" if secured else None) as watcher:
            watcher.wait_for_consensus()
            yield system, watcher, endpoint, keys
