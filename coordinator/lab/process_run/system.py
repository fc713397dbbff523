"""The processes of one system on this host: router, plant and agents. Each can be killed, paused and started again."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.security.access import PLANT, ROUTER, ROUTERS, SECOND_ROUTER, access_without_keys
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session, TransportError, warn_of_strangers
from coordinator.lab.deployment.endpoints import choose_area_endpoints
from coordinator.lab.deployment.split import area_files, write_area_files
from coordinator.lab.plant.scans import MadeScan, OwnScans
from coordinator.lab.process_run.fork_server import Ended, Started
from coordinator.lab.process_run.processes import Launcher, check_open_files, read_end
from coordinator.watch.recording.folder import LOG, LOGS, RECORDER, RecordingOrder
from dsse_core import operating_system
from dsse_core.limits import LONGEST_S
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry

ROUTER_START_S = 10.0
NICE_OF_AREAS = 10  # hundreds of areas that compute leave router, plant and fork server the little time that they need
HELD_S = LONGEST_S  # duration of a held scan


@dataclass
class System:
    """Starts the processes of ``scenario`` with ``launcher`` under run id ``id``; ``folder``: for files and logs.

    ``scan_every_s``: time between scans of the plant, None for one scan only. ``keys``: folder of the credentials of
    all processes; all links are secured then. ``any_name``: without keys, a router passes messages of all senders, not
    only those of the processes of the run. ``note`` must be called with all updates of the launcher, because it tells
    ends that were ordered from others.
    """

    launcher: Launcher
    scenario: Scenario
    id: str
    folder: Path
    scan_every_s: float | None = None
    keys: Path | None = None
    any_name: bool = False
    endpoints: tuple[str, ...] = ()
    pids: dict[str, int] = field(default_factory=dict)  # of the last incarnation of each
    _area_endpoints: dict[str, str] = field(default_factory=dict)  # endpoint of each area, if there is no router
    _orders: dict[str, tuple[Any, ...]] = field(default_factory=dict)  # target and arguments of each process
    _running: set[str] = field(default_factory=set)  # started, and neither killed nor known to have ended
    _killed: Counter[str] = field(default_factory=Counter)  # deaths ordered and not yet reported

    def log_of(self, process: str) -> Path:
        """The log file of a process, of all its incarnations."""
        return (self.folder / "logs" / f"{process}.log").absolute()

    @property
    def direct(self) -> bool:
        """True where neighbours link with each other directly, without a router."""
        return self.scenario.transport.kind == "neighbours"

    def start_bus(self, wait: Callable[[], str | None]) -> None:
        """Starts the routers and waits until they listen. Without routers, chooses the endpoints of the areas.

        ``wait``: called repeatedly during the wait; returns a reason to give up, or None.

        Raises:
            TransportError: a router has ended, or does not listen in time.
            LaunchError: this system lets a process open too few files for so many links.
        """
        check_open_files(len(self.scenario.partition.areas))
        protocol = "tls" if self.keys else "tcp"
        listen = f"{protocol}/{self.scenario.transport.listen.partition('/')[2]}"
        warn_of_strangers([listen], self.keys is not None)  # here, too, because the log of a router is rarely read
        if self.direct:
            self._area_endpoints = choose_area_endpoints(self.scenario, protocol)
            self.endpoints = tuple(self._area_endpoints.values())
        else:
            self.endpoints = self._start_router(ROUTER, listen, wait)
            if self.scenario.transport.routers > 1:
                self.endpoints += self._start_router(SECOND_ROUTER, f"{listen.rpartition(':')[0]}:0", wait)

    def join(self, name: str) -> Session:
        """A session of this process on the bus, with the credentials of process ``name`` if the run is secured."""
        keys, heartbeat_s = load_keys(self.keys, name, self.id), self.scenario.run.beat_s
        return Session.join(self.endpoints, keys=keys, heartbeat_s=heartbeat_s, direct=self.direct)

    def _start_router(self, name: str, listen: str, wait: Callable[[], str | None]) -> tuple[str, ...]:
        """Starts a router that links with the routers started before, waits until it listens, returns its endpoints."""
        endpoints_file = self.folder.absolute() / "logs" / f"{name}.endpoints"
        always = [part for endpoint in self.endpoints for part in ("--connect", endpoint)] + self._keys() + self._run()
        always += ["--heartbeat", str(self.scenario.run.beat_s)]
        target = "coordinator.lab.process_run.router_process:main"
        rules = self.scenario.reading_rules
        access = None if self.keys or self.any_name else access_without_keys(self.scenario.partition, self.id, rules)
        self._order(name, target, ["--listen", listen, "--endpoints-file", str(endpoints_file), *always], access)
        deadline = math.inf
        while not endpoints_file.exists():
            if name in self.pids:  # until it has started, the parent may compile: 13 s the first time on a machine
                deadline = min(deadline, time.monotonic() + ROUTER_START_S)
            reason = wait()
            if reason:
                raise TransportError(self._last_error(name) or reason)
            if time.monotonic() > deadline:
                raise TransportError(f"the {name} has not opened {listen} within {ROUTER_START_S:g} s")
        endpoints = tuple(endpoints_file.read_text(encoding="utf-8").split())
        again = [part for endpoint in endpoints for part in ("--listen", endpoint)]  # a restart keeps the endpoints
        self._orders[name] = (target, [*again, *always], access)
        return endpoints

    def start_recorder(self, folder: Path, limit_gb: float | None, wait: Callable[[], str | None]) -> None:
        """Starts the recorder, which writes into ``folder``, and waits for its log; ``wait`` as for ``start_bus``.

        Raises:
            TransportError: the recorder has ended.
        """
        files = area_files(self.scenario, self.id, self.endpoints, self._area_endpoints)
        order = RecordingOrder(folder.absolute(), self.id, files, limit_gb, closes=False)
        target = "coordinator.watch.recording.bus_recorder:run_recorder"
        self._order(RECORDER, target, order, self.endpoints, self.keys, self.direct, stop_last=True)
        while not any((folder / LOGS).glob(f"*{LOG}")):
            if reason := wait():
                raise TransportError(self._last_error(RECORDER) or reason)

    def start_agents(self) -> None:
        """Writes the area files and starts the agents."""
        where = (self.endpoints, self.folder / "areas", self._area_endpoints, ".json")
        for name, path in write_area_files(self.scenario, self.id, *where):
            self._order(name, "agents.__main__:run_process", path.absolute(), self.keys)

    def start_plant(self, telemetry: Telemetry | None = None) -> None:
        """Starts the plant with its first scan. ``telemetry``: of the only scan, if it has been made already."""
        self._start_plant(1, None if telemetry is None else MadeScan.of(self.scenario, telemetry))

    def kill(self, name: str) -> None:
        """Kills a process, if it runs. The process publishes nothing more."""
        if name in self._running:
            self._running.remove(name)
            self._killed[name] += 1
            self.launcher.signal(name, operating_system.KILL)

    def restart(self, name: str) -> None:
        """Starts a process again with the arguments of its first start; kills it before if it still runs.

        A plant that makes many scans goes on with a new scan number.
        """
        self.kill(name)
        if name == PLANT and self.scan_every_s:
            self._start_plant(self._next_scan(self.scan_every_s))
        else:
            self._order(name, *self._orders[name])

    def hold_scan(self) -> None:
        """Starts the plant again with one more scan, which stays."""
        scan = self._next_scan(self.scan_every_s or HELD_S)
        self.scan_every_s = HELD_S
        self.kill(PLANT)
        self._start_plant(scan)

    def pause(self, name: str) -> None:
        """Freezes a process."""
        self.launcher.signal(name, operating_system.PAUSE)

    def go_on(self, name: str) -> None:
        """Lets a frozen process continue."""
        self.launcher.signal(name, operating_system.GO_ON)

    def note(self, update: Started | Ended) -> bool:
        """Takes in the start or end of a process. True where it was ordered: a start, or the end of a killed one."""
        if isinstance(update, Started):
            self.pids[update.name] = update.pid
            return True
        if update.code == -operating_system.KILL and self._killed[update.name]:
            self._killed[update.name] -= 1
            return True
        self._running.discard(update.name)
        return False

    def _next_scan(self, every_s: float) -> int:
        """A scan number above those of all scans that earlier plants can have made."""
        return self._first_scan + 2 + int((time.monotonic() - self._first_scan_at) / every_s)

    def _start_plant(self, scan: int, made: MadeScan | None = None) -> None:
        self._first_scan, self._first_scan_at = scan, time.monotonic()
        scans = made or OwnScans(self.scenario, many=bool(self.scan_every_s))
        where = (scans, self.id, self.endpoints, ROUTER_START_S)
        self._order(
            PLANT, "coordinator.lab.plant.plant:run_plant", *where, scan, self.scan_every_s, self.keys, self.direct
        )

    def _order(self, name: str, target: str, *arguments: Any, stop_last: bool = False) -> None:
        self._orders[name] = (target, *arguments)
        self._running.add(name)
        is_router, is_area = name in ROUTERS, name not in (*ROUTERS, PLANT, RECORDER)
        nice = NICE_OF_AREAS if is_area else 0
        stop_last |= is_router
        self.launcher.start(name, target, *arguments, log=self.log_of(name), stop_last=stop_last, nice=nice)

    def _keys(self) -> list[str]:
        return ["--keys", str(self.keys)] if self.keys else []

    def _run(self) -> list[str]:
        """Router arguments that name the run: the rules of access in a folder of keys may name another run of the same
        areas.
        """
        return ["--run", self.id] if self.keys else []

    def _last_error(self, process: str) -> str | None:
        """The last error line in the last lines of a process's log, without "error: "; None if there is none."""
        for line in reversed(read_end(self.log_of(process), width=10_000).splitlines()):
            if line.startswith("error: "):
                return line.removeprefix("error: ")
        return None
