"""The simulator under watch: messages between areas in a scan, and the times at which areas agree and are good."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from agents.messages.packing import Message, StateMessage, decode
from agents.protocol.quality import GOOD
from agents.strategies.installed import load_strategy
from benchmarks.fault_histories.history import World
from coordinator.lab.simulator.simulator import SimulatedBus
from dsse_core.link_faults import LinkFaults

LOAD, HEARTBEAT = "load", "heartbeat"  # kinds that say nothing of a boundary
AGREE = 1e-8  # p.u. and rad, between the voltages of neighbours
SAMPLE_S = 0.01
REST_S = 1.0  # without a new boundary message: five heartbeats
BETWEEN_S = 1.5  # at rest, before the next scan


@dataclass(frozen=True)
class ScanFigures:
    """One scan. Messages are those delivered until rest; all but ``boundary`` count only until all areas are good.

    ``boundary``: first sendings, ``repeats``: of the same. ``acknowledgements``: heartbeats that name a message for the
    first time, ``heartbeats``: all others; ``loads``: load messages. ``agree_s``: from the start of the scan until all
    areas agree and stay so; ``good_s``: until all are good for the first time; nan if never. ``revisions``: the highest
    revision of a message. ``removed``: meters taken out by the centralised estimate. ``gap``: to it in the end, p.u.
    and rad.
    """

    edges: int
    boundary: int
    repeats: int
    acknowledgements: int
    heartbeats: int
    loads: int
    agree_s: float
    good_s: float
    rounds: int
    revisions: int
    removed: int
    gap: float

    @property
    def boundary_per_edge(self) -> float:
        return self.boundary / self.edges


class WatchedBus(SimulatedBus):
    """Areas of ``world`` on sound or lossy links, each message ``hop_s`` under way."""

    def __init__(self, world: World, strategy: str, *, loss: float = 0.0, hop_s: float = 0.001, seed: int = 0) -> None:
        faults = LinkFaults(loss=loss, delay_s=hop_s - 0.001)
        areas = world.partition.areas
        links = {(area.name, n.area): faults for area in areas for n in area.neighbours}
        self._world = world
        self._compares_magnitudes = load_strategy(strategy).reconciles_magnitudes
        self._pairs = [(a.name, n.area, n.bus) for a in areas for n in a.neighbours if a.name < n.area]
        self._named: set[tuple[object, ...]] = set()  # of all scans: numbers of messages go on
        self._begin()
        super().__init__(world.files(links, seed, strategy), world.telemetry[0], self._see)

    def _begin(self) -> None:
        self._began = getattr(self, "now", 0.0)
        self._counts: Counter[str] = Counter()
        self._seen: set[tuple[object, ...]] = set()
        self._rounds = self._revision = 0
        self._good_of: set[str] = set()
        self._good_at = self._agree_at = math.nan
        self._update_at = self._began
        self._voltages: dict[str, dict[int, tuple[float, float]]] = {}
        self._apart: set[tuple[str, str, int]] = set(self._pairs)

    def watch(self, limit_s: float) -> ScanFigures:
        """Run the scan that has just begun until rest, at most for ``limit_s``; its figures."""
        while self.now < self._began + limit_s and not self._is_at_rest():
            self.run(0.05)
        report = self._world.central[self.scan - 1]
        return ScanFigures(
            edges=len(self._pairs),
            boundary=self._counts["boundary"],
            repeats=self._counts["repeats"],
            acknowledgements=self._counts["acknowledgements"],
            heartbeats=self._counts["heartbeats"],
            loads=self._counts["loads"],
            agree_s=self._agree_at - self._began,
            good_s=self._good_at - self._began,
            rounds=self._rounds,
            revisions=self._revision,
            removed=len(report.removed),
            gap=self._find_gap(),
        )

    def go_on(self) -> None:
        """Pass some time at rest, then begin the plant's next scan."""
        self.run(BETWEEN_S)
        self._begin()
        self.next_scan(self._world.telemetry[self.scan])

    def share_good(self, duration_s: float) -> float:
        """The share of the time of all areas in which they are good, from now on for ``duration_s``."""
        samples = round(duration_s / SAMPLE_S)
        good = 0
        for _ in range(samples):
            self.run(SAMPLE_S)
            good += sum(state.quality == GOOD for state in self.states.values())
        return good / (samples * len(self.files))

    def _is_at_rest(self) -> bool:
        is_done = not math.isnan(self._agree_at) and not math.isnan(self._good_at)
        return is_done and self.now >= self._update_at + REST_S

    # Messages between areas

    def deliver(self, sender: str, receiver: str, payload: bytes) -> None:
        self._count(sender, receiver, decode(payload))
        super().deliver(sender, receiver, payload)

    def _count(self, sender: str, receiver: str, message: Message) -> None:
        is_under_way = math.isnan(self._good_at)
        if message.kind == LOAD:
            self._counts["loads"] += is_under_way
        elif message.kind == HEARTBEAT:
            self._count_heartbeat(sender, receiver, message)
        elif (key := (message.kind, sender, receiver, message.header.order)) in self._seen:
            self._counts["repeats"] += is_under_way
        else:
            self._counts["boundary"] += 1
            self._update_at = self.now
            self._seen.add(key)
            self._rounds = max(self._rounds, getattr(message, "k", -1) + 1)
            self._revision = max(self._revision, getattr(message, "revision", 0))

    def _count_heartbeat(self, sender: str, receiver: str, message: Message) -> None:
        if math.isnan(self._good_at):
            received = getattr(message, "received", (0, 0))
            key = (sender, receiver, received)
            is_first = any(received) and key not in self._named
            self._named.add(key)
            self._counts["acknowledgements" if is_first else "heartbeats"] += 1

    # Published states

    def _see(self, at: float, state: StateMessage) -> None:
        if state.header.scan != self.scan:
            return
        name = state.header.sender
        (self._good_of.add if state.quality == GOOD else self._good_of.discard)(name)
        if math.isnan(self._good_at) and len(self._good_of) == len(self._world.partition.areas):
            self._good_at = at
        self._voltages[name] = dict(zip(state.buses, zip(state.vm, state.va, strict=True), strict=True))
        for pair in self._pairs_of(name):
            (self._apart.discard if self._agrees(*pair) else self._apart.add)(pair)
        if self._apart or len(self._voltages) < len(self._world.partition.areas):
            self._agree_at = math.nan
        elif math.isnan(self._agree_at):
            self._agree_at = at

    def _pairs_of(self, name: str) -> Iterator[tuple[str, str, int]]:
        for n in self._world.partition.area(name).neighbours:
            yield (*sorted((name, n.area)), n.bus)  # type: ignore[misc]

    def _agrees(self, one: str, other: str, bus: int) -> bool:
        if not (self._voltages.get(one) and self._voltages.get(other)):
            return False
        (vm, va), (other_vm, other_va) = self._voltages[one][bus], self._voltages[other][bus]
        is_same_vm = not self._compares_magnitudes or abs(vm - other_vm) <= AGREE
        return is_same_vm and abs(math.remainder(va - other_va, 2 * math.pi)) <= AGREE

    def _find_gap(self) -> float:
        result, row = self._world.central[self.scan - 1].result, self._world.network.row
        return max(
            (
                max(abs(vm - result.vm[row[bus]]), abs(math.remainder(va - result.va[row[bus]], 2 * math.pi)))
                for voltages in self._voltages.values()
                for bus, (vm, va) in voltages.items()
            ),
            default=math.nan,
        )
