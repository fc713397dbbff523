"""The loop of an agent: bus and clock on one side, the protocol on the other."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from agents.area_files.area_file import AreaFile
from agents.messages.checks import MessageError
from agents.messages.keys import (
    all_from_neighbours,
    all_lives,
    clock_key,
    life_of,
    live_key,
    name_of_live,
    neighbour_key,
    state_key,
    telemetry_key,
)
from agents.messages.packing import ClockMessage, StateMessage, decode
from agents.protocol.choose import kinds_of, make_protocol
from agents.protocol.events import Event, Finish, PresenceChanged, Publish
from agents.runtime.duplicate_guard import GIVES_WAY, ReplacedError, Succession
from agents.runtime.heap import give_back
from agents.runtime.inbox import Inbox
from agents.runtime.ingress_filter import Doorkeeper
from agents.runtime.link import FaultyLinks
from agents.runtime.presence import Presence, begin_life, read_farewell
from agents.runtime.renewal import Renewal
from agents.transport.zenoh_bus import Session

log = logging.getLogger(__name__)
TIDY_S = 1.0  # between two times that free memory is given back; hundreds of areas may share one machine's


@dataclass(frozen=True, slots=True)
class _TokenSeen:
    """The token of a life, a neighbour's or of this very area, appeared, or it vanished, after a farewell perhaps."""

    key: str
    alive: bool
    farewell: str = ""


@dataclass(frozen=True, slots=True)
class _OutOfSight:
    """All tokens seen up to now count no longer: the links are opened anew, with other rules perhaps."""


@dataclass(frozen=True, slots=True)
class _ClockHeard:
    """What arrived on the clock's key at monotonic time ``at``."""

    at: float
    payload: bytes


def run_agent(content: AreaFile, session: Session, inbox: Inbox) -> str:
    """Take part in the exchange until something puts ``StopRequested`` into ``inbox``; return its reason.

    Subscribes first and shows its presence last, so that who sees the token can be sure to be heard.

    Raises:
        ReplacedError: another agent of the area runs that began later.
    """
    now = time.monotonic()
    incarnation = begin_life()
    protocol = make_protocol(content, incarnation, now=now, started_at=time.time())
    kinds = kinds_of(content.strategy)
    links = FaultyLinks(content.area.name, content.links, content.seed, _publishers(content, session, kinds))
    name, run = content.area.name, content.run
    _listen(content, session, kinds, inbox)
    own_token = live_key(run, "area", name, incarnation)
    say_farewell = session.publisher(own_token)
    session.declare_presence(own_token)
    backend = protocol.describe_backend()
    how = f"{content.strategy}, back end {backend}" if backend else content.strategy
    log.info("area %s of run %s, strategy %s, incarnation %s", name, run, how, incarnation)
    presence, succession = Presence(), Succession(f"area {name} of run {run}", incarnation, now, content.beat_s)
    events: list[Event] = []
    told: object = None
    next_tidying = now
    while True:
        now = time.monotonic()
        for action in protocol.handle(events, now):
            match action:
                case Publish(message, to):
                    links.send(message, to, now)
                    if isinstance(message, StateMessage):
                        told = _log_change(message, told)
                case Finish(reason):
                    say_farewell(reason.encode())
                    if (at_the_end := protocol.describe_backend()) != backend:
                        log.info("back end %s", at_the_end)
                    return reason
        now = time.monotonic()
        if now >= next_tidying:
            next_tidying = now + TIDY_S
            give_back()
        news = inbox.take(min(protocol.wait_s(now), links.next_due() - now, succession.next_due() - now))
        links.release(time.monotonic())
        if Renewal.ASKED in news and session.interrupt():
            news += [*inbox.take(0.0), _OutOfSight()]
            session.resume()
        events = list(_events_of(name, news, presence, succession, links))
        try:
            succession.check(time.monotonic())
        except ReplacedError:
            say_farewell(GIVES_WAY.encode())
            raise


