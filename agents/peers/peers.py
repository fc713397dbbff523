"""The neighbours of an area as processes: incarnation, term and round, and the time that messages take.

Presence is two-way: a neighbour is present only if it is received and reports that it receives us. So both sides of a
link that passes messages one way only come to the same conclusion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from agents.messages.packing import (
    BoundaryUpdate,
    ExchangeMessage,
    HeartbeatMessage,
    Incarnation,
    LinkMessage,
    LoadMessage,
)
from agents.peers.clock_skew import ClockSkew
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS, is_newer

FIRST_WAIT_S = 0.05  # until a message is repeated, before the round trip of the link has been measured
LEAST_WAIT_S = 0.005
LONGEST_WAIT_TRIPS = 4.0  # round trips
DEVIATIONS = 4.0  # of the round trip, added to it for the first wait (RFC 6298)
MEAN_GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4  # of a new sample (RFC 6298)
PATIENCE_WAITS = 20  # messages expected to arrive, one each longest wait: all of them fail once in 5e8 times

Term = tuple[int, int]  # scan, revision
M = TypeVar("M", LoadMessage, ExchangeMessage)


@dataclass
class RoundTrip:
    """The smoothed round trip of one link and its mean deviation, s; nan before the first sample.

    ``wait_s``: time from the first sending of a message to its first repeat; ``longest_wait_s``: longest time between
    two repeats. ``trips_s``: LONGEST_WAIT_TRIPS round trips. ``most_s``: upper limit of all measured values, as samples
    follow from what the neighbour states.
    """

    most_s: float = math.inf
    mean: float = math.nan
    deviation: float = math.nan
    wait_s: float = FIRST_WAIT_S
    longest_wait_s: float = FIRST_WAIT_S
    trips_s: float = FIRST_WAIT_S

    def take(self, sample: float) -> None:
        """Takes in a measured round trip, s."""
        sample = min(sample, self.most_s)
        if math.isnan(self.mean):
            self.mean, self.deviation = sample, sample / 2
        else:
            self.deviation += DEVIATION_GAIN * (abs(sample - self.mean) - self.deviation)
            self.mean += MEAN_GAIN * (sample - self.mean)
        self.wait_s = min(max(LEAST_WAIT_S, self.mean + DEVIATIONS * self.deviation), self.most_s)
        self.trips_s = min(LONGEST_WAIT_TRIPS * max(LEAST_WAIT_S, self.mean), self.most_s)
        self.longest_wait_s = max(self.trips_s, self.wait_s)


def term_of(message: LinkMessage) -> Term:
    """Returns (scan, revision) of the sender; the revision is 0 under asynchronous strategies."""
    return message.header.scan, 0 if isinstance(message, BoundaryUpdate) else message.revision


@dataclass
class Repeat:
    """Time at which a message without acknowledgement is sent again; ``wait_s``: since it was sent for the
    ``count``-th time.
    """

    at: float
    wait_s: float
    count: int = 1


@dataclass
class Outgoing(Generic[M]):
    """Last message of one sort to a neighbour; ``repeat``: its next repeat, None without one.

    ``sequence``: number of the message, which goes on where the message is forgotten. Older messages are not kept:
    messages are absolute.
    """

    message: M | None = None
    repeat: Repeat | None = None
    sequence: int = 0


@dataclass
class Peer:
    """One neighbour. Times are of the own monotonic clock, s; -inf for never.

    ``present_at``: when it last reported that it receives us; before any report, the start of the own process; -inf
    after its process has ended. ``received_at``: when it was last received. ``term``, ``k``, ``final``, ``complete``,
    ``y``: as its newest message states them. ``load``, ``exchange``: the last load message and the last message of the
    strategy to it; ``received_load``, ``boundary``: the newest ones from it, the latter of
    asynchronous strategies; ``received_sequence``: number of its newest message of the strategy in this incarnation.
    ``clock``: skew of its send times; ``correction``: lead of its clock over its send times, s.
    """

    present_at: float
    since: float  # wall-clock time since which send times count: start of the own process, or its clock set forward
    heartbeat_s: float  # within which a message goes either way
    sent_at: float = -math.inf
    unanswered_since: float = -math.inf  # the first message to it since it was received
    received_at: float = -math.inf
    incarnation: Incarnation | None = None
    term: Term = (0, 0)
    k: int = 0
    final: bool = False
    complete: bool = False
    y: tuple[float, ...] = ()
    sent_term: Term = (0, 0)
    sent_complete: bool = False
    changed_at: float = -math.inf  # when these two last changed
    sent_time: float = 0.0  # send time that the last message to it states
    is_owed_reply: bool = False  # a heartbeat to it is due at once
    load: Outgoing[LoadMessage] = field(default_factory=Outgoing)
    exchange: Outgoing[ExchangeMessage] = field(default_factory=Outgoing)
    received_load: LoadMessage | None = None
    boundary: BoundaryUpdate | None = None
    received_sequence: int = 0
    mean_count: float = 1.0  # of sendings until an answer comes
    mean_gap: float = 1.0  # of arrivals, heartbeats
    round_trip: RoundTrip = field(init=False)
    clock: ClockSkew = field(default_factory=ClockSkew)
    correction: float = 0.0
    _newest: tuple[float, float] = (0.0, -math.inf)  # send time by its clock, and when it arrived here
    _timed: Incarnation | None = None  # incarnation that ``_newest`` and ``clock`` belong to
    _answered: float = -math.inf  # the latest own time that it has answered
    _arrived_at: float = -math.inf  # the first message of the last gap
    _load_at: float = -math.inf  # when the newest load message, or a repeat of it, arrived
    _exchange_at: float = -math.inf  # the same of the newest message of the strategy

    def __post_init__(self) -> None:
        self._forget_round_trip()

    def _forget_round_trip(self) -> None:
        self.round_trip = RoundTrip(most_s=self.over_s)

    @property
    def over_s(self) -> float:
        """Time, s, for which a send time or number counts that is not received again.

        A later time or a higher number than its sender has is false. Without this limit, all that the sender sends
        afterwards would be old for ever.
        """
        return PATIENCE_HEARTBEATS * self.heartbeat_s

    def take(self, message: LinkMessage, now: float, wall: float, *, is_awake: bool) -> None:
        """Notes what any message states of the process and the link; ``wall``: ``now`` as own messages state it.

        ``is_awake``: the message was taken in as it came, so that it measures how long messages take.
        """
        header = message.header
        if header.incarnation != self.incarnation:
            self.term, self.received_sequence = (0, 0), 0
            self._forget_round_trip()
            self.final, self.complete, self.y = False, False, ()
            if self.incarnation is not None:
                self.load.repeat = self.exchange.repeat = None  # the new process reports what it lacks
        elif is_awake:
            self._note_arrival(now)
        self.incarnation, self.received_at = header.incarnation, now
        if message.receives:
            self.present_at = now
        is_newest, trip_s = self.take_times(message, now, wall)
        if is_newest:
            self._note_standing(message)
        if is_awake and trip_s is not None:
            self.round_trip.take(trip_s)
            self._bring_repeats_forward()
        for sent, number in zip(self.outgoing, message.received, strict=True):
            if number == sent.sequence:  # a higher one was sent to a former incarnation of this area
                self.take_reply(sent)

    def _note_arrival(self, now: float) -> None:
        """Measures the gap between two arrivals.

        Messages within a heartbeat are one arrival. No gap counts for more than the patience.
        """
        gap_s = now - self._arrived_at
        if gap_s < self.heartbeat_s:
            return
        if math.isfinite(gap_s):
            gap = math.floor(min(gap_s, self.patience_s) / self.heartbeat_s)
            self.mean_gap += MEAN_GAIN * (gap - self.mean_gap)
        self._arrived_at = now

    def take_times(self, message: LinkMessage, now: float, wall: float) -> tuple[bool, float | None]:
        """Notes the send time of a message. Of a message that is rejected for its clock nothing else counts.

        Returns whether it is the newest message, and its round trip, s, None where it answers nothing.
        """
        header, trip_s = message.header, None
        if header.incarnation != self._timed:
            self._timed, self._newest = header.incarnation, (0.0, -math.inf)
            self.clock, self.correction = ClockSkew(), 0.0
        if self._may_answer(message.answers, wall):
            trip_s = wall - message.answers
            self._answered = max(self._answered, message.answers)
            self.clock.take(header.time, wall, trip_s)
        is_newest = header.time > self._newest[0] or now > self._newest[1] + self.over_s
        if is_newest:
            self._newest = (header.time, now)
            if isinstance(message, HeartbeatMessage):
                self.correction = message.clock
        return is_newest, trip_s

    def _may_answer(self, answers: float, wall: float) -> bool:
        """True where ``answers`` can be a neighbour's statement about a message of ours, and measures a round trip.

        The newest message that the neighbour has received was not sent before one that it has answered already. A
        message is sent to it every heartbeat interval, so ``answers`` is at most one interval before the latest time
        that it has answered. No message can have been under way for longer than since then.
        """
        return max(self.since, self._answered - self.heartbeat_s) <= answers <= wall

    def _bring_repeats_forward(self) -> None:
        """Shortens the wait for a repeat to the longest wait, as that is known now."""
        wait = self.round_trip.longest_wait_s
        for sent in self.outgoing:
            if (repeat := sent.repeat) is not None and wait < repeat.wait_s:
                sent.repeat = replace(repeat, at=repeat.at - repeat.wait_s + wait, wait_s=wait)

    def _note_standing(self, message: LinkMessage) -> None:
        self.final, self.complete, self.y = False, False, ()
        self.term = term_of(message)
        if isinstance(message, BoundaryUpdate):
            self.k, self.complete = message.header.sequence, message.complete
            return
        self.k = message.k
        if isinstance(message, HeartbeatMessage):
            self.final, self.complete, self.y = message.final, message.complete, message.y

    @property
    def outgoing(self) -> tuple[Outgoing[Any], ...]:
        """The load message and the message of the strategy to the neighbour, in the order of ``received``."""
        return self.load, self.exchange

    def take_load(self, message: LoadMessage, now: float) -> bool:
        """Keeps a load message that is newer than the last one, or that follows one not received for ``over_s``.

        Returns whether it is kept.
        """
        last, header = self.received_load, message.header
        silence_s = now - self._load_at
        is_new = last is None or is_newer(header.order, last.header.order, silence_s, self.over_s)
        if last is not None and header.incarnation != last.header.incarnation:
            is_new |= header.incarnation == self.incarnation  # its clock may have been set back
        if is_new:
            self.received_load = message
        if is_new or (last is not None and header.order == last.header.order):
            self._load_at = now
        return is_new

    def take_number(self, sequence: int, now: float) -> bool:
        """Notes the number of a message of the strategy.

        Returns whether it is higher than the last one, or follows one not received for ``over_s``.
        """
        is_new = is_newer(sequence, self.received_sequence, now - self._exchange_at, self.over_s)
        if is_new or sequence == self.received_sequence:
            self.received_sequence, self._exchange_at = sequence, now
        return is_new

    @property
    def received(self) -> tuple[int, int]:
        """Numbers of the neighbour's newest load message and message of the strategy, which acknowledge both; 0 without
        one.
        """
        load = self.received_load
        of_this_incarnation = load is not None and load.header.incarnation == self.incarnation
        return load.header.sequence if load and of_this_incarnation else 0, self.received_sequence

    def answers(self, now: float) -> float:
        """Returns the send time of the neighbour's newest message plus the time since its arrival, s; 0 without one."""
        sent_at, arrived_at = self._newest
        return sent_at + (now - arrived_at) if sent_at else 0.0

    @property
    def patience_messages(self) -> float:
        """Number of messages of the neighbour that are lost before it counts as gone.

        Of these, PATIENCE_WAITS should have arrived, one of ``messages_until_arrival`` each.
        """
        return PATIENCE_WAITS * self.messages_until_arrival

    @property
    def messages_until_arrival(self) -> float:
        """Number of messages of which one arrives.

        One of ``mean_count`` round trips succeeds, so one message of its root. Where messages are replaced before
        their answers arrive, ``mean_count`` stays too low, and one of ``mean_gap`` arrives.
        """
        by_answers, by_gaps = math.sqrt(self.mean_count), self.mean_gap
        return by_answers if by_answers > by_gaps else by_gaps

    @property
    def patience_s(self) -> float:
        """Time, s, for which the neighbour may be silent before it counts as gone; at least ``over_s``.

        ``patience_messages`` take this time, one each four round trips, or each heartbeat interval if that is shorter.
        The deviation of the round trip does not count.
        """
        wait_s, least_s = self.round_trip.trips_s, PATIENCE_HEARTBEATS * self.heartbeat_s  # called very often
        if wait_s > self.heartbeat_s:
            wait_s = self.heartbeat_s
        longest_s = wait_s * PATIENCE_WAITS * self.messages_until_arrival
        return longest_s if longest_s > least_s else least_s

    def note_sent(self, now: float) -> None:
        """Notes that a message is sent to the neighbour now."""
        if not self.awaits_reply:
            self.unanswered_since = now
        self.sent_at, self.is_owed_reply = now, False

    def next_time(self, wall: float) -> float:
        """Returns the send time of a message that is sent at ``wall``: later than that of the message before it."""
        self.sent_time = max(wall, math.nextafter(self.sent_time, math.inf))
        return self.sent_time

    @property
    def awaits_reply(self) -> bool:
        """True where the neighbour has not been received since a message was sent to it."""
        return self.unanswered_since > self.received_at

    def has_been_left_alone(self, now: float) -> bool:
        """True where the last message to the neighbour is at least two round trips old, so that a message from it is no
        answer.
        """
        return now >= self.sent_at + self.round_trip.longest_wait_s / 2

    def await_reply(self, sent: Outgoing[M], message: M, now: float) -> None:
        """Schedules the first repeat of ``message``, which is just being sent, as new or after an acknowledgement."""
        wait = self.round_trip.wait_s
        sent.message, sent.sequence, sent.repeat = message, message.header.sequence, Repeat(now + wait, wait)

    def wait_longer(self, repeat: Repeat, now: float, most_s: float) -> Repeat:
        """Returns the repeat after ``repeat``, which is just being carried out; ``most_s``: the longest wait, s, if the
        first wait of the link is no longer.
        """
        wait = min(2 * repeat.wait_s, self.round_trip.longest_wait_s, max(most_s, self.round_trip.wait_s))
        return Repeat(now + wait, wait, repeat.count + 1)

    def take_reply(self, sent: Outgoing[Any]) -> None:
        """Notes that the last message has been answered or acknowledged."""
        if sent.repeat is not None:
            count = min(sent.repeat.count, self.patience_messages)  # more than these are not lost, but left unanswered
            self.mean_count += MEAN_GAIN * (count - self.mean_count)
            sent.repeat = None

    def has_waited_for_trip(self, now: float) -> bool:
        """True where an answer to the last message could have arrived by now."""
        return math.isnan(self.round_trip.mean) or now - self.sent_at >= self.round_trip.mean

    def begin_term(self) -> None:
        """Drops the message of a round of the old term; owes the neighbour a heartbeat that announces the new term."""
        self.exchange.message = self.exchange.repeat = None
        self.is_owed_reply = True
