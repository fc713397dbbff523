"""The simulator: areas in one process on a simulated bus in virtual time, repeatable to the bit.

Protocol, strategies, faulty links, encoding and decoding are those of real runs; only bus and clock are simulated.
Every message is encoded and decoded, also states and telemetry: a message that no process could read reaches no
simulated area or watcher. Virtual time passes while messages travel and areas wait for their heartbeat. Computing takes
no virtual time.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import logging
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

from agents.messages.checks import MessageError
from agents.messages.packing import (
    MAX_NEIGHBOUR_BYTES,
    Header,
    Incarnation,
    Message,
    ReadingsMessage,
    StateMessage,
    TelemetryMessage,
    decode,
    encode,
)
from agents.protocol.area_protocol import AreaProtocol
from agents.protocol.choose import make_protocol
from agents.protocol.configuration import Configuration
from agents.protocol.events import (
    ClockSet,
    Event,
    Finish,
    GoOver,
    Offered,
    PresenceChanged,
    Publish,
    Received,
    Rejected,
)
from agents.runtime.link import FaultyLinks
from coordinator.lab.plant.telemetry_messages import NO_STATUS, make_message
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.switches import take_own

log = logging.getLogger(__name__)
TRAVEL_S = 0.001  # of every message, in addition to the delay by the faults of its link
STARTED_AT = 1.7e9  # time of virtual time 0 in messages, s since 1970


@dataclass(frozen=True, slots=True)
class _Wake:
    """Wakes an area at a time that it waits for: its heartbeat, a wish to go on, or a message delayed by its link."""


@dataclass(frozen=True, slots=True)
class _Call:
    """A call of a function at a virtual time, for events outside the areas."""

    function: Callable[[], None]


WAKE = _Wake()
Passed = TypeVar("Passed", bound=Message)


def _pass(message: Passed) -> Passed:
    """``message``, encoded and decoded as on its way to a receiver.

    Raises:
        MessageError: no receiver can read it.
    """
    return cast(Passed, decode(encode(message)))


class SimulatedBus:
    """Areas joined by links that can fail, be cut and healed; areas can be killed, paused and started again.

    Args:
        files: the area file of each area.
        telemetry: area -> its measurements of the first scan. late_s: area -> delay of these measurements, s.
        on_state, on_presence: called without delay with every state that an area publishes (at, state), unless no
            router runs, and when its presence token appears or vanishes (at, area, alive).
        on_message: called with each message that an area sends to a neighbour (at, receiver, message, False), and again
            with each that its link passes on (at, receiver, message, True), where ``at`` is the time of arrival.
        statuses: switch -> status that the plant reads, from the next scan on.
        on_readings: called like ``on_state`` with the readings that an area has used (at, readings).
    """

    def __init__(
        self,
        files: Sequence[Configuration],
        telemetry: Mapping[str, Sequence[Measurement]],
        on_state: Callable[[float, StateMessage], None] = lambda at, state: None,
        on_presence: Callable[[float, str, bool], None] = lambda at, area, alive: None,
        late_s: Mapping[str, float] | None = None,
        on_message: Callable[[float, str, Message, bool], None] = lambda at, receiver, message, arrives: None,
        on_readings: Callable[[float, ReadingsMessage], None] = lambda at, readings: None,
        statuses: Mapping[str, str] = NO_STATUS,
    ) -> None:
        self.now = 0.0
        self.scan = 0
        self.files = {content.area.name: content for content in files}
        self.next_files: dict[str, Configuration] = {}  # area -> the file of the next split beside its file
        self.states: dict[str, StateMessage] = {}
        self.readings: dict[str, ReadingsMessage] = {}
        self.clock_error_s = {content.area.name: content.clock_error_s for content in files}
        self._rejected: Counter[tuple[str, str]] = Counter()  # receiver, reason
        self.protocols: dict[str, AreaProtocol] = {}
        self.links: dict[str, FaultyLinks] = {}
        self.plant_publishes = True
        self.statuses = statuses
        self._on_state = on_state
        self._on_presence = on_presence
        self._on_message = on_message
        self._on_readings = on_readings
        self._queue: list[tuple[float, int, str, Event | _Wake | _Call]] = []
        self._order = itertools.count()
        self._wake: dict[str, float] = {}
        self._paused: dict[str, list[Event]] = {}  # paused area -> events that have arrived meanwhile
        self._incarnations: Counter[str] = Counter()
        self._telemetry: dict[str, TelemetryMessage] = {}  # area -> its newest readings, which the plant repeats
        self.router_runs = True
        for name in self.files:
            self.start(name)
        self.next_scan(telemetry, late_s)
        self._heartbeat_s = min((content.beat_s for content in files), default=1.0)
        self.at(self._heartbeat_s, self._repeat_telemetry)

    def offer(self, name: str, content: Configuration | None) -> None:
        """Puts the file of the next split beside that of an area; None removes it."""
        if content is None:
            self.next_files.pop(name, None)
        else:
            self.next_files[name] = content
        self.post(name, Offered(content), delay_s=0.0)

    def start(self, name: str) -> None:
        """Starts an area as a new process with a new incarnation. The plant sends it its readings at once."""
        self._rest_on_file(name)
        if name in self.next_files:
            self.post(name, Offered(self.next_files[name]), delay_s=0.0)

    def _go_over(self, name: str, content: Configuration) -> None:
        """Switches the process of an area to ``content``, its next file, which replaces the file before."""
        self.files[name] = content
        self.next_files.pop(name, None)
        self._rest_on_file(name)
        self.protocols[name].follow_on()

    def _rest_on_file(self, name: str) -> None:
        content = self.files[name]
        self._incarnations[name] += 1
        incarnation = Incarnation(int(STARTED_AT * 1000) + self._incarnations[name], zlib.crc32(name.encode()))
        started_at = STARTED_AT + self.now + self.clock_error_s.setdefault(name, content.clock_error_s)
        self.protocols[name] = make_protocol(content, incarnation, now=self.now, started_at=started_at)
        links = FaultyLinks(name, content.links, content.seed, lambda to, _, payload: self._put(name, to, payload))
        links.begin(0.0)
        self.links[name] = links
        self._wake_in_time(name)
        self._on_presence(self.now, name, True)
        for n in content.area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=True))
            if n.area in self.protocols:
                self.post(name, PresenceChanged(n.area, alive=True))
        self.send_telemetry(name)

    def kill(self, name: str) -> None:
        """Ends an area without notice. Its presence token vanishes, and messages delayed by its links are lost."""
        if name not in self.protocols:
            return
        del self.protocols[name], self.links[name]
        self._paused.pop(name, None)
        self.states.pop(name, None)
        self._on_presence(self.now, name, False)
        for n in self.files[name].area.neighbours:
            self.post(n.area, PresenceChanged(name, alive=False))

    def pause(self, name: str) -> None:
        """Pauses an area, as SIGSTOP does. Events that arrive meanwhile wait."""
        self._paused.setdefault(name, [])

    def resume(self, name: str) -> None:
        """Lets a paused area continue, with all events that have arrived meanwhile."""
        for event in self._paused.pop(name, []):
            self._push(self.now, name, event)
        self._push(self.now, name, WAKE)
        self._wake[name] = self.now

    def set_clock(self, name: str, error_s: float) -> None:
        """Sets the clock of an area ``error_s`` ahead."""
        self.clock_error_s[name] = error_s
        self.post(name, ClockSet(STARTED_AT + error_s), delay_s=0.0)

    def stop_router(self) -> None:
        """Stops all messages. For every area, the presence tokens of its neighbours vanish."""
        self.router_runs = False
        self._show_all(alive=False)

    def start_router(self) -> None:
        """Lets messages pass again. The presence tokens of all living areas appear to their neighbours."""
        self.router_runs = True
        self._show_all(alive=True)

    def next_scan(
        self,
        telemetry: Mapping[str, Sequence[Measurement]],
        late_s: Mapping[str, float] | None = None,
        measured_at: Mapping[str, float] | None = None,
    ) -> None:
        """Has the plant make a new scan. ``late_s``: area -> delay of its readings, s.

        ``measured_at``: meter id -> virtual time of its reading, if it is not now.
        """
        self.scan += 1
        for name, content in self.files.items():
            header = Header(content.run, "plant", Incarnation(0, 0), self.scan, self.scan, STARTED_AT + self.now)
            statuses = take_own(content.area.network, self.statuses)
            message = make_message(header, name, telemetry[name], statuses)
            if measured_at:
                times = (STARTED_AT + measured_at.get(meter_id, self.now) for meter_id in message.meters)
                message = replace(message, times=tuple(times))
            late = (late_s or {}).get(name, 0.0)
            if late > 0:
                self.at(self.now + late, functools.partial(self._take_over, name, message))
            else:
                self._take_over(name, message)

    def publish_readings(self, message: TelemetryMessage) -> None:
        """Publishes ``message`` for its area, as a gateway beside the plant."""
        if self.router_runs:
            try:
                self.post(message.area, Received(_pass(message), ""))
            except MessageError as error:
                self._reject(message.area, message.header.sender, error)

    def send_telemetry(self, name: str) -> None:
        """Sends an area its newest readings, as the plant does when the area appears."""
        if name in self._telemetry and self.plant_publishes and self.router_runs:
            self.post(name, Received(self._telemetry[name], ""))

    def post(self, receiver: str, event: Event, delay_s: float = TRAVEL_S) -> None:
        """Delivers ``event`` to ``receiver`` after ``delay_s``."""
        self._push(self.now + delay_s, receiver, event)

    def at(self, time: float, function: Callable[[], None]) -> None:
        """Calls ``function`` at virtual time ``time``, before any area acts at that time."""
        self._push(time, "", _Call(function))

    def run(self, duration_s: float) -> None:
        """Lets ``duration_s`` of virtual time pass."""
        end = self.now + duration_s
        while self._queue and self._queue[0][0] < end:
            self._step()
        self.now = end

    def deliver(self, sender: str, receiver: str, payload: bytes) -> None:
        """Sends a payload that its link has passed on to its receiver, which rejects it if it cannot be read."""
        try:
            message = decode(payload, MAX_NEIGHBOUR_BYTES)
            self.post(receiver, Received(message, sender))
            self._on_message(self.now + TRAVEL_S, receiver, message, True)
        except MessageError as error:
            self._reject(receiver, sender, error)

    def _reject(self, receiver: str, sender: str, error: MessageError) -> None:
        self._rejected[receiver, error.reason] += 1
        count = self._rejected[receiver, error.reason]
        self.post(receiver, Rejected(error.reason, count, sender if error.at_field else "", error.at_field))

    def _take_over(self, name: str, message: TelemetryMessage) -> None:
        """Takes new readings of an area into the plant, and sends them, unless the plant has newer ones."""
        try:
            message = _pass(message)
        except MessageError as error:
            self._reject(name, message.header.sender, error)
            return
        last = self._telemetry.get(name)
        if last is None or message.header.order > last.header.order:
            self._telemetry[name] = message
            self.send_telemetry(name)

    def _repeat_telemetry(self) -> None:
        for name in self.files:
            self.send_telemetry(name)
        self.at(self.now + self._heartbeat_s, self._repeat_telemetry)

    def _show_all(self, alive: bool) -> None:
        for name, content in self.files.items():
            for n in content.area.neighbours:
                if n.area in self.protocols:
                    self.post(name, PresenceChanged(n.area, alive))

    def _step(self) -> None:
        """Goes to the time of the next events. The areas concerned act in the order of their names."""
        self.now = self._queue[0][0]
        events: dict[str, list[Event]] = {}
        while self._queue and self._queue[0][0] <= self.now:
            _, _, name, event = heapq.heappop(self._queue)
            match event:
                case _Call(function):
                    function()
                case _Wake():
                    if self._wake.get(name) == self.now:
                        events.setdefault(name, [])
                case _:
                    events.setdefault(name, []).append(event)
        for name in sorted(events):
            if name in self._paused:
                self._paused[name] += events[name]
            elif name in self.protocols:
                self._act(name, events[name])

    def _act(self, name: str, events: Sequence[Event]) -> None:
        self.links[name].release(self.now)
        for action in self.protocols[name].handle(events, self.now):
            match action:
                case Publish(message, None):
                    self._show(self.links[name].with_counts(message))
                case Publish(message, str() as to):
                    self._on_message(self.now, to, message, False)
                    self.links[name].send(message, to, self.now)
                case Finish():
                    self.kill(name)
                    return
                case GoOver(configuration):
                    self._go_over(name, configuration)
                    return
        self._wake_in_time(name)

    def _wake_in_time(self, name: str) -> None:
        at = min(self.now + self.protocols[name].wait_s(self.now), self.links[name].next_due())
        if at == self.now or at != self._wake.get(name):
            self._wake[name] = at
            self._push(at, name, WAKE)

    def _show(self, message: Message) -> None:
        """Passes a message that an area publishes to the watchers, if a router runs."""
        if not self.router_runs:
            return
        try:
            message = _pass(message)
        except MessageError as error:
            log.warning("no watcher can read the %s of %s: %s", message.kind, message.header.sender, error)
            return
        if isinstance(message, StateMessage):
            self.states[message.header.sender] = message
            self._on_state(self.now, message)
        elif isinstance(message, ReadingsMessage):
            self.readings[message.header.sender] = message
            self._on_readings(self.now, message)

    def _put(self, sender: str, receiver: str | None, payload: bytes) -> None:
        """Puts a payload from a link on the bus for a neighbour; drops it if no router runs."""
        if receiver is not None and self.router_runs:
            self.deliver(sender, receiver, payload)

    def _push(self, at: float, name: str, event: Event | _Wake | _Call) -> None:
        heapq.heappush(self._queue, (at, next(self._order), name, event))
