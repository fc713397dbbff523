"""The protocol of one area under strategy ``information``: the areas together take the centralised estimate's steps.

The areas form a tree, and each knows which neighbour lies towards the hub. In round k an area waits for Up(k) of all
other neighbours, adds its own, and sends Up(k) on; who has nobody towards the hub knows the totals and decides. Down(k)
carries the totals and the information of everything else back; who hears it takes the step, passes Down(k) on and is
in round k + 1. Every message says which (scan, revision, k) it belongs to, so that messages of different iterations
never meet.

A *term* is (scan, revision). The links in use are fixed when an area enters a term; whatever must change them (a
neighbour silent, back, or begun anew; readings that come late) raises the revision, and everybody begins again at
round 0 with the state so far.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from agents.area_file import AreaFile
from agents.area_round import AreaRound, Content, Decider, Outcome
from agents.events import Action, Event, Finish, PresenceChanged, Publish, Received, Refused, StopRequested
from agents.hearing import FRESH_BEATS, PASSED_ON_BEATS
from agents.last_words import LastWords
from agents.messages import (
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    Message,
    TelemetryMessage,
    UpMessage,
)
from agents.peer_table import PeerTable
from agents.peers import Peer, Term
from agents.refusals import FUTURE, find_lead, find_refusal
from agents.rounds_state import RoundsState
from agents.scan_readings import News, ScanReadings
from agents.triangle import write_triangle
from dsse_core.verdict import Totals

STILL_BEATS = 2  # between two calls: the process has stood still, and how long messages took is not known

RoundsMessage = HeartbeatMessage | UpMessage | DownMessage


class RoundsProtocol:
    """One area's part: events and time in, actions out; no bus, no clock, no randomness.

    Args:
        started_at: wall-clock time, s since 1970, at monotonic time ``now``; only stamps messages.
    """

    def __init__(self, content: AreaFile, incarnation: Incarnation, *, now: float, started_at: float) -> None:
        self._content = content
        self._area = content.area
        self._incarnation = incarnation
        self._clock_offset = started_at - now
        self._now = now
        self._is_awake = True  # since it was last left alone: else messages have lain unheard
        self._beat_s = content.beat_s
        self._peers = PeerTable(content.area.neighbours, content.beat_s, now, self._clock_offset)
        self._round = AreaRound(content.area)
        self._scan = ScanReadings(content, now)
        self._revision = 0
        self._is_change_due = False
        self._raised_at = -math.inf  # when this area itself last raised the revision
        self._heard_loads: dict[str, LoadMessage] = {}
        self._loads = LastWords(content.area.neighbours, self, self._header)
        self._refused: Counter[str] = Counter()
        self._not_let_in: dict[str, int] = {}
        self._ahead: dict[str, float] = {}  # sender refused as from the future, "" for the plant -> by how much, s
        self._next_beat = now + content.beat_s
        self._state = RoundsState(content, self._peers, self._round, self._scan)

    # The interface of a protocol

    def describe_backend(self) -> str:
        """For the log: what computes, and how often something else had to."""
        return self._round.estimation.describe_backend()

    @property
    def scan(self) -> int:
        """The scan that the area works on; 0 before telemetry."""
        return self._scan.scan

    @property
    def term(self) -> Term:
        """(scan, revision)."""
        return self._scan.scan, self._revision

    @property
    def outcome(self) -> Outcome | None:
        """How the present term has ended; None while it has not."""
        return self._round.outcome

    @property
    def removed(self) -> tuple[str, ...]:
        """The meters of all areas that this term has taken out as bad data, in order."""
        return self._round.removed

    def wait_s(self, now: float) -> float:
        """How long the protocol may be left alone, s."""
        return max(0.0, min(self._due_times()) - now)

    def _due_times(self) -> Iterator[float]:
        yield self._next_beat
        yield from self._peers.due_times(self._now, self._is_final)
        yield self._scan.deadline
        if self._is_change_due:
            yield self._raised_at + self._beat_s
        elif not self._is_final:
            yield from map(self._peers.silent_at, self._round.links)
        if self._scan.next_scan:
            yield self._leaves_at if self._leaves_at > self._now else math.inf
        for at in self._peers.aging_times(self._now):
            yield at
        yield from (at for beats in (FRESH_BEATS, PASSED_ON_BEATS) if (at := self._scan.fresh_until(beats)) > self._now)

    def handle(self, events: Sequence[Event], now: float) -> Iterator[Action]:
        """Take in ``events``, all that arrived since the last call, and say what to do, one by one as it is known."""
        self._is_awake = now - self._now < STILL_BEATS * self._beat_s
        self._now = now
        for event in events:
            match event:
                case StopRequested(reason):
                    yield Finish(reason)
                    return
                case Received(message, key_sender):
                    yield from self._take(message, key_sender)
                case Refused(reason, count):
                    self._not_let_in[reason] = max(count, self._not_let_in.get(reason, 0))
                case PresenceChanged(area, True):
                    self._peers.gone.pop(area, None)
                    self._peers[area].is_owed_word = True
                case PresenceChanged(area, False, farewell):
                    self._peers.note_gone(area, farewell)
        yield from self._act_in_time()
        yield from self._answer()
        yield from self._show()

    # What comes in

    def _take(self, message: Message, key_sender: str) -> Iterator[Action]:
        wall = self._now + self._clock_offset
        reason = find_refusal(message, key_sender, self._content, wall)
        if not reason and not isinstance(message, TelemetryMessage | LoadMessage | RoundsMessage):
            reason = "other strategy"
        if not reason and isinstance(message, HeartbeatMessage):
            yield from self._act_on(self._scan.take_numbering(key_sender, message.plant, message.offset))
        if not reason and isinstance(message, RoundsMessage) and not self._scan.may_enter(message.header.scan):
            reason = "scan far ahead of the telemetry"
        if reason:
            self._refused[reason] += 1
            if reason == FUTURE:
                self._ahead.setdefault(key_sender, find_lead(message.header, wall))
            return
        self._ahead.pop(key_sender, None)
        match message:
            case TelemetryMessage():
                yield from self._act_on(self._scan.take(message, self._now))
            case LoadMessage():
                last = self._heard_loads.get(key_sender)
                if last is None or message.header.order > last.header.order:
                    self._heard_loads[key_sender] = message
                    if self._scan.are_there:
                        yield from self._tell_loads()
            case HeartbeatMessage() | UpMessage() | DownMessage():
                yield from self._hear(key_sender, message)

    def _act_on(self, news: News) -> Iterator[Action]:
        """Use new readings, or readings that belong to another scan than was thought."""
        match news:
            case News.NEXT_SCAN:
                yield from self._enter_next_scan()
            case News.AWAITED:
                yield from self._begin()
            case News.LATE:
                yield from self._change()

    def _hear(self, name: str, message: RoundsMessage) -> Iterator[Action]:
        """What a message of any kind says of its sender: its life, its term, whether it hears us."""
        peer = self._peers[name]
        if self._peers.is_of_former_life(message.header, self._now):
            return
        is_restart = peer.incarnation not in (None, message.header.incarnation)
        peer.is_owed_word |= is_restart or not self._peers.hears(name, self._now)  # that it is heard
        peer.take(message, self._now, self._now + self._clock_offset, is_awake=self._is_awake)
        peer.is_owed_word |= self._is_final and peer.has_been_left_alone(self._now)  # it repeats until it hears us
        if is_restart and self._is_load_of_other_life(name, message.header.incarnation):
            del self._heard_loads[name]
        if message.hears:
            self._peers.gone.pop(name, None)  # the token was lost, not the process
        term = (message.header.scan, message.revision)
        if term[0] > self.scan:
            peer.take_answer()  # it has moved on, and lacks nothing
            if self._owes_final():
                return
        if term > self.term:
            yield from self._enter(term, {name} if message.hears else ())
        elif self.scan and name not in self._peers.distrusted and self._must_change_for(name, message, is_restart):
            if term[0] == self.scan:
                self._revision = max(self._revision, term[1])
            yield from self._change()
        if term < self.term:
            # a message that is being repeated shows our term as well, but not how scans are numbered
            peer.is_owed_word |= peer.repeat is None or term[0] < self.scan
        elif name in self._round.links:
            yield from self._take_in_term(name, peer, message)

    def _is_load_of_other_life(self, name: str, life: Incarnation) -> bool:
        return name in self._heard_loads and self._heard_loads[name].header.incarnation != life

    def _must_change_for(self, name: str, message: RoundsMessage, is_restart: bool) -> bool:
        """Whether a neighbour is back that is not in use, or begins anew."""
        return is_restart or (name not in self._round.links and message.hears)

    def _take_in_term(self, name: str, peer: Peer, message: RoundsMessage) -> Iterator[Action]:
        if peer.sent is not None and message.received >= peer.sent.k:
            peer.take_answer()
        if isinstance(message, HeartbeatMessage):
            if why := self._round.find_other_end(message.k, message.final):
                yield from self._distrust(name, why)
            elif peer.sent is not None and peer.repeat is None and message.received < peer.sent.k:
                yield self._send_again(name)  # it was cut off before it had it
        elif not self._is_change_due and isinstance(message, DownMessage) == (name == self._area.towards_hub):
            yield from self._take_round(name, peer, message)

    def _take_round(self, name: str, peer: Peer, message: UpMessage | DownMessage) -> Iterator[Action]:
        """A message of a round from a neighbour in use: what is not answered at once is acknowledged at once."""
        if message.k > self._round.k:
            return  # said to a former life of this area
        peer.is_owed_word = True
        peer.take_round(message)
        if message.k < self._round.k:
            if peer.sent is not None and message.received < peer.sent.k and peer.has_waited_for_trip(self._now):
                yield self._send_again(name)  # it lacks our answer
        elif isinstance(message, UpMessage):
            if self._round.take_up(name, message):
                peer.take_answer()
                yield from self._go_on()
        elif self._round.is_waited_for():
            peer.take_answer()
            yield from self._take_down(name, message)

    # Terms

    @property
    def _is_final(self) -> bool:
        return self._round.outcome is not None or self.scan == 0

    @property
    def _leaves_at(self) -> float:
        """When a scan has taken too long."""
        return self._scan.entered_at + 2 * self._peers.patience_s

    def _owes_final(self) -> bool:
        """Whether a neighbour may not yet have the final message of this scan: leaving would starve it."""
        if self._round.outcome is None or self._now >= self._leaves_at:
            return False
        lower = self._round.lower
        return any(self._peers[name].repeat is not None and self._peers.is_present(name, self._now) for name in lower)

    def _enter_next_scan(self) -> Iterator[Action]:
        """Leave this scan for a later one with readings: at its end, or when it has taken too long."""
        if not self._scan.next_scan or self._owes_final():
            return
        if self._is_final or self._now >= self._leaves_at:
            yield from self._enter((self._scan.next_scan, 0))

    def _change(self) -> Iterator[Action]:
        """The links in use must change: the next revision; no more than one of an area's own per beat."""
        if self._now < self._raised_at + self._beat_s:
            self._is_change_due = True
            return
        self._raised_at = self._now
        yield from self._enter((self.scan, self._revision + 1))

    def _enter(self, term: Term, also: Collection[str] = ()) -> Iterator[Action]:
        """Begin ``term`` with all present neighbours, and those in ``also``; forget the former one."""
        scan, self._revision = term
        if scan != self.scan:
            self._peers.distrusted = {}
        self._is_change_due = False
        self._scan.enter(scan, self._now)
        self._peers.begin_term()
        self._round.enter(self._peers.present(self._now) | (set(also) - self._peers.distrusted.keys()))
        if self._scan.are_there:
            yield from self._begin()

    def _begin(self) -> Iterator[Action]:
        """Round 0 with the readings."""
        yield from self._tell_loads()
        loads = {name: message.load for name, message in self._heard_loads.items()}
        self._round.begin(self._scan.readings.measurements, stale=self._scan.stale, loads=loads)
        yield from self._go_on()

    # Rounds

    def _go_on(self) -> Iterator[Action]:
        """Send Up(k) as soon as all others have, or decide; alone, until the end."""
        while self._round.may_go_on and not self._is_change_due:
            totals = self._round.add_up()
            if name := self._round.towards_hub:
                yield self._send(name, UpMessage(**self._fields_of(name, self._round.find_up(totals), self._round.k)))
                return
            life = (self._incarnation.start_ms, self._incarnation.random)
            yield from self._descend(totals, Decider(self._area.name, life), None)

    def _take_down(self, name: str, message: DownMessage) -> Iterator[Action]:
        """Follow the side of the hub, unless its message contradicts itself: then go on without it in this scan."""
        if why := self._round.find_lie(message):
            yield from self._distrust(name, why)
            return
        yield from self._descend(message.totals, Decider(message.decider, message.life), message)
        yield from self._go_on()

    def _distrust(self, name: str, why: str) -> Iterator[Action]:
        """Go on without a neighbour in this scan: what it says contradicts itself, or what it was told."""
        self._peers.distrusted[name] = why
        yield from self._change()

    def _descend(self, totals: Totals, decider: Decider, down: DownMessage | None) -> Iterator[Action]:
        """Decide on the totals of all, or follow who has, and pass that on."""
        verdict, k = self._round.decide(totals), self._round.k
        for name, content in self._round.descend(verdict, totals, decider, down):
            fields = self._fields_of(name, content, k)
            message = DownMessage(**fields, verdict=str(verdict), decider=decider.name, life=decider.life)
            yield self._send(name, message)
        if self._round.outcome is not None:
            yield from self._enter_next_scan()

    # What goes out

    def _header(self, last: Message | None) -> Header:
        return Header(
            run=self._content.run,
            sender=self._area.name,
            incarnation=self._incarnation,
            scan=self.scan,
            sequence=last.header.sequence + 1 if last else 1,
            time=self._now + self._clock_offset,
        )

    def _fields_of(self, name: str, content: Content, k: int) -> dict[str, Any]:
        """Of a message of round ``k``; what is stamped as it is sent is left open."""
        peer = self._peers[name]
        peer.sequence += 1
        told, no_load = content.information, content.no_load
        return {
            "header": replace(self._header(None), sequence=peer.sequence),
            "bus": peer.bus,
            "revision": self._revision,
            "k": k,
            "hears": False,
            "answers": 0.0,
            "received": -1,
            "R": write_triangle(told.R) if told else (),
            "z": tuple(told.z.tolist()) if told else (),
            "no_load": write_triangle(no_load.R) if no_load else (),
            "power": content.power,
            "totals": content.totals,
        }

    def _send(self, name: str, message: UpMessage | DownMessage) -> Publish:
        """A message of a round for the first time."""
        self._peers[name].await_answer(message, self._now)
        return Publish(self._peers.stamp(name, message, self._now), name)

    def _send_again(self, name: str) -> Publish:
        peer = self._peers[name]
        assert isinstance(peer.sent, UpMessage | DownMessage)
        if peer.repeat is None:
            peer.await_answer(peer.sent, self._now)
        return Publish(self._peers.stamp(name, peer.sent, self._now), name)

    def _heartbeat(self, name: str) -> Publish:
        peer, outcome = self._peers[name], self._round.outcome
        plant, offset = self._scan.numbering
        has_y = outcome is not None and name in self._round.links and not self._round.estimation.failure
        message = HeartbeatMessage(
            header=self._header(None),
            bus=peer.bus,
            revision=self._revision,
            k=self._round.k,
            hears=False,
            answers=0.0,
            received=-1,
            final=outcome is not None,
            complete=self._state.is_side_complete(name, self.term, self._now),
            y=self._round.estimation.boundary_values(name) if has_y else (),
            plant=plant,
            offset=offset,
        )
        return Publish(self._peers.stamp(name, message, self._now), name)

    def _tell_loads(self) -> list[Publish]:
        heard = {name: message.load for name, message in sorted(self._heard_loads.items())}
        return self._loads.tell_loads(self._scan.readings.net_load, heard)

    # What time brings

    def _act_in_time(self) -> Iterator[Action]:
        if self._now >= self._scan.deadline:
            self._scan.go_on_without()
            yield from self._begin()
        is_someone_silent = any(not self._peers.is_present(name, self._now) for name in self._round.links)
        if self._is_change_due or (is_someone_silent and not self._is_final):
            yield from self._change()
        yield from self._enter_next_scan()
        for name in self._peers.take_due_repeats(self._now):
            yield self._send_again(name)

    def _answer(self) -> Iterator[Publish]:
        """A heartbeat to whom is owed one, or has not been spoken to for a beat."""
        for name, peer in self._peers.items():
            is_changed = peer.told_complete != self._state.is_side_complete(name, self.term, self._now)
            if peer.is_owed_word or is_changed or self._peers.owes_heartbeat(name, self._now, self._is_final):
                yield self._heartbeat(name)

    def _show(self) -> Iterator[Publish]:
        """The state once a scan at rest, anew at every beat, and when its quality changes."""
        is_beat = self._now >= self._next_beat
        if is_beat:
            self._next_beat = self._now + self._beat_s
            yield from (Publish(message, name) for name, message in self._loads.loads.items())
        state = self._state.show(self.term, self._now, self._ahead, self._count, self._header, is_beat=is_beat)
        if state is not None:
            yield Publish(state, None)

    def _count(self) -> tuple[Mapping[str, int], Mapping[str, int], Mapping[str, int]]:
        """Sequence numbers of load messages sent and heard by neighbour, and what was refused by reason."""
        loads = {name: m.header.sequence for name, m in self._loads.loads.items()}
        heard_loads = {name: m.header.sequence for name, m in self._heard_loads.items()}
        return loads, heard_loads, self._refused + self._scan.refused + Counter(self._not_let_in)
