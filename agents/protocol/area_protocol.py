"""Protocol of one area, the part that all strategies share: events and time in, actions out.

The protocol takes in messages and rejects some. It knows its neighbours as processes, and repeats to each the messages
without acknowledgement. It sends them the load of its side and heartbeats, and publishes the state. The meaning of the
messages of a strategy is in ``rounds/`` (rounds) and ``asynchronous.py`` (asynchronous strategies). No bus, no clock,
no randomness.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from agents.messages.packing import (
    Header,
    HeartbeatMessage,
    Incarnation,
    LinkMessage,
    LoadMessage,
    Message,
    ReadingsMessage,
    StateMessage,
    TelemetryMessage,
)
from agents.peers.agreement import Agreement, describe_boundary
from agents.peers.orders_and_ages import FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS, PATIENCE_HEARTBEATS
from agents.peers.peer_table import PeerTable
from agents.peers.peers import M, Outgoing, Term
from agents.peers.rejections import (
    CONTRADICTION,
    FAR_SCAN,
    FUTURE,
    OTHER_BUS,
    OTHER_STRATEGY,
    OTHER_VARIABLES,
    Rejections,
    find_rejection,
)
from agents.peers.splits import Splits
from agents.protocol.configuration import Configuration
from agents.protocol.events import (
    Action,
    ClockSet,
    Event,
    Finish,
    GoOver,
    Offered,
    Ordered,
    PresenceChanged,
    Publish,
    Received,
    Rejected,
    StopRequested,
)
from agents.protocol.numbering import ScanReadings, TickReadings
from agents.protocol.published_state import PublishedState
from agents.protocol.scan_end import ScanEnd
from dsse_core.exchange.boundary_load import Loads, load_message_for
from dsse_core.grid.measurement import Source
from dsse_core.reading_rules import SCAN_SHARE
from dsse_core.split_identity import NO_SPLIT

REPEAT_READINGS_S = 10.0  # of unchanged readings in use, for recorders and watchers that join later


class AreaProtocol(ABC):
    """Protocol of one area, as far as it is the same under every strategy.

    Args:
        kinds: of messages of the strategy.
        started_at: wall-clock time, s since 1970, at monotonic time ``now``.
    """

    def __init__(
        self, content: Configuration, kinds: Sequence[str], incarnation: Incarnation, *, now: float, started_at: float
    ) -> None:
        self._content = content
        self._area = content.area
        self._kinds = {TelemetryMessage.kind, LoadMessage.kind, HeartbeatMessage.kind, *kinds}
        self._agreement = Agreement(content.area, content.strategy, kinds)
        self._incarnation = incarnation
        self._now = now
        self._is_awake = True  # false after a missed heartbeat of its own: then messages have waited to be taken in
        self._heartbeat_s = content.beat_s
        self._next_heartbeat = now + content.beat_s
        skew_limit_s = SCAN_SHARE * content.scan_s if content.scan_s else math.inf
        self._peers = PeerTable(content.area.neighbours, content.beat_s, now, started_at - now, skew_limit_s)
        by_clock = content.readings.ticks == "clock"
        self._scan = (TickReadings if by_clock else ScanReadings)(content, now, started_at - now)
        self._shown_ages = self._scan.readings.ages  # of the readings that were last published
        self._shown_readings: tuple[ReadingsMessage, float] | None = None  # the last message of readings, and its time
        self._n_shown = 0
        self._rejections = Rejections()
        self._splits = Splits(content.area.name, content.identity)
        self._next: Configuration | None = None  # in use from the next scan on, once all areas hold theirs
        self._quiet_until = now  # without an estimate nothing is published before
        self._end = ScanEnd(PATIENCE_HEARTBEATS * content.beat_s)
        self._published = PublishedState(
            content.area, self._peers, self._scan, self._rejections, self._splits, self._header
        )

    # The interface

    def follow_on(self) -> None:
        """Notes that the area has gone over to this configuration.

        For a while no state without an estimate is published, so that the last state of the area stays visible.
        """
        self._quiet_until = self._now + FRESH_HEARTBEATS * self._heartbeat_s

    @abstractmethod
    def describe_backend(self) -> str:
        """Returns, for the log, the back end of the exchange, and how often another had to compute; or ""."""

    @property
    def scan(self) -> int:
        """The scan that the area works on; 0 before telemetry."""
        return self._scan.scan

    def wait_s(self, now: float) -> float:
        """Returns the time until ``handle`` must be called again, events or not, s."""
        return max(0.0, min(self._due_times()) - now)

    def _due_times(self) -> Iterator[float]:
        yield self._next_heartbeat
        yield from self._peers.due_times(self._now, self._is_at_rest)
        yield from self._peers.aging_times(self._now)
        yield self._scan.next_tick_at
        yield self._scan.readings.ages.next_overdue(self._now)
        yield from (
            at
            for heartbeats in (FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS)
            if (at := self._scan.fresh_until(heartbeats)) > self._now
        )

    def handle(self, events: Sequence[Event], now: float) -> Iterator[Action]:
        """Takes in ``events``, all that arrived since the last call, and yields the actions.

        The caller carries out each action as it comes: neighbours need not wait for messages that only watchers get.
        """
        self._is_awake = now < self._next_heartbeat + self._heartbeat_s
        self._now = now
        self._scan.note_time(now)
        for event in events:
            match event:
                case StopRequested(reason):
                    yield from self._end.take(self._term, is_over=True)
                    yield Finish(reason)
                    return
                case ClockSet(offset):
                    self._scan.clock_offset = offset
                    self._peers.follow_clock(offset, now)
                case Received(message, key_sender):
                    yield from self._take(message, key_sender)
                case Rejected(reason, count, sender, at_field):
                    self._rejections.note_not_let_in(reason, count)
                    if sender:
                        self._rejections.note_unreadable(sender, f"{reason}: {at_field}", self.scan)
                case PresenceChanged(area) if area not in self._peers:
                    continue  # a neighbour by another configuration
                case PresenceChanged(area, True):
                    self._peers.gone.pop(area, None)
                    self._peers[area].is_owed_reply = True
                case PresenceChanged(area, False, leave_reason):
                    self._peers.note_gone(area, leave_reason)
                case Ordered():
                    yield from self._follow(event)
                case Offered(configuration):
                    self._take_offer(configuration)
        is_heartbeat = now >= self._next_heartbeat
        if is_heartbeat:
            self._next_heartbeat = now + self._heartbeat_s
        yield from self._act(is_heartbeat=is_heartbeat)
        yield from (self._publish(name, message) for name, message in self._peers.take_due_repeats(now))
        yield from self._reply_due(is_heartbeat=is_heartbeat)
        for shown in self._show(is_heartbeat=is_heartbeat):
            is_blank = isinstance(shown.message, StateMessage) and not shown.message.buses
            if not (is_blank and now < self._quiet_until):
                yield shown
        yield from self._show_readings()
        yield from self._end.take(self._term)

    # The parts of a strategy

    @property
    @abstractmethod
    def _term(self) -> Term:
        """(scan, revision)."""

    @property
    @abstractmethod
    def _is_at_rest(self) -> bool:
        """True where heartbeats may become rare."""

    @abstractmethod
    def _find_rejection(self, message: Message) -> str:
        """Returns the reason, in short, for which a well-formed message cannot be used; empty if it can."""

    @abstractmethod
    def _take_numbering(self, name: str, message: HeartbeatMessage) -> Iterator[Action]:
        """Notes how neighbour ``name`` numbers scans."""

    @abstractmethod
    def _take_telemetry(self, message: TelemetryMessage) -> Iterator[Action]:
        """Takes in readings of this area."""

    @abstractmethod
    def _take_load(self) -> Iterator[Action]:
        """Notes that a neighbour has sent a new load message."""

    @abstractmethod
    def _receive(self, name: str, message: LinkMessage) -> Iterator[Action]:
        """Takes in a message of the strategy, or a heartbeat, of the present incarnation of neighbour ``name``."""

    @abstractmethod
    def _act(self, *, is_heartbeat: bool) -> Iterator[Action]:
        """Yields the actions that are due after all events are taken in."""

    @abstractmethod
    def _describe_standing(self, name: str) -> dict[str, Any]:
        """Returns ``revision``, ``k``, ``final`` and ``y`` of a heartbeat to ``name``."""

    @abstractmethod
    def _is_side_complete(self, name: str) -> bool:
        """True where all on this side of the boundary to neighbour ``name`` is of this scan, received and fresh."""

    @abstractmethod
    def _show(self, *, is_heartbeat: bool) -> Iterator[Publish]:
        """Yields the state if it is to be published."""

    @abstractmethod
    def _take_readings_anew(self) -> Iterator[Action]:
        """Starts again with the readings that this scan has now, on command of the operator."""

    @property
    def _may_go_over(self) -> bool:
        """True where no neighbour waits for a message of this scan: always, unless a strategy overrides it."""
        return True

    # The next split

    def _take_offer(self, configuration: Configuration | None) -> None:
        """Keeps ``configuration`` for the scan from which on all areas use its split, if the split is new and sound."""
        split = configuration.identity if configuration else NO_SPLIT
        is_next = split.is_sound and split != self._splits.own
        self._next, self._splits.held = (configuration, split) if is_next else (None, NO_SPLIT)
        self._splits.edited_next = split if split.edited else NO_SPLIT

    def _is_from_next(self, message: Message, key_sender: str) -> bool:
        """True where ``message`` is a heartbeat of a neighbour, by the next configuration, that works on its split.

        All areas held their files of that split when the neighbour went over to it.
        """
        if self._next is None or not isinstance(message, HeartbeatMessage) or message.split != self._splits.held:
            return False
        return self._may_go_over and not find_rejection(message, key_sender, self._next, self._wall)

    def _go_over(self) -> Iterator[Action]:
        """Goes over to the next configuration."""
        assert self._next is not None
        yield from self._end.take(self._term, is_over=True)
        yield GoOver(self._next)

    # Incoming messages

    def _follow(self, ordered: Ordered) -> Iterator[Action]:
        """Follows a command of the operator."""
        self._published.ordered = ordered
        if self._scan.follow(ordered):
            yield from self._take_readings_anew()

    def _take(self, message: Message, key_sender: str) -> Iterator[Action]:
        wall = self._wall
        if self._is_from_next(message, key_sender):
            yield from self._go_over()
            return
        reason = find_rejection(message, key_sender, self._content, wall)
        if reason in ("", OTHER_BUS, OTHER_VARIABLES):
            self._splits.take(message)
        if reason in ("", OTHER_VARIABLES) and not isinstance(message, TelemetryMessage):
            self._rejections.note_contradiction(key_sender, self._agreement.find_contradiction(message))
        if not reason and message.kind not in self._kinds:
            reason = OTHER_STRATEGY
        if not reason and key_sender in self._rejections.contradictions:
            reason = CONTRADICTION
        if not reason and isinstance(message, HeartbeatMessage):
            yield from self._take_numbering(key_sender, message)
        if not reason:
            reason = self._find_rejection(message)
        if isinstance(message, TelemetryMessage) and message.header.sender != self._content.readings.leader:
            key_sender = message.header.sender
        if reason:
            self._rejections.reject(message, key_sender, reason, wall)
            if reason in (FUTURE, FAR_SCAN):
                self._note_clock(message, key_sender)
            return
        self._rejections.ahead.pop(key_sender, None)
        if isinstance(message, TelemetryMessage):
            yield from self._take_telemetry(message)
        elif not self._peers.is_of_former_incarnation(message.header, self._now):
            if isinstance(message, LoadMessage):
                peer = self._peers[key_sender]
                peer.is_owed_reply = True
                if peer.take_load(message, self._now):
                    yield from self._take_load()
            elif isinstance(message, LinkMessage):
                yield from self._receive(key_sender, message)

    def _note_clock(self, message: Message, name: str) -> None:
        """Notes the clock of a neighbour by a message that is rejected for its time or its scan."""
        if isinstance(message, LinkMessage) and message.header.sender == name and name in set(self._peers):
            self._peers[name].take_times(message, self._now, self._wall)
            self._peers.note_skew(name)

    def _note(self, name: str, message: LinkMessage) -> bool:
        """Notes what a message states of its sender and of the link; returns whether the sender has restarted."""
        peer = self._peers[name]
        is_restart = peer.incarnation not in (None, message.header.incarnation)
        peer.is_owed_reply |= is_restart or not self._peers.receives(name, self._now)  # to tell that it is received
        peer.take(message, self._now, self._wall, is_awake=self._is_awake)
        self._peers.note_skew(name)
        is_asking = self._is_at_rest and peer.has_been_left_alone(self._now)  # it repeats until it receives us
        peer.is_owed_reply |= is_asking
        if message.receives:
            self._peers.gone.pop(name, None)  # the token was lost, not the process
        return is_restart

    # Outgoing messages

    def _header(self, sequence: int) -> Header:
        return Header(
            run=self._content.run,
            sender=self._area.name,
            incarnation=self._incarnation,
            scan=self.scan,
            sequence=sequence,
            time=self._wall,
        )

    @property
    def _wall(self) -> float:
        """Now, as own messages state it, s since 1970: the host's clock, but never set back."""
        return self._now + self._peers.clock_offset

    def _publish(self, name: str, message: LoadMessage | LinkMessage) -> Publish:
        """Returns the sending of ``message`` to neighbour ``name``, with the present state of the link filled in."""
        if isinstance(message, LoadMessage):
            return Publish(message, name)
        return Publish(self._peers.stamp(name, message, self._now, is_complete=self._is_side_complete(name)), name)

    def _send(self, name: str, sent: Outgoing[M], message: M) -> Publish:
        """Returns the sending of a new message, which is repeated until it is acknowledged."""
        peer = self._peers[name]
        peer.await_reply(sent, message, self._now)
        return self._publish(name, message)

    def _send_if_lacking(
        self, name: str, sent: Outgoing[Any], received: int, *, even_if_repeated: bool = False
    ) -> Iterator[Publish]:
        """Yields the last message once more to a neighbour that reports its loss after an absence or a restart."""
        if sent.message is None or received == sent.sequence or (sent.repeat is not None and not even_if_repeated):
            return
        if sent.repeat is None:
            self._peers[name].await_reply(sent, sent.message, self._now)
        yield self._publish(name, sent.message)

    def _heartbeat(self, name: str) -> Publish:
        standing = self._describe_standing(name)
        plant, offset = self._scan.numbering
        # the state of the link is filled in as the message is sent
        link: dict[str, Any] = {"receives": False, "answers": 0.0, "received": (0, 0), "complete": False}
        standing |= link | describe_boundary(self._area, name)
        return self._publish(
            name,
            HeartbeatMessage(
                header=self._header(1),
                variables=self._area.boundaries[name].names,
                **standing,
                plant=plant,
                offset=offset,
                clock=self._peers.correction,
                split=self._splits.own,
            ),
        )

    def _reply_due(self, *, is_heartbeat: bool) -> Iterator[Publish]:
        """Yields a heartbeat to each neighbour that is owed one, or that was sent nothing for a while.

        Neighbours with one heartbeat per interval get it together with the state, so the process wakes once for all.
        """
        for name, peer in self._peers.items():
            is_changed = peer.sent_complete != self._is_side_complete(name)
            is_owed = self._peers.owes_heartbeat(name, self._now, self._is_at_rest, is_heartbeat)
            if peer.is_owed_reply or is_changed or is_owed:
                yield self._heartbeat(name)

    # Readings

    @property
    def _may_show_readings(self) -> bool:
        """True where no neighbour waits for another message of this scan."""
        return self._is_at_rest

    def _describe_readings(self) -> Mapping[str, tuple[float, float]]:
        """Meter -> its reading in the state of this scan, p.u. or rad, and its normalised residual; {} if unknown."""
        return {}

    def _show_readings(self) -> Iterator[Publish]:
        """Yields the readings of the scan, for recorders: once, and every ``REPEAT_READINGS_S`` for late ones."""
        readings = self._scan.readings
        if not self._may_show_readings:
            return
        if readings.ages is self._shown_ages:
            if self._shown_readings and self._now >= self._shown_readings[1] + REPEAT_READINGS_S:
                self._shown_readings = self._shown_readings[0], self._now
                yield Publish(self._shown_readings[0], None)
            return
        self._shown_ages = readings.ages
        self._n_shown += 1
        described = self._describe_readings()
        read = {m.meter.id: m for m in readings.measurements if m.meter.source is not Source.VIRTUAL}
        estimated = [meter for meter in read if meter in described]
        ids = (*estimated, *(meter for meter in read if meter not in described))
        message = ReadingsMessage(
            header=self._header(self._n_shown),
            taken_at=readings.ages.taken_at,
            meters=ids,
            values=tuple(float(read[meter].value) for meter in ids),
            sigmas=tuple(float(read[meter].sigma) for meter in ids),
            times=tuple(map(readings.ages.times.__getitem__, ids)),
            estimates=tuple(described[meter][0] for meter in estimated),
            normalised=tuple(described[meter][1] for meter in estimated),
        )
        self._shown_readings = message, self._now
        yield Publish(message, None)

    # Load messages

    def _received_loads(self) -> dict[str, Loads]:
        return {name: peer.received_load.loads for name, peer in sorted(self._peers.items()) if peer.received_load}

    def _send_loads(self) -> Iterator[Publish]:
        """Yields to each neighbour the net load of this side, once all other neighbours have sent theirs."""
        received = self._received_loads()
        missing = set(self._peers) - received.keys()
        for n in self._area.neighbours:
            if missing - {n.area}:
                continue
            loads = load_message_for(self._area, n.area, self._scan.readings.net_loads, received)
            sent = self._peers[n.area].load
            last, message = sent.message, LoadMessage.of(self._header(sent.sequence + 1), n.bus, loads)
            # in a tree the same readings give the same load, to the last bit
            if last is None or replace(last, header=message.header) != message or last.header.scan != self.scan:
                yield self._send(n.area, sent, message)
