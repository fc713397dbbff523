"""The simulator as protocol tests use it: what was delivered, what shall not be, and whether the areas have settled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from agents.area_files.area_file import AreaFile
from agents.messages.checks import MessageError
from agents.messages.packing import Message, TelemetryMessage, decode
from agents.protocol.rounds import RoundsProtocol
from coordinator.deployment.split import area_files
from coordinator.simulator import simulator
from dsse_core.grid.measurement import Measurement
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import Telemetry, make_telemetry


class SimulatedBus(simulator.SimulatedBus):
    """``delivered``: (time, sender, receiver, message) of all that no link lost and ``reject_delivery`` let pass."""

    def __init__(
        self,
        files: Sequence[AreaFile],
        telemetry: Mapping[str, Sequence[Measurement]],
        **watchers: Callable[..., None],
    ) -> None:
        self.delivered: list[tuple[float, str, str, Message]] = []
        self._cut: set[tuple[str, str]] = set()
        self.reject_delivery = lambda sender, receiver, message: False
        super().__init__(files, telemetry, **watchers)

    def cut(self, one: str, other: str) -> None:
        """Let nothing pass between two areas."""
        self._cut |= {(one, other), (other, one)}

    def heal(self, one: str, other: str) -> None:
        self._cut -= {(one, other), (other, one)}

    def deliver(self, sender: str, receiver: str, payload: bytes) -> None:
        if (sender, receiver) in self._cut:
            return
        try:
            message = decode(payload)
        except MessageError:
            super().deliver(sender, receiver, payload)
            return
        if not self.reject_delivery(sender, receiver, message):
            self.delivered.append((self.now, sender, receiver, message))
            super().deliver(sender, receiver, payload)

    @property
    def settled(self) -> bool:
        """Every area is referenced, of the plant's scan, and has received the last message of its neighbours."""
        scans = {self.scan + self.offset_of(name) for name in self.protocols}
        return self.states.keys() == self.files.keys() and all(
            state.referenced
            and {state.header.scan} == scans
            and all(self.states[n].sent[name] == received != (0, 0) for n, received in state.received.items())
            for name, state in self.states.items()
        )

    def telemetry_of(self, name: str) -> TelemetryMessage:
        """What the plant says to area ``name``."""
        return self._telemetry[name]

    def offset_of(self, name: str) -> int:
        """From the plant's numbers of scans to those that an area counts; not 0 only if somebody has lied of it."""
        protocol = self.protocols[name]
        return protocol._scan.numbering[1] if isinstance(protocol, RoundsProtocol) else 0

    def set_clock_back(self, name: str, by_ms: int) -> None:
        """Of the process that an area starts in next."""
        self._incarnations[name] -= by_ms

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


def with_links(files: Sequence[AreaFile], faults: LinkFaults) -> list[AreaFile]:
    """``files`` with every link as faulty as ``faults``."""
    return [replace(f, links={n.area: faults for n in f.area.neighbours}) for f in files]


def bus_of(
    name: str, *, loss: float | None = None, seed: int | None = None
) -> tuple[SimulatedBus, Scenario, Telemetry]:
    """A shipped scenario with the simplest strategy on the simulated bus."""
    scenario = replace(load_scenario(name), strategy="angle-offset")
    telemetry = make_telemetry(scenario)
    files = area_files_of(scenario)
    if loss is not None:
        files = [replace(f, seed=seed or 0) for f in with_links(files, LinkFaults(loss=loss))]
    return SimulatedBus(files, telemetry.by_area), scenario, telemetry
