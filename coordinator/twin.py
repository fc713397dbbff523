"""The twin: areas in one process on a simulated bus in virtual time, repeatable to the bit.

Protocol, strategies, lossy links, encoding and decoding are those of real runs; only bus and clock are simulated.
Virtual time passes while messages travel and areas wait for their beat; computing takes none.
"""

from __future__ import annotations

import heapq
import itertools
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from agents.area_file import AreaFile
from agents.link import LossyLink, draw_fate
from agents.messages import Header, Incarnation, Message, StateMessage, decode
from agents.protocol import AreaProtocol, Event, Finish, PresenceChanged, Publish, Received
from agents.strategies import make_strategy
from coordinator.plant import make_message
from dsse_core.errors import InvalidInputError
from dsse_core.measurement import Measurement

LONGEST_S = 86400.0
STARTED_AT = 1.7e9  # s since 1970: what virtual time 0 is called in messages


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """What the twin's links do to messages that are not lost; different delays make messages overtake each other.

    A message takes ``delay_s`` plus a part of ``jitter_s``, uniformly drawn; with probability ``duplicate`` it
    arrives a second time, after a delay of its own. As with losses, its fate depends on the seed, the link and
    its number alone.
    """

    delay_s: float = 0.001
    jitter_s: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        problems = []
        if not 0 < self.delay_s <= LONGEST_S:
            problems.append(f"delay is {self.delay_s} s; it must be positive and at most {LONGEST_S} s")
        if not 0 <= self.jitter_s <= LONGEST_S:
            problems.append(f"jitter is {self.jitter_s} s; it must be 0 to {LONGEST_S} s")
        if not 0 <= self.duplicate <= 1:
            problems.append(f"probability of a duplicate is {self.duplicate}; it must be 0 to 1")
        if problems:
            raise InvalidInputError("faults of the twin's links", problems)

    def describe(self) -> str:
        """In words, for people."""
        jitter = f" to {(self.delay_s + self.jitter_s) * 1000:g}" if self.jitter_s else ""
        return f"delay {self.delay_s * 1000:g}{jitter} ms" + (
            f", {self.duplicate:.3g} sent twice" if self.duplicate else ""
        )


