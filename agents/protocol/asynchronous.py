"""Protocol of one area under an asynchronous strategy: the area reacts to the newest messages.

The area solves when it has received something new. It sends a neighbour a message when the content for this neighbour
has changed, and repeats the message until it is acknowledged. Messages are absolute: of each sender the newest
(incarnation, sequence) counts, whichever messages were lost, repeated or overtaken on the way.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from agents.messages.packing import (
    BoundaryUpdate,
    HeartbeatMessage,
    Incarnation,
    LinkMessage,
    Message,
    TelemetryMessage,
)
from agents.peers.orders_and_ages import FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS
from agents.peers.peers import Term
from agents.peers.rejections import find_unreasonable
from agents.protocol.area_protocol import AreaProtocol
from agents.protocol.configuration import Configuration
from agents.protocol.events import Action, Publish
from agents.protocol.gateway_watch import GatewayWatch
from agents.protocol.quality import (
    DEGRADED,
    NONE,
    RELATIVE_ANGLE,
    STALE,
    EstimateLimits,
    Finding,
    assess,
    find_contradictions,
    find_early_scan,
    find_gone,
    find_leader_clock,
    find_left_out_readings,
    find_meters_off,
    find_missing_readings,
    find_missing_side,
    find_mistaken_gateways,
    find_other_splits,
    find_overdue_readings,
    find_rejected_clocks,
    find_skewed_clocks,
    find_unreadable_payloads,
    find_waiting_next,
)
from agents.strategies.interface import Estimate, Knowledge, Strategy
from agents.strategies.start import find_no_load
from dsse_core.exchange.boundary_load import Loads


class AsynchronousProtocol(AreaProtocol):
    """One area's part in the exchange of ``strategy``; for the other arguments see ``AreaProtocol``."""

    def __init__(
        self, content: Configuration, strategy: Strategy, incarnation: Incarnation, *, now: float, started_at: float
    ) -> None:
        super().__init__(content, strategy.kinds(), incarnation, now=now, started_at=started_at)
        self._strategy = strategy
        _, self._no_load_va = find_no_load(content.area)
        self._has_update = True
        self._basis: object = None  # neighbours whose messages are in use, and those present, when it last solved
        self._set_aside: set[object] = set()  # messages that led to no estimate, until the next heartbeat
        self._estimate: Estimate | None = None
        self._notes: tuple[str, ...] = ()
        self._has_solved = False  # since the state was last shown
        self._limits = EstimateLimits(content.limits, content.area.network, content.meters)
        self._gateways = GatewayWatch(content.area)
        self._estimated_scan = 0
        self._sent: Estimate | None = None  # the last one sent to neighbours

    def describe_backend(self) -> str:
        """See ``Strategy.describe_backend``."""
        return self._strategy.describe_backend()

    @property
    def _term(self) -> Term:
        return self.scan, 0

    @property
    def _is_at_rest(self) -> bool:
        return True  # no neighbour waits for a heartbeat: missing messages are repeated

    def _due_times(self) -> Iterator[float]:
        yield from super()._due_times()
        changes = (self._peers.absent_at(name) for name in self._peers)
        yield from (at for at in (*changes, self._waits_until) if at > self._now)

    @property
    def _waits_until(self) -> float:
        """Time until which messages of a former scan are used: by then their senders should be in this scan."""
        return self._scan.entered_at + FRESH_HEARTBEATS * self._heartbeat_s

    # Incoming messages

    def _find_rejection(self, message: Message) -> str:
        return self._strategy.find_rejection(message) if isinstance(message, BoundaryUpdate) else ""

    def _take_numbering(self, name: str, message: HeartbeatMessage) -> Iterator[Action]:
        yield from ()  # whatever number a scan has, its readings are used as they come

    def _take_telemetry(self, message: TelemetryMessage) -> Iterator[Action]:
        self._has_update |= self._scan.take_at_once(message, self._now)
        yield from ()

    def _take_readings_anew(self) -> Iterator[Action]:
        self._scan.enter(self.scan, self._now)
        self._has_update = True
        yield from ()

    def _take_load(self) -> Iterator[Action]:
        self._has_update = True
        yield from ()

    def _receive(self, name: str, message: LinkMessage) -> Iterator[Action]:
        self._note(name, message)
        peer = self._peers[name]
        for sent, number in zip(peer.outgoing, message.received, strict=True):
            yield from self._send_if_lacking(name, sent, number)
        if isinstance(message, BoundaryUpdate):
            peer.is_owed_reply = True
            if peer.take_number(message.header.sequence, self._now):
                peer.boundary, self._has_update = message, True

    # The estimate

    def _act(self, *, is_heartbeat: bool) -> Iterator[Action]:
        if is_heartbeat:  # an iteration that ran out of steps goes on
            self._has_update = True
            self._set_aside.clear()
        if tick := self._scan.next_scan:
            self._scan.enter(tick, self._now)
            self._has_update = True
        basis = self._usable().keys(), self._peers.present(self._now)
        if self._scan.has_been_read and (self._has_update or basis != self._basis):
            self._has_update, self._basis, self._has_solved = False, basis, True
            self._gateways.weigh(self.scan, self._area, self._scan.readings, None)
            yield from self._work()

    def _work(self) -> Iterator[Action]:
        """Yields new messages. Unreasonable numbers, perhaps of a neighbour, leave no estimate, but cause no crash."""
        problem = ""
        for _ in range(2):  # with all received messages; if that fails, with the own telemetry alone
            try:
                yield from self._send_loads()
                yield from self._solve()
                return
            except (ArithmeticError, np.linalg.LinAlgError, RuntimeError, ValueError) as error:
                problem = f"no estimate: {type(error).__name__}: {error}"
                self._start_anew()
        self._estimate, self._notes = None, (problem,)

    def _start_anew(self) -> None:
        """Drops the state of the iteration, as a restart would, and sets the received messages aside.

        The first estimate that follows replaces the messages that neighbours have received so far.
        """
        self._strategy, self._sent = type(self._strategy)(self._content), None
        for _, peer in self._peers.items():
            self._set_aside |= {peer.received_load, peer.boundary}
        self._rejections.count("led to no estimate")

    def _solve(self) -> Iterator[Publish]:
        """Solves, and yields new messages to the neighbours."""
        estimate, notes = self._strategy.solve(self._knowledge())
        if estimate is not None and not estimate.is_reasonable(self._no_load_va):
            raise ArithmeticError("the estimate is beyond reason")
        self._estimate, self._notes = estimate, notes
        self._estimated_scan = self.scan
        if estimate is not None and (estimate is not self._sent or any(map(self._is_outdated, self._peers))):
            self._sent = estimate
            yield from self._send_boundaries(estimate)

    def _knowledge(self) -> Knowledge:
        return Knowledge(
            measurements=self._scan.readings.measurements,
            loads=self._received_loads(),
            boundary=self._usable(),
            present=self._peers.present(self._now),
            scan=self.scan,
        )

    def _received_loads(self) -> dict[str, Loads]:
        loads = super()._received_loads()
        return {
            name: of_side for name, of_side in loads.items() if self._peers[name].received_load not in self._set_aside
        }

    def _usable(self) -> dict[str, BoundaryUpdate]:
        """Returns the boundary messages in use: those of this scan; those of a former scan for a while; those of a
        later scan as long as their sender is received.

        After that, the state of the grid has changed, or the plant that numbered the scan has ended.
        """
        waits, usable = self._now < self._waits_until, {}
        for name, peer in self._peers.items():
            message = peer.boundary
            if message is None or message in self._set_aside:
                continue
            is_ahead = (
                message.header.scan > self.scan and self._now - peer.received_at < FRESH_HEARTBEATS * self._heartbeat_s
            )
            if waits or is_ahead or message.header.scan == self.scan:
                usable[name] = message
        return usable

    # Outgoing messages

    def _is_outdated(self, name: str) -> bool:
        """True where a neighbour has been sent no message of this scan: the next one is new whatever it states."""
        last = self._peers[name].exchange.message
        return last is None or last.header.scan != self.scan

    def _send_boundaries(self, estimate: Estimate) -> Iterator[Publish]:
        for n in self._area.neighbours:
            sent = self._peers[n.area].exchange
            message = self._strategy.message_for(n, estimate, self._header(sent.sequence + 1))
            if reason := self._strategy.find_rejection(message) or find_unreasonable(message):
                raise ArithmeticError(f"the message to a neighbour: {reason}")
            if self._is_outdated(n.area) or self._strategy.is_update(n, message, cast("BoundaryUpdate", sent.message)):
                yield self._send(n.area, sent, message)

    def _describe_standing(self, name: str) -> dict[str, Any]:
        return {"revision": 0, "k": self._peers[name].exchange.sequence, "final": False, "y": ()}

    def _is_side_complete(self, name: str) -> bool:
        if not self._scan.has_been_read or self._scan.is_late(self._now, PASSED_ON_HEARTBEATS):
            return False
        overdue = self._scan.readings.ages.overdue_share(self._now) > self._content.limits.most_overdue
        is_apart = bool(self._peers.skewed or self._gateways.mistaken) or not self._splits.are_one()
        return not (overdue or is_apart or self._find_old(PASSED_ON_HEARTBEATS) - {name})

    def _find_old(self, heartbeats: float = FRESH_HEARTBEATS) -> set[str]:
        """Returns the neighbours that are not received, in another scan or not complete, or whose newest message is not
        here.
        """
        missed = {name for name, p in self._peers.items() if p.boundary is None or p.k != p.received_sequence}
        return missed | self._peers.find_old(self._term, frozenset(self._peers), self._now, heartbeats)

    # The published state

    def _show(self, *, is_heartbeat: bool) -> Iterator[Publish]:
        """Yields the state if it has changed, and at every heartbeat."""
        findings = list(self._findings())
        self._end.note(self._term, self._estimate, findings, self._now, is_end=self.scan > 0, is_heartbeat=is_heartbeat)
        assessment, last = assess(findings), self._published.message
        old_sides = tuple(sorted(name for name, p in self._peers.items() if p.boundary and not p.complete))
        is_as_shown = self._published.is_as_shown(assessment.quality, old_sides)
        if is_as_shown and not (is_heartbeat or self._has_solved):
            return
        self._has_solved = False
        state = self._published.compose(
            self._estimate, assessment, old_sides, self.scan, self._now, self._scan.readings.ages
        )
        is_same = last is not None and (state.header.sequence, state.notes) == (last.header.sequence, last.notes)
        if is_heartbeat or not (is_same and is_as_shown):
            yield Publish(state, None)

    def _findings(self) -> Iterator[Finding]:
        """Yields the findings on the estimate as of now; after new readings it is outdated until they are worked in."""
        estimate = self._estimate
        yield from (Finding(DEGRADED if estimate else NONE, note, note.partition(":")[0]) for note in self._notes)
        yield from find_rejected_clocks(self._rejections.ahead)
        yield from find_other_splits(self._splits.add_to(()), self._area.name)
        yield from find_waiting_next(self._splits.held, self._splits.edited_next)
        yield from find_contradictions(self._rejections.contradictions)
        yield from find_unreadable_payloads(self._rejections.unreadable_in(self.scan))
        yield from find_skewed_clocks(self._peers.skewed)
        yield from find_mistaken_gateways(self._gateways.mistaken)
        yield from find_leader_clock(self._content.readings.leader, self._scan.leader_ahead_s)
        yield from find_early_scan(self._scan.lead_s)
        if self._scan.has_been_read:
            yield from find_missing_readings(self._scan.readings.unread, self._scan.readings.invalid)
            yield from find_left_out_readings(self._scan.readings)
        yield from find_meters_off(self._published.ordered.meters_off)
        yield from (find_gone(name, leave_reason) for name, leave_reason in sorted(self._peers.gone.items()))
        if estimate is None:
            yield Finding(NONE, "there is no estimate" if self._scan.has_been_read else "no telemetry yet")
            return
        if self._scan.is_late(self._now):
            yield Finding(STALE, "telemetry is no longer received")
        yield from find_overdue_readings(self._scan.readings.ages, self._content.limits.most_overdue, self._now)
        if not estimate.referenced:
            yield Finding(RELATIVE_ANGLE, "angles do not count from the substation")
        if not estimate.checked:
            yield Finding(DEGRADED, "bad data have not been looked for in the whole feeder")
        if not estimate.settled:
            yield Finding(DEGRADED, "the iteration is under way")
        if self._estimated_scan != self.scan:
            yield Finding(DEGRADED, "newer readings have not been worked in")
        yield from self._limits.find_breaches(estimate)
        yield from map(self._find_doubt, sorted(self._find_old() - self._peers.gone.keys()))

    def _find_doubt(self, name: str) -> Finding:
        """Returns the reason for which a neighbour's side does not count as known."""
        peer = self._peers[name]
        if peer.boundary is None or peer.k != peer.received_sequence:
            return Finding(DEGRADED, f"the newest boundary message from {name} is not here")
        if peer.boundary.header.scan != self.scan or peer.term != self._term:
            return Finding(DEGRADED, f"the newest message from {name} is of another scan")
        if not self._peers.is_present(name, self._now) or peer.complete:
            return Finding(DEGRADED, f"{name} is not received, or does not receive this area")
        return find_missing_side(name)
