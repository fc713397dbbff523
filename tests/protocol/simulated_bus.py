"""A bus in virtual time for protocol tests: the real protocol, strategies and lossy links, no sockets, no sleeping."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from agents.area_file import AreaFile
from agents.link import LossyLink
from agents.messages import Header, Incarnation, Message, StateMessage, TelemetryMessage, decode
from agents.protocol import AreaProtocol, Event, Finish, PresenceChanged, Publish, Received
from agents.strategies import make_strategy
from coordinator.split import area_files
from dsse_core.measurement import Measurement, Source
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import Telemetry, make_telemetry

DELAY_S = 0.001


class SimulatedBus:
    """Areas joined by links that deliver after ``DELAY_S``, drop what their faults say, and can be cut and healed."""

    def __init__(self, files: Sequence[AreaFile], telemetry: Mapping[str, Sequence[Measurement]]) -> None:
        self.now = 0.0
        self.files = {content.area.name: content for content in files}
        self.telemetry = dict(telemetry)
        self.states: dict[str, StateMessage] = {}
        self.delivered: list[tuple[float, str, str, Message]] = []
        self.refuse_delivery = lambda sender, receiver, message: False
        self._queue: list[tuple[float, int, str, Event]] = []
        self._order = itertools.count()
        self._cut: set[tuple[str, str]] = set()
        self._lives: dict[str, int] = {}
        self.protocols: dict[str, AreaProtocol] = {}
        self.links: dict[str, LossyLink] = {}
        for name in self.files:
            self.start(name)
        self.scan = 0
        self.next_scan(telemetry)

    def start(self, name: str) -> None:
        """Start or restart an area, as a new process would."""
        content = self.files[name]
        life = self._lives[name] = self._lives.get(name, 0) + 1
        self.protocols[name] = AreaProtocol(
            content, make_strategy(content), Incarnation(life, 0), now=self.now, started_at=1e9 + self.now
        )
        self.links[name] = LossyLink(
            name, content.loss, content.seed, lambda to, kind, payload: self._deliver(name, to, payload)
        )
        for n in content.area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=True))

    def kill(self, name: str) -> None:
        del self.protocols[name]
        del self.states[name]
        for n in self.files[name].area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=False))

    def cut(self, one: str, other: str) -> None:
        self._cut |= {(one, other), (other, one)}

    def heal(self, one: str, other: str) -> None:
        self._cut -= {(one, other), (other, one)}

    def next_scan(self, telemetry: Mapping[str, Sequence[Measurement]]) -> None:
        self.scan += 1
        self.telemetry = dict(telemetry)
        for name in self.files:
            self.send_telemetry(name)

    def send_telemetry(self, name: str) -> None:
        read = [m for m in self.telemetry[name] if m.meter.source is not Source.VIRTUAL]
        header = Header(self.files[name].run, "plant", Incarnation(0, 0), self.scan, self.scan, 1e9 + self.now)
        message = TelemetryMessage(
            header,
            name,
            meters=tuple(m.meter.id for m in read),
            values=tuple(m.value for m in read),
            sigmas=tuple(m.sigma for m in read),
        )
        self.post(name, Received(message, ""))

    def post(self, receiver: str, event: Event, delay_s: float = DELAY_S) -> None:
        heapq.heappush(self._queue, (self.now + delay_s, next(self._order), receiver, event))

    def run(self, duration_s: float) -> None:
        """Let ``duration_s`` of virtual time pass."""
        end = self.now + duration_s
        while True:
            beats = [(self.now + p.wait_s(self.now), name) for name, p in self.protocols.items()]
            news = self._queue[0][0] if self._queue else float("inf")
            self.now = min(end, news, min(beats)[0])
            if self.now >= end:
                return
            arrived: dict[str, list[Event]] = {}
            while self._queue and self._queue[0][0] <= self.now:
                _, _, receiver, event = heapq.heappop(self._queue)
                arrived.setdefault(receiver, []).append(event)
            due = {name for beat, name in beats if beat <= self.now}
            for name in sorted(due | arrived.keys()):
                if name in self.protocols:
                    self._act(name, arrived.get(name, []))

    def _act(self, name: str, events: Sequence[Event]) -> None:
        for action in self.protocols[name].handle(events, self.now):
            match action:
                case Publish(message, to):
                    self.links[name].send(message, to)
                case Finish():
                    del self.protocols[name]

    def _deliver(self, sender: str, receiver: str | None, payload: bytes) -> None:
        message = decode(payload)
        if receiver is None:
            assert isinstance(message, StateMessage)
            self.states[sender] = message
        elif (sender, receiver) not in self._cut and not self.refuse_delivery(sender, receiver, message):
            self.delivered.append((self.now, sender, receiver, message))
            self.post(receiver, Received(message, sender))

    @property
    def settled(self) -> bool:
        """Every area is referenced and has heard the last word of its neighbours."""
        return self.states.keys() == self.files.keys() and all(
            state.referenced
            and state.header.scan == self.scan
            and all(self.states[n].sent[name] == heard != (0, 0) for n, heard in state.heard.items())
            for name, state in self.states.items()
        )

    def run_until_settled(self, limit_s: float = 120.0) -> None:
        deadline = self.now + limit_s
        while not self.settled:
            assert self.now < deadline, {name: state.notes for name, state in self.states.items()}
            self.run(0.05)

    def voltages(self) -> dict[int, list[complex]]:
        """Bus -> the voltage that each area sees there, p.u."""
        seen: dict[int, list[complex]] = {}
        for state in self.states.values():
            for bus, vm, va in zip(state.buses, state.vm, state.va, strict=True):
                seen.setdefault(bus, []).append(vm * complex(np.cos(va), np.sin(va)))
        return seen


def area_files_of(scenario: Scenario, **changes: object) -> list[AreaFile]:
    """What ``dsse split`` would write for each area; ``changes`` replace fields of every file."""
    files = area_files(scenario, run="sim", endpoints=("tcp/127.0.0.1:7447",))
    return [replace(content, **changes) for content in files]


def bus_of(
    name: str, *, loss: float | None = None, seed: int | None = None
) -> tuple[SimulatedBus, Scenario, Telemetry]:
    """A shipped scenario on the simulated bus."""
    scenario = load_scenario(name)
    telemetry = make_telemetry(scenario)
    files = area_files_of(scenario)
    if loss is not None:
        files = [replace(f, loss={n.area: loss for n in f.area.neighbours}, seed=seed or 0) for f in files]
    return SimulatedBus(files, telemetry.by_area), scenario, telemetry
