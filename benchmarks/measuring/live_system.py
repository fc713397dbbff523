"""A system of real processes that runs until its block ends, watched over the bus as by any other watcher."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from agents.messages.keys import clock_key, state_key
from agents.messages.packing import StateMessage, decode
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS, is_old
from agents.runtime.presence import begin_incarnation
from agents.security.access import COORDINATOR
from coordinator.lab.evaluation.comparison import rows_of
from coordinator.lab.evaluation.evaluation import estimate_centralised
from coordinator.lab.process_run.fork_server import Ended, Started
from coordinator.lab.process_run.processes import Launcher
from coordinator.lab.process_run.run_status import RunClock
from coordinator.lab.process_run.system import System
from coordinator.watch.observe.updates import Updates
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

START_S = 60.0
LOOK_S = 0.02
GAP = 1e-8  # p.u. and rad; below it all areas are where the centralised estimate is

States = Mapping[str, StateMessage]


class LiveSystem:
    """The processes of ``scenario``; ``states`` are the newest that were received, ``strays`` ended unasked.

    ``scan_every_s``: time between scans, None for one only. ``folder``: empty, for area files and logs. ``any_name``:
    the router passes on messages of all names. ``keys``: folder of the credentials of all processes, if secured.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        scan_every_s: float | None = None,
        *,
        any_name: bool = False,
        keys: Path | None = None,
    ) -> None:
        (folder / "logs").mkdir(parents=True)
        self.scenario = scenario
        self.folder = folder
        self.states: dict[str, StateMessage] = {}
        self.strays: list[str] = []
        self.received_at: dict[str, float] = {}
        self._silence = 0.0
        self._updates = Updates()
        self._began: float | None = None
        self._clock = RunClock("live", scenario.run.beat_s, begin_incarnation())
        self._launcher = Launcher(self._updates.put)
        self.system = System(self._launcher, scenario, "live", folder, scan_every_s, keys, any_name)
        self._rows = {area.name: rows_of(scenario.partition, area.name) for area in scenario.partition.areas}
        self._centralised = lru_cache(maxsize=8)(self._estimate)

    @property
    def areas(self) -> tuple[str, ...]:
        return tuple(self._rows)

    def __enter__(self) -> Self:
        try:
            self._launcher.preload(
                "coordinator.lab.process_run.router_process", "agents.__main__", "coordinator.lab.plant.plant"
            )
            self.system.start_bus(lambda: self.take(LOOK_S) or None)
            self.system.start_agents()
            self.system.start_plant()
            self._session = self.system.join(COORDINATOR)
            self._clock.publish = self._session.publisher(clock_key("live"))
            for area in self.areas:
                self._session.subscribe(
                    state_key("live", area), lambda key, payload: self._updates.put((time.monotonic(), payload))
                )
        except BaseException:
            self._launcher.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._session.close()
        self._launcher.close()

    def take(self, timeout_s: float = 0.0) -> str:
        """Process the messages that have arrived, or wait for one up to ``timeout_s``; the strays, as text."""
        if self._began is not None:
            self._clock.tick(time.monotonic() - self._began)
        for item in self._updates.take(timeout_s):
            if isinstance(item, Started | Ended):
                if not self.system.note(item):
                    self.strays.append(str(item))
            else:
                at, payload = item
                self._keep(at, decode(payload))
        return "; ".join(self.strays)

    def wait_until(self, holds: Callable[[States], bool], deadline_s: float = START_S) -> float | None:
        """The monotonic time at which the states fulfil ``holds``; None if they do not in time."""
        deadline = time.monotonic() + deadline_s
        while not holds(self.states):
            if time.monotonic() > deadline:
                return None
            self.take(LOOK_S)
        return time.monotonic()

    def begin(self) -> None:
        """Begin the time of link faults: their windows count from now."""
        self._began = time.monotonic()

    def pass_time(self, duration_s: float) -> None:
        """Listen for ``duration_s``."""
        self.wait_until(lambda _: False, duration_s)

    def forget_silences(self) -> None:
        """Begin to measure ``longest_silence`` now."""
        self._silence = 0.0

    def longest_silence(self) -> float:
        """The longest time between two states of one area that arrived since ``forget_silences``, s."""
        return self._silence

    def describe(self) -> str:
        """Notes of the areas and gap to the centralised estimate, as text."""
        notes = [
            f"{name} {state.quality}: {'; '.join(state.notes)}" for name, state in self.states.items() if state.notes
        ]
        return "; ".join([f"gap {self.gap(self.states):.2g}", *notes, *self.strays])

    def gap(self, states: States) -> float:
        """The largest difference to the centralised estimate of the same scan, p.u. and rad.

        Infinite while an area has no estimate, angles of its own, or another scan than the rest.
        """
        scans = {states[name].header.scan if name in states else None for name in self.areas}
        if len(scans) > 1 or None in scans:
            return float("inf")
        vm, va = self._centralised(scans.pop())
        gaps = []
        for name, rows in self._rows.items():
            state = states[name]
            if not (state.buses and state.referenced):
                return float("inf")
            gaps += [abs(np.array(state.vm) - vm[rows]).max(), abs(np.array(state.va) - va[rows]).max()]
        return float(max(gaps))

    def _keep(self, at: float, state: object) -> None:
        if isinstance(state, StateMessage):
            last = self.states.get(state.header.sender)
            silence = at - self.received_at.get(state.header.sender, at)
            self.received_at[state.header.sender] = at
            self._silence = max(self._silence, silence)
            over_s = PATIENCE_HEARTBEATS * self.scenario.run.beat_s
            if last is None or not is_old(state.header.order, last.header.order, silence, over_s):
                self.states[state.header.sender] = state

    def _estimate(self, scan: int) -> tuple[np.ndarray, np.ndarray]:
        report = estimate_centralised(self.scenario, make_telemetry(self.scenario, scan)).report
        assert report is not None, "the centralised estimate of a shipped network"
        return report.result.vm, report.result.va
