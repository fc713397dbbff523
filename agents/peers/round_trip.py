"""The round trip of one link, measured by its answers, and how long an answer is waited for (RFC 6298)."""

from __future__ import annotations

import math
from dataclasses import dataclass

FIRST_WAIT_S = 0.05  # until a message is repeated, before the round trip of the link has been measured
LEAST_WAIT_S = 0.005
LONGEST_WAIT_TRIPS = 4.0  # round trips
DEVIATIONS = 4.0  # of the round trip, added to it for the first wait (RFC 6298)
MEAN_GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4  # of a new sample (RFC 6298)


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
