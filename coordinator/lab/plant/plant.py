"""The plant: a process that makes the readings of all meters and publishes them, area by area, on the bus."""

from __future__ import annotations

import logging
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from agents.messages.checks import MessageError
from agents.messages.keys import all_incarnations, clock_key, command_key, live_key, name_of_live, telemetry_key
from agents.messages.packing import ClockMessage, decode
from agents.orders.order_book import BY_OPERATOR, STOPPED_CODE, OrderBook
from agents.protocol.events import Event, Ordered, StopRequested
from agents.runtime.duplicate_guard import GIVES_WAY, REPLACED_CODE, DuplicateGuard, ReplacedError
from agents.runtime.inbox import Inbox
from agents.runtime.log import start_log
from agents.runtime.presence import begin_incarnation
from agents.runtime.renewal import Renewal, on_hangup
from agents.runtime.watchdog import Watchdog
from agents.security.access import PLANT
from agents.security.credentials import load_keys
from agents.transport.renewable_bus import RenewableBus
from agents.transport.zenoh_bus import Session
from coordinator.lab.plant.scans import Scans
from dsse_core import operating_system
from dsse_core.errors import DsseError

log = logging.getLogger(__name__)
SILENT, RESUME = operating_system.USER_1, operating_system.USER_2
# A plant sends at most BURST bytes at once, then waits: the bus drops what it has no room for until the next heartbeat
BURST, RATE = 2**16, 16 * 2**20  # bytes, bytes per second


def run_plant(
    scans: Scans,
    run: str,
    endpoints: Sequence[str],
    timeout_s: float = 10.0,
    scan: int = 1,
    every_s: float | None = None,
    keys: Path | None = None,
    direct: bool = False,
) -> int:
    """Publishes ``scans`` for ``run`` until SIGTERM or Ctrl-C, and returns the exit code.

    Exit codes: 0 after an orderly end, 2 after a user's mistake, 3 if another plant of the run began later, 4 if the
    operator has stopped the plant.

    An area is served when it appears, and then at every heartbeat. It subscribes before it appears. ``scan``: number of
    the first scan, above those of all earlier plants of the run. ``every_s``: time from one scan to the next; None for
    a single scan. Signal ``SILENT`` makes the plant publish nothing until signal ``RESUME``. ``keys``: folder of the
    plant's credentials. ``direct``: ``endpoints`` are those of all areas, not of routers. If no area appears for
    ``timeout_s``, the plant logs a warning. Where events operate switches, the run's clock says when.
    """
    start_log()
    inbox = Inbox()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Zenoh's connecting would defer Python's handler to its end
    try:
        incarnation = begin_incarnation()
        payloads = scans.payloads(run, incarnation, scan)
        if keys:
            on_hangup(lambda: inbox.put("renewal", Renewal.ASKED), lambda: inbox.put("stop", None))
        loaded = load_keys(keys, PLANT, run)
        with Session.join(endpoints, timeout_s, loaded, heartbeat_s=scans.heartbeat_s, direct=direct) as session:
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, lambda *_: inbox.put("stop", None))
            publishers = {area: session.publisher(telemetry_key(run, area)) for area in payloads}
            _subscribe(session, run, tuple(payloads), inbox)
            own_token = live_key(run, "plant", PLANT, incarnation, scans.split)
            send_leave = session.publisher(own_token)
            session.declare_presence(own_token)
            log.info("plant of run %s, seed %s, %s areas", run, scans.seed, len(payloads))
            guard = DuplicateGuard(f"plant of run {run}", incarnation, time.monotonic(), scans.heartbeat_s)
            orders = OrderBook(PLANT, run, began_at=incarnation.start_ms / 1000)
            loop = PlantLoop(publishers, inbox, scans.heartbeat_s, guard, session, orders, scans.find_next)
            loop.no_area = NoAreaWarning(
                time.monotonic() + timeout_s, f"of run {run} within {timeout_s:g} s", endpoints
            )
            if scans.find_next(0.0) is not None:
                session.subscribe(clock_key(run), lambda key, payload: inbox.put(key, _ClockReceived(payload)))
            loop.follow_signals()
            loop.watchdog.ready(time.monotonic())
            try:
                while not loop.publish_scan(payloads, scans.late_s(scan), every_s or math.inf):
                    scan += 1
                    payloads = scans.payloads(run, incarnation, scan, loop.elapsed_s)
            except ReplacedError:
                send_leave(GIVES_WAY.encode())
                raise
            send_leave(loop.stop_reason.encode())
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return REPLACED_CODE if isinstance(error, ReplacedError) else 2
    return STOPPED_CODE if loop.stop_reason == BY_OPERATOR else 0


def _subscribe(session: Session, run: str, areas: Sequence[str], inbox: Inbox) -> None:
    """Puts the presence of ``areas`` and of other plants, and the operator's commands, into ``inbox``."""
    for area in areas:  # each by its name, so that the bus does not deliver the tokens of unknown senders
        session.watch_presence(
            all_incarnations(run, "area", area),
            lambda key, alive: inbox.put(name_of_live(key), key) if alive else None,
        )
    session.watch_presence(all_incarnations(run, "plant", PLANT), lambda key, alive: inbox.put(key, (key, alive)))
    session.subscribe(command_key(run, PLANT), lambda key, payload: inbox.put("command", _CommandReceived(payload)))


@dataclass(frozen=True, slots=True)
class _CommandReceived:
    """A payload received on the key of the operator's commands."""

    payload: bytes


@dataclass(frozen=True, slots=True)
class _ClockReceived:
    """A payload received on the key of the run's clock, at monotonic time ``at``, s."""

    payload: bytes
    at: float = field(default_factory=time.monotonic)


