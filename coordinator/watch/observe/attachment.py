"""Attachment to a running system: finds the run on the bus, and takes in its messages."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from agents.messages.checks import MessageError
from agents.messages.keys import (
    NAME,
    all_gateways,
    all_states,
    check_run_id,
    of_any_version,
    publisher_of,
    run_of,
    sender_of,
    version_of,
)
from agents.messages.packing import WIRE_VERSION, ReadingsMessage, StateMessage, decode, describe_other_version
from agents.protocol.area_protocol import REPEAT_READINGS_S
from agents.runtime.presence import read_leave
from agents.security.access import COORDINATOR, WATCHER
from agents.security.credential_files import credentials_in
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session, TransportError
from coordinator.watch.observe.run_address import RunAddress
from coordinator.watch.observe.updates import Updates
from coordinator.watch.observe.view import OVER_S
from coordinator.watch.observe.watched_keys import (
    NAMED_BY_NEIGHBOUR,
    PresenceByName,
    processes_of,
    readings_keys,
    state_keys,
)
from coordinator.watch.observe.watcher import Watcher
from dsse_core.printable import listed

ANY = "*"
SETTLE_S = 0.3  # without a new name; then all present areas have been received
STEP_S = 0.05
LONGEST_WAIT_S = REPEAT_READINGS_S + 2.0
MOST_RUNS = 12  # runs that an error names


@dataclass(frozen=True, slots=True)
class _Shown:
    """A message on the key of an area's states or readings."""

    key: str
    payload: bytes


class Attachment:
    """Attachment to a run through ``session``; a call takes in the messages that have arrived, and returns the watcher.

    ``asked_at``: time of the last question for the presence of a process, s, monotonic.
    """

    def __init__(self, watcher: Watcher, updates: Updates, session: Session) -> None:
        self.is_linked = session.is_linked
        self.session, self.run = session, watcher.run
        self._watcher, self._updates = watcher, updates
        self._any_version = session.keys is None
        offer = self._offer_token, self._offer_leave
        self._asked = PresenceByName(session, self.run, *offer, any_version=self._any_version)
        self.asked_at = time.monotonic()

    def listen(self) -> None:
        """Subscribe to the run; its messages go into the updates."""
        areas, session = self._watcher.areas, self.session
        self._asked.ask(processes_of(areas))  # before the states: the publisher of a state is known to be present
        states = state_keys(self.run, areas)
        if areas is None and self._any_version:
            states = tuple(map(of_any_version, states))
        for expression in (*states, *readings_keys(self.run, areas)):
            session.subscribe(expression, self._offer_shown)
        session.subscribe(all_gateways(self.run), lambda key, payload: self._asked.note(*publisher_of(key)))

    def renew(self) -> None:
        """Load the keys from their files again; presence tokens are then received again."""
        if self.session.interrupt():
            self(0.0)
            self._watcher.forget_presence()
            self.session.resume()

    def __call__(self, duration_s: float) -> Watcher:
        """Wait up to ``duration_s`` for a message, and take in all that have arrived; the watcher."""
        for item in self._updates.take(duration_s):
            match item:
                case _Shown(key, payload):
                    self._take_shown(key, payload)
                case (key, bool() as alive):
                    self._watcher.take_presence(key, alive, time.monotonic())
                case (key, leave_reason):
                    self._watcher.take_leave(key, leave_reason, time.monotonic())
        if self._asked.ask_noted():
            self.asked_at = time.monotonic()
        self._watcher.is_linked = self.is_linked()
        return self._watcher

    def for_whole(self, duration_s: float) -> Watcher:
        """The watcher after all of ``duration_s``, however many messages arrive; this limits the rate of calls."""
        deadline = time.monotonic() + duration_s
        while (left_s := deadline - time.monotonic()) > 0:
            self(left_s)
        return self._watcher

    def _offer_shown(self, key: str, payload: bytes) -> None:
        """Queue a message, on the receiving thread; a slow thread would delay the router, and with it the areas."""
        self._updates.offer(_Shown(key, payload), size=len(key) + len(payload))

    def _offer_token(self, key: str, alive: bool) -> None:
        self._updates.offer((key, alive), sent_once=True, size=len(key))

    def _offer_leave(self, key: str, payload: bytes) -> None:
        if leave_reason := read_leave(payload):
            self._updates.offer((key, leave_reason), sent_once=True, size=len(key))

    def _take_shown(self, key: str, payload: bytes) -> None:
        """Take in a message of an area that the watcher has place for; messages of others are not decoded."""
        if not self._watcher.has_place_for(sender_of(key)):
            return
        self._asked.note(*publisher_of(key))
        match _decoded(key, payload):
            case StateMessage() as state:
                self._watcher.take_state(state, time.monotonic(), len(payload))
                if self._watcher.areas is None:
                    for neighbour in state.sent:
                        self._asked.note("area", neighbour, NAMED_BY_NEIGHBOUR)
            case ReadingsMessage() as readings:
                self._watcher.take_readings(readings, len(payload))


