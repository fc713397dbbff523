"""Lead of a neighbour's clock over the own one, found from the messages that travel anyway.

Each message states its send time by the sender's clock. The round trip gives the two moments of the own clock between
which the message was sent. So the error is at most half a round trip, however long each of the two ways takes. The
quickest of the last few round trips is the most exact.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

SAMPLES = 8  # the last ones; the quickest of them counts (RFC 5905)


class Skew(NamedTuple):
    """Lead of another clock over the own one, s, and the largest error of it either way, s."""

    ahead_s: float
    doubt_s: float

    def exceeds(self, limit_s: float) -> bool:
        """True where the clocks are certainly farther apart than ``limit_s``."""
        return abs(self.ahead_s) - self.doubt_s > limit_s


class ClockSkew:
    """Skew of one neighbour's send times. ``skew``: the most exact of the last samples; None before the first."""

    def __init__(self) -> None:
        self.skew: Skew | None = None
        self._samples: deque[Skew] = deque(maxlen=SAMPLES)

    def take(self, sent: float, received: float, trip_s: float) -> None:
        """Takes in a message sent at ``sent`` by the neighbour's clock, and received at ``received`` by the own one.

        ``trip_s``: its round trip, s.
        """
        sample, known = Skew(sent - (received - trip_s / 2), trip_s / 2), self.skew
        if known is not None and abs(sample.ahead_s - known.ahead_s) > sample.doubt_s + known.doubt_s:
            self._samples.clear()  # one of the clocks has been set
        self._samples.append(sample)
        self.skew = min(self._samples, key=lambda sample: sample.doubt_s)