@dataclass
class NoAreaWarning:
    """Warns once if no area has appeared by ``until``. This may be intended: areas may be started later."""

    until: float = math.inf
    where: str = ""
    endpoints: Sequence[str] = ()

    def check(self, areas: Sequence[str], now: float) -> None:
        """Takes in ``areas``, which have just appeared; warns if there are none and ``until`` has passed."""
        if areas:
            self.until = math.inf
        elif now >= self.until:
            self.until = math.inf
            log.warning("no area %s has shown itself; looking on at %s", self.where, ", ".join(self.endpoints))


@dataclass
class PlantLoop:
    """Publishes one scan after the other. While silent, it publishes nothing, and its scans go on in time."""

    publishers: Mapping[str, Callable[[bytes], None]]
    inbox: Inbox
    heartbeat_s: float
    guard: DuplicateGuard
    bus: RenewableBus
    orders: OrderBook
    find_next: Callable[[float], float | None] = lambda _: None  # of ``Scans``
    elapsed_s: float = 0.0  # from the start of the run to the newest scan
    began_at: float = math.inf  # monotonic time of the start of the run, by its clock
    stop_reason: str = "stopped"
    silent: bool = False
    no_area: NoAreaWarning = field(default_factory=NoAreaWarning)
    watchdog: Watchdog = field(default_factory=Watchdog)
    _newest: dict[str, bytes] = field(default_factory=dict)  # area -> its newest readings that are not late
    _due: dict[str, None] = field(default_factory=dict)  # areas to be served, in this order; kept from scan to scan

    def publish_scan(self, payloads: Mapping[str, bytes], late_s: Mapping[str, float], duration_s: float) -> bool:
        """Publishes one scan at every heartbeat for ``duration_s``, or until another is ordered. True: stop the plant.

        ``late_s``: area -> delay of its readings, s; until then its former ones are repeated.

        Raises:
            ReplacedError: another plant of the run began later.
        """
        start = next_heartbeat = time.monotonic()
        next_change = self.find_next(self.elapsed_s)
        while True:  # once at least: the next scan may be due already
            now = time.monotonic()
            over = min(start + duration_s, math.inf if next_change is None else self.began_at + next_change)
            if now >= next_heartbeat:
                next_heartbeat = now + self.heartbeat_s
                self._due |= dict.fromkeys(payloads)
            n_bytes = self._publish_due(payloads, late_s, now - start)
            wait_s = n_bytes / RATE if self._due else math.inf
            wait_s = min(wait_s, self.watchdog.ping(now))
            updates = self.inbox.take(min(next_heartbeat - time.monotonic(), over - time.monotonic(), wait_s))
            if Renewal.ASKED in updates and self.bus.interrupt():
                updates += self.inbox.take(0.0)
                self._check_duplicates([item for item in updates if isinstance(item, tuple)])
                updates = [item for item in updates if not isinstance(item, tuple)]
                self.guard.forget()
                self.bus.resume()
            if None in updates:
                return True
            self._check_duplicates([item for item in updates if isinstance(item, tuple)])
            self._take_clock([item for item in updates if isinstance(item, _ClockReceived)])
            names = [name_of_live(key)[1] for key in updates if isinstance(key, str)]
            self.no_area.check(names, time.monotonic())
            commands = [event for item in updates if isinstance(item, _CommandReceived) for event in self._follow(item)]
            if any(isinstance(event, StopRequested) for event in commands):
                self.stop_reason = BY_OPERATOR
                return True
            is_over = time.monotonic() >= over
            if is_over or any(isinstance(event, Ordered) and event.scan for event in commands):
                self.elapsed_s = max(self.elapsed_s, time.monotonic() - self.began_at)
                return False
            self._due |= dict.fromkeys(name for name in names if name in payloads)

    def _take_clock(self, received: Sequence[_ClockReceived]) -> None:
        for item in received:
            try:
                message = decode(item.payload)
            except MessageError as error:
                log.warning("the plant rejects a payload on the clock's key: %s", error)
            else:
                if isinstance(message, ClockMessage):
                    self.began_at = item.at - message.elapsed_s

    def _follow(self, command: _CommandReceived) -> Iterator[Event]:
        return self.orders.take(command.payload, time.time())

    def _publish_due(self, payloads: Mapping[str, bytes], late_s: Mapping[str, float], elapsed_s: float) -> int:
        """Publishes the newest readings of the next areas that are due, up to ``BURST`` bytes and the message that
        exceeds them. Returns the bytes sent.
        """
        n_bytes = 0
        while self._due and n_bytes < BURST:
            area = next(iter(self._due))
            del self._due[area]
            if elapsed_s >= late_s.get(area, 0.0):
                self._newest[area] = payloads[area]
            if area in self._newest and not self.silent:
                self.publishers[area](self._newest[area])
                n_bytes += len(self._newest[area])
        return n_bytes

    def _check_duplicates(self, tokens: Sequence[tuple[str, bool]]) -> None:
        now = time.monotonic()
        for key, alive in tokens:
            self.guard.take(key, alive, now)
        self.guard.check(now)

    def follow_signals(self) -> None:
        """Installs the handlers: silent from signal ``SILENT`` on, publishing again from ``RESUME`` on."""
        numbers = [number for number in (SILENT, RESUME) if number is not None]
        for number in numbers:
            signal.signal(number, self._on_signal)
        operating_system.unblock(numbers)  # a run's plant may have its orders already

    def _on_signal(self, number: int, _: object) -> None:
        self.silent = number == SILENT