class SimulatedBus:
    """Areas joined by links that can fail, be cut and healed; areas can be killed and started again.

    Args:
        files: what each area's agent would read.
        telemetry: area -> its measurements of the first scan.
        on_state, on_presence: told at once, as a watcher who misses nothing, of every state that an area
            publishes (at, state), and when its presence token appears or vanishes (at, area, alive).
    """

    def __init__(
        self,
        files: Sequence[AreaFile],
        telemetry: Mapping[str, Sequence[Measurement]],
        faults: LinkFaults | None = None,
        on_state: Callable[[float, StateMessage], None] = lambda at, state: None,
        on_presence: Callable[[float, str, bool], None] = lambda at, area, alive: None,
    ) -> None:
        self.now = 0.0
        self.scan = 0
        self.files = {content.area.name: content for content in files}
        self.telemetry = dict(telemetry)
        self.states: dict[str, StateMessage] = {}
        self.protocols: dict[str, AreaProtocol] = {}
        self.links: dict[str, LossyLink] = {}
        self._faults = faults or LinkFaults()
        self._on_state = on_state
        self._on_presence = on_presence
        self._queue: list[tuple[float, int, str, Event | None]] = []  # None: the area's beat, or its wish to go on
        self._order = itertools.count()
        self._wake: dict[str, float] = {}
        self._carried: Counter[tuple[str, str]] = Counter()
        self._cut: set[tuple[str, str]] = set()
        self._lives: Counter[str] = Counter()
        for name in self.files:
            self.start(name)
        self.next_scan(telemetry)

    def start(self, name: str) -> None:
        """Start or restart an area, as a new process would; it has to be sent its telemetry."""
        content = self.files[name]
        self._lives[name] += 1
        incarnation = Incarnation(int(STARTED_AT * 1000) + self._lives[name], zlib.crc32(name.encode()))
        self.protocols[name] = AreaProtocol(
            content, make_strategy(content), incarnation, now=self.now, started_at=STARTED_AT + self.now
        )
        self.links[name] = LossyLink(
            name, content.links, content.seed, lambda to, _, payload: self._put(name, to, payload)
        )
        self._wake_in_time(name)
        self._on_presence(self.now, name, True)
        for n in content.area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=True))
            if n.area in self.protocols:
                self.post(name, PresenceChanged(n.area, alive=True))

    def kill(self, name: str) -> None:
        """End an area without a word; its presence token vanishes."""
        del self.protocols[name]
        self.states.pop(name, None)
        self._on_presence(self.now, name, False)
        for n in self.files[name].area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=False))

    def cut(self, one: str, other: str) -> None:
        """Let nothing pass between two areas."""
        self._cut |= {(one, other), (other, one)}

    def heal(self, one: str, other: str) -> None:
        self._cut -= {(one, other), (other, one)}

    def next_scan(self, telemetry: Mapping[str, Sequence[Measurement]]) -> None:
        """Send every area the readings of a new scan."""
        self.scan += 1
        self.telemetry = dict(telemetry)
        for name in self.files:
            self.send_telemetry(name)

    def send_telemetry(self, name: str) -> None:
        """Send one area its readings of the present scan, as the plant does when it appears."""
        header = Header(self.files[name].run, "plant", Incarnation(0, 0), self.scan, self.scan, STARTED_AT + self.now)
        self.post(name, Received(make_message(header, name, self.telemetry[name]), ""))

    def post(self, receiver: str, event: Event, delay_s: float | None = None) -> None:
        """Have ``event`` happen to ``receiver`` after ``delay_s``, by default the links' delay without jitter."""
        self._push(self.now + (self._faults.delay_s if delay_s is None else delay_s), receiver, event)

    def run(self, duration_s: float) -> None:
        """Let ``duration_s`` of virtual time pass."""
        end = self.now + duration_s
        while self._queue and self._queue[0][0] < end:
            self._step()
        self.now = end

    def deliver(self, sender: str, receiver: str, message: Message) -> None:
        """Hand a message that was not lost to the link's delays."""
        faults, seed = self._faults, self.files[sender].seed
        number = self._carried[sender, receiver]
        self._carried[sender, receiver] += 1

        def draw(what: str) -> float:  # no area has a / in its name: a draw of its own, not that of the loss
            return draw_fate(seed, sender, f"{receiver}/{what}", number)

        event = Received(message, sender)
        self.post(receiver, event, faults.delay_s + faults.jitter_s * (draw("delay") if faults.jitter_s else 0.0))
        if faults.duplicate and draw("duplicate") < faults.duplicate:
            self.post(receiver, event, faults.delay_s + faults.jitter_s * draw("second delay"))

    def _step(self) -> None:
        """Go to the next moment at which anything happens; who is concerned acts in the order of names."""
        self.now = self._queue[0][0]
        happening: dict[str, list[Event]] = {}
        while self._queue and self._queue[0][0] <= self.now:
            _, _, name, event = heapq.heappop(self._queue)
            if event is not None:
                happening.setdefault(name, []).append(event)
            elif self._wake.get(name) == self.now:
                happening.setdefault(name, [])
        for name in sorted(happening):
            if name in self.protocols:
                self._act(name, happening[name])

    def _act(self, name: str, events: Sequence[Event]) -> None:
        for action in self.protocols[name].handle(events, self.now):
            match action:
                case Publish(message, to):
                    self.links[name].send(message, to)
                case Finish():
                    self.kill(name)
                    return
        self._wake_in_time(name)

    def _wake_in_time(self, name: str) -> None:
        at = self.now + self.protocols[name].wait_s(self.now)
        if at == self.now or at != self._wake.get(name):
            self._wake[name] = at
            self._push(at, name, None)

    def _put(self, sender: str, receiver: str | None, payload: bytes) -> None:
        """What a link hands to the bus: a state to who watches, a message to a neighbour."""
        message = decode(payload)
        if receiver is None:
            assert isinstance(message, StateMessage)
            self.states[sender] = message
            self._on_state(self.now, message)
        elif (sender, receiver) not in self._cut:
            self.deliver(sender, receiver, message)

    def _push(self, at: float, name: str, event: Event | None) -> None:
        heapq.heappush(self._queue, (at, next(self._order), name, event))
