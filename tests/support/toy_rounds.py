"""The protocol of rounds with the numbers of the toy, on a bus that does what a schedule says."""

from __future__ import annotations

import functools
import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from agents.area_files.area_file import stamp_split
from agents.messages.packing import (
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    StateMessage,
    TelemetryMessage,
    UpMessage,
)
from agents.protocol.configuration import Configuration
from agents.protocol.events import Conclude, Event, PresenceChanged, Publish, Received
from agents.protocol.quality import GOOD
from agents.protocol.rounds import RoundsProtocol
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind, Meter
from scenarios.scenario import load_scenario

HEARTBEAT_S = 0.2
TRAVEL_S = 0.001
STARTED_AT = 1.7e9
MOST_WAKES = 50  # at one moment, of one area, before it counts as a busy loop
MOST_PER_SECOND = 400  # messages on one link, as a mean over a second: a flood
TRUNK, REST = range(6, 19), range(26, 34)
TREES = {
    "three in a row": {"a": [1, 2, *range(19, 23)], "b": [*range(2, 7), 23, 24, 25], "c": [*TRUNK, *REST]},
    "four in a row": {
        "a": [1, 2, *range(19, 23)],
        "b": [2, 3, 23, 24, 25],
        "c": [3, 4, 5, 6],
        "d": [*TRUNK, *REST],
    },
    "star of four": {
        "h": [1, 2, 3, 4, 5, 6],
        "x": [2, *range(19, 23)],
        "y": [3, 23, 24, 25],
        "z": [*TRUNK, *REST],
    },
}
RoundsMessage = UpMessage | DownMessage | HeartbeatMessage


@functools.cache
def files_of(tree: str) -> dict[str, Configuration]:
    """Every area of one of ``TREES`` has one meter."""
    network = load_scenario("ieee33").network
    files = {}
    for area in build_partition(network, TREES[tree]).areas:
        meter = Meter(MeasurementKind.VM, area.network.buses[-1].id)
        files[area.name] = Configuration("toy", area, (meter,), "information", ("tcp/127.0.0.1:0",), beat_s=HEARTBEAT_S)
    return dict(zip(files, stamp_split(list(files.values()), time=0.0), strict=True))


def deliver_all(sender: str, receiver: str, message: RoundsMessage) -> float | None:
    return TRAVEL_S


