"""The processes of one system on this host: router, plant and agents. Each can be killed, paused and started again."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.access import PLANT, ROUTER
from agents.transport import TransportError
from coordinator.processes import Launcher, read_end
from coordinator.split import write_area_files
from coordinator.zygote import Ended, Started
from scenarios.scenario import Scenario

ROUTER_START_S = 10.0


@dataclass
class System:
    """Starts the processes of ``scenario`` with ``launcher`` under run id ``id``; ``folder``: for files and logs.

    ``scan_every_s``: time between scans of the plant, None for one scan only. ``keys``: folder of everybody's
    credentials; all links are secured then. ``note`` must be called with all news of the launcher: a death that was
    ordered is told from one that was not.
    """

    launcher: Launcher
    scenario: Scenario
    id: str
    folder: Path
    scan_every_s: float | None = None
    keys: Path | None = None
    endpoints: tuple[str, ...] = ()
    pids: dict[str, int] = field(default_factory=dict)  # of what runs
    _orders: dict[str, tuple[Any, ...]] = field(default_factory=dict)  # target and arguments of each process
    _killed: Counter[str] = field(default_factory=Counter)  # deaths ordered and not yet heard of

    def log_of(self, process: str) -> Path:
        """The log file of a process, of all its lives."""
        return (self.folder / "logs" / f"{process}.log").absolute()

    def start_router(self, wait: Callable[[], str | None]) -> None:
        """Start the router and wait until it says where it listens.

        ``wait``: called again and again meanwhile; a reason to give up, or None.

        Raises:
            TransportError: the router has ended, or does not listen in time.
        """
        said = self.folder.absolute() / "logs" / "router.endpoints"
        listen = self.scenario.transport.listen
        if self.keys:
            listen = f"tls/{listen.partition('/')[2]}"
        arguments = ["--listen", listen, "--endpoints-file", str(said), *self._keys(), *self._run()]
        self._order(ROUTER, "coordinator.router_process:main", arguments)
        deadline = time.monotonic() + ROUTER_START_S
        while not said.exists():
            reason = wait()
            if reason:
                raise TransportError(self._last_words(ROUTER) or reason)
            if time.monotonic() > deadline:
                raise TransportError(f"the router has not opened {listen} within {ROUTER_START_S:g} s")
        self.endpoints = tuple(said.read_text(encoding="utf-8").split())
        again = [part for endpoint in self.endpoints for part in ("--listen", endpoint)]  # where the others look for it
        self._orders[ROUTER] = ("coordinator.router_process:main", [*again, *self._keys(), *self._run()])

    def start_others(self) -> None:
        """Write the area files, start plant and agents."""
        files = write_area_files(self.scenario, self.id, self.endpoints, self.folder / "areas")
        self._first_scan_at = time.monotonic()
        self._start_plant(scan=1)
        for name, path in files.items():
            self._order(name, "agents.__main__:main", [str(path.absolute()), *self._keys()])

    def kill(self, name: str) -> None:
        """End a process, if it runs, without a chance to say anything."""
        if name in self.pids:
            del self.pids[name]
            self._killed[name] += 1
            self.launcher.signal(name, signal.SIGKILL)

    def restart(self, name: str) -> None:
        """Start a process again from what it was started from the first time; if it still runs, kill it before."""
        self.kill(name)
        if name == PLANT and self.scan_every_s:
            self._start_plant(scan=2 + int((time.monotonic() - self._first_scan_at) / self.scan_every_s))
        else:
            self._order(name, *self._orders[name])

    def pause(self, name: str) -> None:
        """Freeze a process in the middle of whatever it does."""
        self.launcher.signal(name, signal.SIGSTOP)

    def go_on(self, name: str) -> None:
        """Let a frozen process go on."""
        self.launcher.signal(name, signal.SIGCONT)

    def note(self, news: Started | Ended) -> bool:
        """Take in what happened to a process; whether it was to be expected."""
        if isinstance(news, Started):
            self.pids[news.name] = news.pid
            return True
        if news.code == -signal.SIGKILL and self._killed[news.name]:
            self._killed[news.name] -= 1
            return True
        self.pids.pop(news.name, None)
        return False

    def _start_plant(self, scan: int) -> None:
        """``scan``: above that of any plant before."""
        order = (self.scenario, self.id, self.endpoints, ROUTER_START_S, scan, self.scan_every_s, self.keys)
        self._order(PLANT, "coordinator.plant:run_plant", *order)

    def _order(self, name: str, target: str, *arguments: Any) -> None:
        self._orders[name] = (target, *arguments)
        self.launcher.start(name, target, *arguments, log=self.log_of(name), stop_last=name == ROUTER)

    def _keys(self) -> list[str]:
        return ["--keys", str(self.keys)] if self.keys else []

    def _run(self) -> list[str]:
        """The rules of access in a folder of keys may have been written for another run of the same areas."""
        return ["--run", self.id] if self.keys else []

    def _last_words(self, process: str) -> str | None:
        """The error that a process refused its input with, if its log ends with one."""
        for line in reversed(read_end(self.log_of(process), width=10_000).splitlines()):
            if line.startswith("error: "):
                return line.removeprefix("error: ")
        return None
