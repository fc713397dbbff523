"""The loop of an agent: bus and clock on one side, the protocol on the other."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from agents.messages.checks import MessageError
from agents.messages.keys import (
    all_from_neighbours,
    all_incarnations,
    all_telemetry,
    clock_key,
    command_key,
    incarnation_of,
    live_key,
    name_of_live,
    neighbour_key,
    readings_key,
    state_key,
)
from agents.messages.packing import (
    ClockMessage,
    HeartbeatMessage,
    Incarnation,
    ReadingsMessage,
    StateMessage,
    decode,
)
from agents.orders.order_book import OrderBook
from agents.protocol.choose import kinds_of, make_protocol
from agents.protocol.configuration import Configuration
from agents.protocol.events import (
    ClockSet,
    Conclude,
    Event,
    Finish,
    GoOver,
    Offered,
    PresenceChanged,
    Publish,
    StopRequested,
)
from agents.runtime.duplicate_guard import GIVES_WAY, DuplicateGuard, ReplacedError
from agents.runtime.heap import Heap
from agents.runtime.inbox import Inbox
from agents.runtime.ingress_filter import IngressFilter
from agents.runtime.link import FaultyLinks
from agents.runtime.log import ChangeLog
from agents.runtime.next_file import NextFile
from agents.runtime.presence import Presence, begin_incarnation, read_leave
from agents.runtime.renewal import Renewal
from agents.runtime.watchdog import Watchdog
from agents.transport.renewable_bus import Declaration
from agents.transport.zenoh_bus import Session
from dsse_core.grid.measurement import Source

LEAST_STEP_S = 1e-3  # a smaller change of the clock is not reported
QUICK_S = 1e-4  # two clocks read in a longer time were not read at one moment: the process was interrupted
log = logging.getLogger(__name__)


class HostClock:
    """``offset``: from monotonic to wall-clock time, s.

    Args:
        error_s: injected fault: lead of the clock, s.
    """

    def __init__(self, error_s: float = 0.0) -> None:
        self._error_s = error_s
        self.offset = self._read()[0]

    def has_been_set(self) -> bool:
        """True where the clock has been set since the last call; ``offset`` is then the new one.

        False where the two clocks could not be read at one moment; a later call finds the change.
        """
        offset, is_certain = self._read()
        if not is_certain or abs(offset - self.offset) <= LEAST_STEP_S:
            return False
        self.offset = offset
        return True

    def _read(self) -> tuple[float, bool]:
        """The offset, and whether both clocks were read at one moment."""
        before = time.monotonic()
        wall = time.time()
        return wall + self._error_s - before, time.monotonic() - before < QUICK_S


@dataclass(frozen=True, slots=True)
class _TokenSeen:
    """The token of an incarnation, of a neighbour or of this area, appeared, or vanished after a leave message."""

    key: str
    alive: bool
    leave_reason: str = ""


@dataclass(frozen=True, slots=True)
class _OutOfSight:
    """All tokens seen so far no longer count: the links are opened again, perhaps with other rules."""


@dataclass(frozen=True, slots=True)
class _ClockReceived:
    """A ``payload`` on the clock's key, received at monotonic time ``at``, s."""

    at: float
    payload: bytes


@dataclass(frozen=True, slots=True)
class _CommandReceived:
    """A ``payload`` on the key of the operator's commands."""

    payload: bytes


def run_agent(
    content: Configuration,
    session: Session,
    inbox: Inbox,
    watchdog: Watchdog | None = None,
    orders: OrderBook | None = None,
    next_file: NextFile | None = None,
) -> str:
    """Take part in the exchange until ``StopRequested`` arrives in ``inbox``; return its reason.

    ``orders``: commands of the operator so far; None: the process follows only those that come from now on.
    ``watchdog``: is told that the area takes part, and that the loop goes on. ``next_file``: watches the file of the
    next split. When all areas go over to that file, the process goes on with it as a new incarnation, on the same
    links.

    Raises:
        ReplacedError: another agent of the area runs that began later.
    """
    orders, incarnation = orders or OrderBook.of(content), begin_incarnation()
    process = _Process(session, inbox, watchdog or Watchdog({}), next_file)
    is_first, own = True, frozenset(map(id, session.declarations))
    while True:
        former = [declared for declared in session.declarations if id(declared) not in own]
        end = _run_configuration(content, process, orders, incarnation, former, is_first=is_first)
        if isinstance(end, str):
            return end
        if next_file is not None:
            next_file.take_place(end)
        log.info("area %s goes over to %s", end.area.name, end.identity)
        content, orders, is_first = end, orders.go_over(end), False
        incarnation = begin_incarnation(incarnation)


