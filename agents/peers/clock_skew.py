"""By how much the clock of a neighbour is ahead, found from the messages that travel anyway.

Who sends a message states when, by its own clock; the round trip says between which two moments of the own clock that
was. So half a round trip is how far the finding can be wrong, whatever the two ways take, and the quickest of the last
few round trips is the most exact.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

SAMPLES = 8  # the last ones, of which the quickest counts (RFC 5905)
SKEW_SHARE = 1 / 4  # of the time between two scans, above which clocks are too far apart


class Skew(NamedTuple):
    """By how much another clock is ahead, s, and how far that may be wrong either way."""

    ahead_s: float
    doubt_s: float

    def exceeds(self, limit_s: float) -> bool:
        """Whether the clocks are certainly farther apart than ``limit_s``."""
        return abs(self.ahead_s) - self.doubt_s > limit_s


class ClockSkew:
    """``skew``: the best that is known of one neighbour's send times; None before any."""

    def __init__(self) -> None:
        self.skew: Skew | None = None
        self._samples: deque[Skew] = deque(maxlen=SAMPLES)

    def take(self, sent: float, received: float, trip_s: float) -> None:
        """A message was sent at ``sent`` by the neighbour's clock, and received at ``received`` by the own one."""
        sample, known = Skew(sent - (received - trip_s / 2), trip_s / 2), self.skew
        if known is not None and abs(sample.ahead_s - known.ahead_s) > sample.doubt_s + known.doubt_s:
            self._samples.clear()  # one of the clocks has been set
        self._samples.append(sample)
        self.skew = min(self._samples, key=lambda sample: sample.doubt_s)