def _listen(content: AreaFile, session: Session, kinds: Sequence[str], inbox: Inbox) -> None:
    """Have all that is meant for the area put into ``inbox``."""
    run, name = content.run, content.area.name
    neighbours = sorted({n.area for n in content.area.neighbours})
    known = {neighbour_key(run, neighbour, kind, name) for neighbour in neighbours for kind in kinds}
    doorkeeper = Doorkeeper(known, telemetry_key(run, name), inbox)
    session.subscribe(all_from_neighbours(run, name), doorkeeper.take)
    session.subscribe(telemetry_key(run, name), doorkeeper.take)
    if any(faults.has_windows for faults in content.links.values()):
        session.subscribe(clock_key(run), lambda key, payload: inbox.put(key, _ClockHeard(time.monotonic(), payload)))
    for neighbour in neighbours:
        session.subscribe(all_lives(run, "area", neighbour), lambda key, payload: _put_farewell(inbox, key, payload))
    for area in (*neighbours, name):
        session.watch_presence(all_lives(run, "area", area), lambda key, alive: _put_token(inbox, key, alive))


def _log_change(state: StateMessage, told: object) -> object:
    """Log what the area works with when that has changed; return what was told."""
    what = "no estimate" if not state.buses else "estimates" if state.referenced else "estimates, angles relative"
    removed = [f"removed as bad data: {', '.join(state.removed)}"] if state.removed else []
    line = "; ".join([f"scan {state.header.scan}: {what}", *removed, *state.notes])
    if line != told:
        log.info("%s", line)
    return line


def _publishers(content: AreaFile, session: Session, kinds: Sequence[str]) -> Callable[[str | None, str, bytes], None]:
    """One publisher per key, all declared at the start."""
    run, name = content.run, content.area.name
    publishers: dict[tuple[str | None, str], Callable[[bytes], None]] = {}
    publishers[None, "state"] = session.publisher(state_key(run, name))
    for n in content.area.neighbours:
        for kind in kinds:
            publishers[n.area, kind] = session.publisher(neighbour_key(run, name, kind, n.area))
    return lambda to, kind, payload: publishers[to, kind](payload)


def _put_token(inbox: Inbox, key: str, alive: bool) -> None:
    """If it is a life's: a stranger's keys may be long, and each takes a slot."""
    if life_of(key):
        inbox.put(key, _TokenSeen(key, alive))


def _put_farewell(inbox: Inbox, key: str, payload: bytes) -> None:
    """In a slot of its own: the end of the token, which follows, must not take its place."""
    if life_of(key) and (farewell := read_farewell(payload)):
        inbox.put(("farewell", key), _TokenSeen(key, False, farewell))


def _events_of(
    area: str, news: Sequence[Any], presence: Presence, succession: Succession, links: FaultyLinks
) -> Iterator[Event]:
    """What of ``news`` is for the protocol of ``area``; the rest is taken in here."""
    for item in news:
        match item:
            case _ClockHeard(at, payload):
                _take_clock(links, at, payload)
            case _OutOfSight():
                succession.forget()
                for _, gone in presence.forget():
                    yield PresenceChanged(gone, False)
            case Renewal():
                pass
            case _TokenSeen(key, alive) if name_of_live(key)[1] == area:  # our own life, or a namesake's
                succession.take(key, alive, time.monotonic())
            case _TokenSeen(key, alive, farewell):
                if presence.take_farewell(key) if farewell else presence.take(key, alive):
                    yield PresenceChanged(name_of_live(key)[1], alive, farewell)
            case _:
                yield item


def _take_clock(links: FaultyLinks, at: float, payload: bytes) -> None:
    try:
        message = decode(payload)
    except MessageError as error:
        log.warning("refused a payload on the clock's key: %s", error)
    else:
        if isinstance(message, ClockMessage):
            links.begin(at - message.elapsed_s)