@dataclass
class _Process:
    """Objects of the process that stay while an area goes over to the next configuration."""

    session: Session
    inbox: Inbox
    watchdog: Watchdog
    next_file: NextFile | None
    heap: Heap = field(default_factory=Heap)
    changes: ChangeLog = field(default_factory=ChangeLog)

    def next_due(self) -> float:
        """Time of the next look at the folder of the area file, monotonic, s; infinity without ``next_file``."""
        return self.next_file.next_due if self.next_file else math.inf


def _run_configuration(
    content: Configuration,
    process: _Process,
    orders: OrderBook,
    incarnation: Incarnation,
    former: Sequence[Declaration],
    *,
    is_first: bool,
) -> str | Configuration:
    """Take part with ``content``; returns the reason for the end of the process, or the next configuration.

    The area subscribes first and shows its presence last: a process that sees the token knows that its messages are
    received. ``former``: declarations of the configuration before, which end then. ``is_first``: there was none before.
    """
    session, inbox, watchdog = process.session, process.inbox, process.watchdog
    now = time.monotonic()
    clock = HostClock(content.clock_error_s)
    protocol = make_protocol(content, incarnation, now=now, started_at=now + clock.offset)
    if not is_first:
        protocol.follow_on()
    kinds = kinds_of(content.strategy)
    links = FaultyLinks(content.area.name, content.links, content.seed, _publishers(content, session, kinds))
    ingress_filter = _listen(content, session, kinds, inbox)
    send_leave = _declare_presence(content, session, incarnation)
    for declared in former:
        session.withdraw(declared)
    backend = protocol.describe_backend()
    how = f"{content.strategy}, back end {backend}" if backend else content.strategy
    log.info("area %s of run %s, strategy %s, incarnation %s", content.area.name, content.run, how, incarnation)
    guard = DuplicateGuard(f"area {content.area.name} of run {content.run}", incarnation, now, content.beat_s)
    intake = _Intake(content.area.name, session, inbox, links, guard, clock, orders)
    events = orders.begin()
    watchdog.ready(now)
    while True:
        now = time.monotonic()
        next_ping = now + watchdog.ping(now)
        for event in events:
            if isinstance(event, Offered):
                ingress_filter.let_in(_heartbeats_from(event.configuration))
        for action in protocol.handle(events, now):
            match action:
                case Publish(message, to):
                    links.send(message, to, now)
                case Conclude():
                    process.changes.take(action, now)
                case GoOver(configuration):
                    for event in events:  # all other events are repeated by their senders, but not this one
                        if isinstance(event, StopRequested):
                            inbox.put("stop", event)
                    return configuration
                case Finish(reason):
                    send_leave(reason.encode())
                    if (at_the_end := protocol.describe_backend()) != backend:
                        log.info("back end of the exchange: %s", at_the_end)
                    return reason
        began, now = now, time.monotonic()
        process.heap.tidy_after(now - began)
        if process.next_file is not None:
            process.next_file.look(now)
        due = min(
            protocol.wait_s(now),
            *(at - now for at in (links.next_due(), guard.next_due(), next_ping, process.next_due())),
        )
        events = intake.take(due)
        try:
            guard.check(time.monotonic())
        except ReplacedError:
            send_leave(GIVES_WAY.encode())
            raise


def _heartbeats_from(configuration: Configuration | None) -> list[str]:
    """The keys of heartbeats from the neighbours of the next configuration."""
    if configuration is None:
        return []
    run, name = configuration.run, configuration.area.name
    return [neighbour_key(run, n.area, HeartbeatMessage.kind, name) for n in configuration.area.neighbours]


def _declare_presence(content: Configuration, session: Session, incarnation: Incarnation) -> Callable[[bytes], None]:
    """Show the token of ``incarnation``; returns the function that sends its leave message."""
    own_token = live_key(content.run, "area", content.area.name, incarnation, content.identity)
    send_leave = session.publisher(own_token)
    session.declare_presence(own_token)
    return send_leave