class ToyBus:
    """``fate``: (sender, receiver, message) -> how long the message travels, None if it is lost.

    ``decided``: (scan, revision, decider, its incarnation, k) -> the verdict and its totals.
    """

    def __init__(self, tree: str, fate: Callable[[str, str, RoundsMessage], float | None] = deliver_all) -> None:
        self.files = files_of(tree)
        self.fate = fate
        self.now = 0.0
        self.scan = 0
        self.protocols: dict[str, RoundsProtocol] = {}
        self.states: dict[str, StateMessage] = {}
        self.cuts: set[tuple[str, str]] = set()
        self.decided: dict[tuple, tuple] = {}
        self.sent: Counter[tuple[str, str]] = Counter()
        self.sent_of_rounds: Counter[tuple[str, str]] = Counter()
        self.last_heartbeat: dict[tuple[str, str], HeartbeatMessage] = {}
        self.handled = 0
        self.on_handled: Callable[[], None] = lambda: None
        self.values: dict[str, float] = {}  # the newest reading of every area
        self.has_tokens = True  # whether areas learn at once that a neighbour has ended
        self._telemetry: dict[str, TelemetryMessage] = {}
        self._wake: dict[str, float] = {}
        self._wakes: Counter[tuple[str, float]] = Counter()
        self._frozen: dict[str, list[Event]] = {}
        self._incarnations: Counter[str] = Counter()
        self._queue: list = []
        self._order = itertools.count()
        self._sequence = itertools.count(1)
        for name in self.files:
            self.start(name)
        self.next_scan()
        self.at(HEARTBEAT_S, self._repeat_telemetry)

    # What may happen

    def at(self, time: float, function: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (time, next(self._order), "", function))

    def start(self, name: str, clock_offset: float = 0.0) -> None:
        """A new incarnation, whose wall clock is ahead by ``clock_offset``, s."""
        if name in self.protocols:
            return
        self._incarnations[name] += 1
        started_at = STARTED_AT + self.now + clock_offset
        incarnation = Incarnation(int(started_at * 1000) + self._incarnations[name], self._incarnations[name])
        protocol = RoundsProtocol(self.files[name], incarnation, now=self.now, started_at=started_at)
        protocol.round.estimation.find_term = lambda: protocol.term
        self.protocols[name] = protocol
        self._push(self.now, name, None)
        self._post_presence(name, alive=True)
        self.send_telemetry(name)

    def kill(self, name: str) -> None:
        if self.protocols.pop(name, None) is not None:
            self._frozen.pop(name, None)
            self._post_presence(name, alive=False)

    def lose_token(self, name: str) -> None:
        """The process goes on, but its neighbours learn that it has ended."""
        self._post_presence(name, alive=False)

    def freeze(self, name: str) -> None:
        if name in self.protocols:
            self._frozen.setdefault(name, [])

    def thaw(self, name: str) -> None:
        for event in self._frozen.pop(name, []):
            self._push(self.now, name, event)
        self._push(self.now, name, None)

    def cut(self, *directions: tuple[str, str]) -> None:
        self.cuts |= set(directions)

    def heal(self, *directions: tuple[str, str]) -> None:
        self.cuts -= set(directions)

    def next_scan(self, late_s: Mapping[str, float] | None = None, without: Sequence[str] = ()) -> None:
        """``late_s``: area -> by how much its readings are late; those of ``without`` never come."""
        self.scan += 1
        for name in self.files:
            self.values[name] = 1 + 1e-3 * self.scan
            if name not in without:
                self.at(self.now + (late_s or {}).get(name, 0.0), functools.partial(self.read, name, self.scan))

    def read(self, name: str, scan: int, value: float | None = None, incarnation: int = 0) -> None:
        """The plant has readings of an area; those of a scan before its newest it keeps to itself."""
        last = self._telemetry.get(name)
        if last is not None and scan < last.header.scan and incarnation == last.header.incarnation.start_ms:
            return
        value = 1 + 1e-3 * scan if value is None else value
        if scan >= self.scan:
            self.values[name] = value
        header = Header("toy", "plant", Incarnation(incarnation, 0), scan, next(self._sequence), STARTED_AT + self.now)
        meter = self.files[name].meters[0]
        self._telemetry[name] = TelemetryMessage(header, name, (meter.id,), (value,), (0.01,), (header.time,), (True,))
        self.send_telemetry(name)

    def send_telemetry(self, name: str) -> None:
        if name in self._telemetry:
            self._push(self.now + TRAVEL_S, name, Received(self._telemetry[name], ""))

    def post(self, name: str, event: Event) -> None:
        """``event`` happens to an area now."""
        self._push(self.now, name, event)

    # What follows

    def run(self, duration_s: float) -> None:
        end = self.now + duration_s
        while self._queue and self._queue[0][0] < end:
            self._step()
        self.now = end

    def run_until_at_rest(self, limit_s: float) -> None:
        """Until every area is good on the last scan, by then or never."""
        end = self.now + limit_s
        while missing := self.find_missing():
            assert self.now < end, f"not at rest: {missing}"
            self.run(HEARTBEAT_S)

    def find_chatter(self) -> int:
        """The most messages on one link in two seconds."""
        before = self.sent.copy()
        self.run(2.0)
        return max((self.sent - before).values())

    def find_missing(self) -> list[str]:
        """What is missing to the end of the last scan everywhere."""
        missing = [f"{name} is dead" for name in self.files.keys() - self.protocols.keys()]
        for name, protocol in sorted(self.protocols.items()):
            outcome, where = protocol.outcome, f"{name} at {protocol.term}, round {protocol.round.k}"
            if outcome is None or protocol.scan != self.scan:
                missing.append(f"{where}: not final, waits for {protocol.round.links}")
            elif outcome.totals.areas != len(self.files) or outcome.totals.silent or outcome.totals.stale:
                missing.append(f"{where}: final on {outcome.totals}")
            elif protocol.round.estimation.reading != self.values[name]:
                missing.append(f"{where}: final with readings that are not its newest")
            elif name not in self.states or self.states[name].quality != GOOD:
                missing.append(f"{where}: not good")
        return missing

    def _post_presence(self, name: str, alive: bool) -> None:
        for n in self.files[name].area.neighbours if self.has_tokens else ():
            self._push(self.now + TRAVEL_S, n.area, PresenceChanged(name, alive))
            if alive and n.area in self.protocols:
                self._push(self.now + TRAVEL_S, name, PresenceChanged(n.area, True))

    def _repeat_telemetry(self) -> None:
        for name in self.files:
            self.send_telemetry(name)
        self.at(self.now + HEARTBEAT_S, self._repeat_telemetry)

    def _push(self, at: float, name: str, event: Event | None) -> None:
        heapq.heappush(self._queue, (at, next(self._order), name, event))

    def _step(self) -> None:
        """The next moment; who is concerned acts in the order of names."""
        self.now = self._queue[0][0]
        events: dict[str, list[Event]] = {}
        while self._queue and self._queue[0][0] <= self.now:
            _, _, name, event = heapq.heappop(self._queue)
            if not name:
                event()
            elif event is not None:
                events.setdefault(name, []).append(event)
            else:
                events.setdefault(name, [])
        for name in sorted(events):
            if name in self._frozen:
                self._frozen[name] += events[name]
            elif name in self.protocols and (events[name] or self._wake.get(name, 0.0) <= self.now):
                self._act(name, events[name])

    def _act(self, name: str, events: Sequence[Event]) -> None:
        protocol = self.protocols[name]
        for action in protocol.handle(events, self.now):
            if isinstance(action, Conclude):  # for the log
                continue
            assert isinstance(action, Publish)
            message = action.message
            if isinstance(message, StateMessage):
                self.states[name] = message
                counted = len(protocol.round.estimation.final)
                assert message.quality != GOOD or counted == len(self.files), f"{name} is good on {counted} areas"
            elif action.to is not None and not isinstance(message, LoadMessage):
                self._send(name, action.to, message)
        self._check(name, protocol)
        at = self.now + protocol.wait_s(self.now)
        self._wakes[name, self.now] += at == self.now
        assert self._wakes[name, self.now] < MOST_WAKES, f"{name} is busy without an end at {self.now}"
        if at != self._wake.get(name) or at == self.now:
            self._wake[name] = at
            self._push(at, name, None)
        self.handled += 1
        self.on_handled()

    def _send(self, name: str, to: str, message: RoundsMessage) -> None:
        self.sent[name, to] += 1
        if isinstance(message, HeartbeatMessage):
            self.last_heartbeat[name, to] = message
        else:
            self.sent_of_rounds[name, to] += 1
        assert self.sent[name, to] < MOST_PER_SECOND * (self.now + 1), f"{name} floods {to}"
        if isinstance(message, DownMessage):
            key = (message.header.scan, message.revision, message.decider, message.incarnation, message.k)
            decided = self.decided.setdefault(key, (message.verdict, message.totals))
            assert decided == (message.verdict, message.totals), f"two verdicts of {key}"
        travel_s = None if (name, to) in self.cuts else self.fate(name, to, message)
        if travel_s is not None:
            self._push(self.now + travel_s, to, Received(message, name))

    def _check(self, name: str, protocol: RoundsProtocol) -> None:
        """What holds at the end of a term."""
        assert not protocol._peers.distrusted, f"{name} does not believe {protocol._peers.distrusted}"
        outcome, parts = protocol.outcome, protocol.round.estimation.final
        if outcome is not None:
            counted = sorted(area for area, _, _ in parts)
            assert len(counted) == outcome.totals.areas, f"{name} counts {outcome.totals.areas}, in it are {counted}"