@contextmanager
def join_run(address: RunAddress, name: str = "") -> Iterator[tuple[Session, str]]:
    """Join the bus to listen to a run; the session, and the name of the run.

    ``name``: owner of the credentials to use; by default the watcher, else the coordinator.

    Raises:
        InvalidInputError: the keys cannot be used, or ``address.run`` is no name of a run.
        TransportError: no endpoint answers in time, no run or several are there.
    """
    run = check_run_id(address.run) if address.run is not None else None
    keys = load_keys(address.keys, name or find_own_name(address.keys), run) if address.keys else None
    run = keys.access.run if keys else run
    with Session.join(address.endpoints, address.timeout_s, keys, direct=address.direct) as session:
        yield session, run or _find_run(session, address.timeout_s)


@contextmanager
def attach(address: RunAddress, name: str = "", areas: frozenset[str] | None = None) -> Iterator[Attachment]:
    """Watch a run. ``areas``: names of its areas, if known; no other name is an area then.

    The other arguments and the errors are those of ``join_run``.
    """
    with join_run(address, name) as (session, run):
        look = Attachment(Watcher(run, areas), Updates(), session)
        look.listen()
        yield look


def find_own_name(keys: Path) -> str:
    """Owner of the credentials in ``keys`` for a watcher: the coordinator where it alone has some, else the watcher."""
    has = {name: credentials_in(keys, name).certificate.exists() for name in (WATCHER, COORDINATOR)}
    return COORDINATOR if has[COORDINATOR] and not has[WATCHER] else WATCHER


def wait_until_whole(look: Attachment, timeout_s: float, *, with_readings: bool = False) -> Watcher:
    """Wait until every present area has been received, ``with_readings`` its readings as well, or until time is up.

    Areas repeat their readings at longer intervals than their states; LONGEST_WAIT_S is the least time limit then.
    """
    deadline = time.monotonic() + (max(timeout_s, LONGEST_WAIT_S) if with_readings else timeout_s)
    while True:
        watcher = look(STEP_S)
        if time.monotonic() >= deadline or _is_whole(look, watcher, with_readings):
            return watcher


def _is_whole(look: Attachment, watcher: Watcher, with_readings: bool) -> bool:
    """True where all areas have been received, and SETTLE_S has passed since the last question for a process.

    Where an area is absent OVER_S must pass, as the areas beyond it take longer to be found."""
    settled_at = look.asked_at + (OVER_S if watcher.find_absent() else SETTLE_S)
    has_all = watcher.is_whole() and (not with_readings or watcher.readings.keys() >= watcher.states.keys())
    return has_all and time.monotonic() >= settled_at


def wait_for_state(look: Attachment, area: str, timeout_s: float) -> Watcher:
    """Wait until ``area`` has published an estimate, or until time is up."""
    deadline = time.monotonic() + timeout_s
    while not ((state := (watcher := look(STEP_S)).state_of(area)) and state.buses) and time.monotonic() < deadline:
        pass
    return watcher


def _find_run(session: Session, timeout_s: float) -> str:
    """The only run on the bus, by the states that its areas publish.

    The search lasts one heartbeat of the first area received, so it also finds a second run with as short a heartbeat.

    Raises:
        TransportError: no run or several are there.
    """
    updates = Updates()
    states = session.subscribe(of_any_version(all_states(ANY)), lambda key, payload: updates.offer(key, size=len(key)))
    versions: dict[str, int] = {}  # run -> wire version
    first, earliest, settles_at, ends_at = "", 0.0, float("inf"), time.monotonic() + timeout_s
    while (now := time.monotonic()) < min(ends_at, settles_at):
        for key in updates.take(STEP_S):
            if NAME.fullmatch(run_of(key)) and len(versions) <= MOST_RUNS:
                speaks_ours = versions.get(run_of(key)) == WIRE_VERSION
                versions[run_of(key)] = WIRE_VERSION if speaks_ours else version_of(key)
            if not first:
                first, settles_at, earliest = key, now + OVER_S, now + SETTLE_S
            elif key == first:  # a heartbeat has passed
                settles_at = min(settles_at, max(now, earliest))
    session.withdraw(states)
    return _choose_run(versions, timeout_s)


def _choose_run(versions: Mapping[str, int], timeout_s: float) -> str:
    """The only run of this wire version.

    Raises:
        TransportError: there is none, or several."""
    runs = [run for run, version in versions.items() if version == WIRE_VERSION]
    if len(runs) > 1:
        raise TransportError(f"several runs are on this bus: {listed(sorted(runs), MOST_RUNS)}; choose one with --run")
    if not runs and versions:
        who = f"run {listed(sorted(versions), MOST_RUNS)} speaks"
        raise TransportError(describe_other_version(max(versions.values()), who))
    if not runs:
        raise TransportError(f"no area publishes anything on this bus within {timeout_s:g} s; are agents running?")
    return runs[0]


def _decoded(key: str, payload: bytes) -> StateMessage | ReadingsMessage | None:
    """The state or readings in ``payload``; None where it is another message, or not from the area of ``key``."""
    try:
        message = decode(payload)
    except MessageError:
        return None
    if not isinstance(message, StateMessage | ReadingsMessage) or message.header.sender != sender_of(key):
        return None
    return message
