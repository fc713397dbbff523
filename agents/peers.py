"""What an area knows of its neighbours as processes: which life, where it stands, how long a message takes.

Presence is two-way: a neighbour is there only if it is heard and says that it hears us, so that both sides of a link
that passes messages one way only come to the same conclusion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from agents.messages import DownMessage, Header, HeartbeatMessage, Incarnation, UpMessage

FIRST_WAIT_S = 0.05  # until a message is repeated, before the round trip of the link has been measured
LEAST_WAIT_S = 0.005
LEAST_LONGEST_WAIT_S = 0.02
LONGEST_WAIT_TRIPS = 4.0  # round trips
DEVIATIONS = 4.0  # of the round trip, added to it for the first wait (RFC 6298)
MEAN_GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4  # of a new sample (RFC 6298)
PATIENCE_WAITS = 20  # messages, one each longest wait, that should have come through: none does once in 5e8 times

Term = tuple[int, int]  # scan, revision


@dataclass
class RoundTrip:
    """The smoothed round trip of one link and its mean deviation, s; nan before the first sample.

    ``wait_s``: how long an answer is waited for before the first repeat; ``longest_wait_s``: between two of many.
    """

    mean: float = math.nan
    deviation: float = math.nan
    wait_s: float = FIRST_WAIT_S
    longest_wait_s: float = max(FIRST_WAIT_S, LEAST_LONGEST_WAIT_S)

    def take(self, sample: float) -> None:
        """Take in a measured round trip, s."""
        if math.isnan(self.mean):
            self.mean, self.deviation = sample, sample / 2
        else:
            self.deviation += DEVIATION_GAIN * (abs(sample - self.mean) - self.deviation)
            self.mean += MEAN_GAIN * (sample - self.mean)
        self.wait_s = max(LEAST_WAIT_S, self.mean + DEVIATIONS * self.deviation)
        self.longest_wait_s = max(LEAST_LONGEST_WAIT_S, LONGEST_WAIT_TRIPS * self.mean, self.wait_s)


@dataclass
class Repeat:
    """When a message is sent again if it is not answered; ``wait_s``: since the ``count``-th time that it was sent."""

    at: float
    wait_s: float
    count: int = 1


@dataclass
class Peer:
    """One neighbour. Times are of the own monotonic clock, s; -inf for never.

    ``present_at``: when it last said that it hears us, as far as that is believed; ``heard_at``: when it was last
    heard. ``term``, ``final``, ``complete``, ``y``: where it stood then. ``sent``: the last message of a round
    to it in the present term, ``repeat``: whether and when that is sent again.
    """

    bus: int
    present_at: float
    said_at: float = -math.inf
    asked_at: float = -math.inf  # when it was first spoken to since it was heard
    heard_at: float = -math.inf
    incarnation: Incarnation | None = None
    term: Term = (0, 0)
    final: bool = False
    complete: bool = False
    y: tuple[float, ...] = ()
    told_term: Term = (0, 0)
    told_complete: bool = False
    changed_at: float = -math.inf  # when it was last told other ones
    told_time: float = 0.0  # send time of the last message to it, as that states it
    is_owed_word: bool = False  # what it has sent, or what has changed, is to be answered at once
    sequence: int = 0  # of the last message of a round to it
    heard_sequence: int = 0
    sent: UpMessage | DownMessage | None = None
    repeat: Repeat | None = None
    mean_count: float = 1.0  # of sendings until an answer comes
    received: UpMessage | DownMessage | None = None  # its newest of the present term
    round_trip: RoundTrip = field(default_factory=RoundTrip)
    _newest: tuple[float, float] = (0.0, 0.0)  # send time by its clock, and when it arrived here

    def is_of_former_life(self, header: Header, now: float, over_s: float) -> bool:
        """A life not heard for ``over_s`` is over; the clock of the next one may have been set back."""
        is_over = now - self.heard_at > over_s
        return self.incarnation is not None and header.incarnation < self.incarnation and not is_over

    def take(
        self, message: HeartbeatMessage | UpMessage | DownMessage, now: float, wall: float, *, is_awake: bool
    ) -> None:
        """Note what any message says of the process and the link; ``wall``: ``now`` as own messages state it.

        ``is_awake``: it was taken in as it came, so that it tells how long messages take.
        """
        header = message.header
        if header.incarnation != self.incarnation:
            self.term, self.received, self._newest, self.heard_sequence = (0, 0), None, (0.0, 0.0), 0
            self.round_trip, self.final, self.complete, self.y = RoundTrip(), False, False, ()
        self.incarnation, self.heard_at = header.incarnation, now
        if message.hears:
            self.present_at = now
        if header.time > self._newest[0]:
            self._newest = (header.time, now)
            self.term = (header.scan, message.revision)
            self.final, self.complete, self.y = False, False, ()
            if isinstance(message, HeartbeatMessage):
                self.final, self.complete, self.y = message.final, message.complete, message.y
        if is_awake and 0 < message.answers <= wall:
            self.round_trip.take(wall - message.answers)

    def take_round(self, message: UpMessage | DownMessage) -> None:
        """Keep the newest message of a round of this term, which acknowledgements name."""
        if self.received is None or message.k > self.received.k:
            self.received = message
            self.heard_sequence = max(self.heard_sequence, message.header.sequence)

    def answers(self, now: float) -> float:
        """The send time of its newest message plus the time that this has lain here; 0 without one."""
        sent_at, arrived_at = self._newest
        return sent_at + (now - arrived_at) if sent_at else 0.0

    @property
    def patience_messages(self) -> float:
        """How many of its messages are lost before it counts as gone: PATIENCE_WAITS should have come through; of
        ``mean_count`` round trips one is not lost, of its root one message.
        """
        return PATIENCE_WAITS * math.sqrt(self.mean_count)

    def patience_s(self, least_s: float) -> float:
        """How long it may be silent before it counts as gone: ``least_s``, or as long as so many messages take."""
        return max(least_s, self.round_trip.longest_wait_s * self.patience_messages)

    def note_said(self, now: float) -> None:
        """It is spoken to now."""
        if not self.awaits_word:
            self.asked_at = now
        self.said_at, self.is_owed_word = now, False

    def next_time(self, wall: float) -> float:
        """The send time of a message that is sent at ``wall``: later than that of the one before, which it replaces."""
        self.told_time = max(wall, math.nextafter(self.told_time, math.inf))
        return self.told_time

    @property
    def awaits_word(self) -> bool:
        """Whether it has not been heard since it was spoken to."""
        return self.asked_at > self.heard_at

    def has_been_left_alone(self, now: float) -> bool:
        """Whether it has not been spoken to for so long, two round trips at least, that what it says is no answer."""
        return now >= self.said_at + self.round_trip.longest_wait_s / 2

    def await_answer(self, message: UpMessage | DownMessage, now: float) -> None:
        """``message`` has just been sent for the first time."""
        wait = self.round_trip.wait_s
        self.sent, self.repeat = message, Repeat(now + wait, wait)

    def wait_longer(self, now: float, most_s: float) -> None:
        """It has just been repeated; ``most_s``: how long is waited at most."""
        assert self.repeat is not None
        wait = min(2 * self.repeat.wait_s, self.round_trip.longest_wait_s, max(most_s, self.round_trip.wait_s))
        self.repeat = Repeat(now + wait, wait, self.repeat.count + 1)

    def take_answer(self) -> None:
        """The last message of a round has been answered or acknowledged."""
        if self.repeat is not None:
            self.mean_count += MEAN_GAIN * (self.repeat.count - self.mean_count)
            self.repeat = None

    def has_waited_for_trip(self, now: float) -> bool:
        """Whether an answer to ``sent`` could be here by now."""
        return math.isnan(self.round_trip.mean) or now - self.said_at >= self.round_trip.mean

    def begin_term(self) -> None:
        """Messages of rounds of a former term count no more; it is to hear of the new one."""
        self.sent = self.repeat = self.received = None
        self.is_owed_word = True