def _listen(content: Configuration, session: Session, kinds: Sequence[str], inbox: Inbox) -> IngressFilter:
    """Subscribe to all messages and tokens for the area, into ``inbox``.

    Messages of neighbours and telemetry pass the returned filter.
    """
    run, name = content.run, content.area.name
    neighbours = sorted({n.area for n in content.area.neighbours})
    known = {neighbour_key(run, neighbour, kind, name) for neighbour in neighbours for kind in kinds}
    meters = tuple(meter.id for meter in content.meters if meter.source is not Source.VIRTUAL)
    ingress_filter = IngressFilter(known, run, name, content.readings.gateways, inbox, meters)
    session.subscribe(all_from_neighbours(run, name), ingress_filter.take)
    session.subscribe(all_telemetry(run, name), ingress_filter.take)
    session.subscribe(command_key(run, name), lambda key, payload: inbox.put(key, _CommandReceived(payload)))
    if any(faults.has_windows for faults in content.links.values()):
        session.subscribe(
            clock_key(run), lambda key, payload: inbox.put(key, _ClockReceived(time.monotonic(), payload))
        )
    for neighbour in neighbours:
        session.subscribe(
            all_incarnations(run, "area", neighbour), lambda key, payload: _put_leave(inbox, key, payload)
        )
    for area in (*neighbours, name):
        session.watch_presence(all_incarnations(run, "area", area), lambda key, alive: _put_token(inbox, key, alive))
    return ingress_filter


def _publishers(
    content: Configuration, session: Session, kinds: Sequence[str]
) -> Callable[[str | None, str, bytes], None]:
    """One publisher per key, all declared at the start."""
    run, name = content.run, content.area.name
    publishers: dict[tuple[str | None, str], Callable[[bytes], None]] = {}
    publishers[None, StateMessage.kind] = session.publisher(state_key(run, name))
    publishers[None, ReadingsMessage.kind] = session.publisher(readings_key(run, name))
    for n in content.area.neighbours:
        for kind in kinds:
            publishers[n.area, kind] = session.publisher(neighbour_key(run, name, kind, n.area))
    return lambda to, kind, payload: publishers[to, kind](payload)


def _put_token(inbox: Inbox, key: str, alive: bool) -> None:
    """Put a token into ``inbox`` if it is an incarnation's: a stranger's keys may be long, and each takes a slot."""
    if incarnation_of(key):
        inbox.put(key, _TokenSeen(key, alive))


def _put_leave(inbox: Inbox, key: str, payload: bytes) -> None:
    """Put a leave message into a slot of its own: the end of the token, which follows, must not replace it."""
    if incarnation_of(key) and (leave_reason := read_leave(payload)):
        inbox.put(("leave", key), _TokenSeen(key, False, leave_reason))


@dataclass
class _Intake:
    """Turns the items in ``inbox`` into events for the protocol of ``area``.

    Messages of the clock, renewals and tokens of the area's own name are handled here, and become no events.
    """

    area: str
    session: Session
    inbox: Inbox
    links: FaultyLinks
    guard: DuplicateGuard
    clock: HostClock
    orders: OrderBook
    presence: Presence = field(default_factory=Presence)

    def take(self, wait_s: float) -> list[Event]:
        """Events that have arrived, after ``wait_s`` at most; opens the links again where a renewal is asked for."""
        updates = self.inbox.take(wait_s)
        self.links.release(time.monotonic())
        if Renewal.ASKED in updates and self.session.interrupt():
            updates += [*self.inbox.take(0.0), _OutOfSight()]
            self.session.resume()
        events: list[Event] = [ClockSet(self.clock.offset)] if self.clock.has_been_set() else []
        events += (event for item in updates for event in self._events_of(item))
        return events

    def _events_of(self, item: Any) -> Iterator[Event]:
        match item:
            case _ClockReceived(at, payload):
                _take_clock(self.links, at, payload)
            case _CommandReceived(payload):
                yield from self.orders.take(payload, time.monotonic() + self.clock.offset)
            case _OutOfSight():
                self.guard.forget()
                for _, gone in self.presence.forget():
                    yield PresenceChanged(gone, False)
            case Renewal():
                pass
            case _TokenSeen(key, alive) if name_of_live(key)[1] == self.area:  # of this process or a namesake
                self.guard.take(key, alive, time.monotonic())
            case _TokenSeen(key, alive, leave_reason):
                if self.presence.take_leave(key) if leave_reason else self.presence.take(key, alive):
                    yield PresenceChanged(name_of_live(key)[1], alive, leave_reason)
            case _:
                yield item


def _take_clock(links: FaultyLinks, at: float, payload: bytes) -> None:
    try:
        message = decode(payload)
    except MessageError as error:
        log.warning("the agent rejects a payload on the clock's key: %s", error)
    else:
        if isinstance(message, ClockMessage):
            links.begin(at - message.elapsed_s)
