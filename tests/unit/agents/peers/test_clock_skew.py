"""How far a clock is off, from messages that take their time: what is found is within its doubt of the truth."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.peers.clock_skew import SAMPLES, ClockSkew

WAYS = st.tuples(st.floats(1e-5, 5.0), st.floats(1e-5, 5.0))  # s there, and back; clocks tell 2e-7 s apart


def answered(clock: ClockSkew, at: float, ways: tuple[float, float], ahead_s: float) -> None:
    """A message is sent at ``at``, answered at once by a clock that is ``ahead_s`` ahead, and its answer received."""
    there, back = ways
    clock.take(at + there + ahead_s, at + there + back, there + back)


@given(st.lists(WAYS, min_size=1, max_size=30), st.floats(-1e4, 1e4))
def test_the_truth_lies_within_the_doubt_whatever_the_two_ways_take(ways, ahead_s):
    clock = ClockSkew()
    for k, each in enumerate(ways):
        answered(clock, 10.0 * k, each, ahead_s)
    assert clock.skew is not None
    assert abs(clock.skew.ahead_s - ahead_s) <= clock.skew.doubt_s + 1e-9
    assert clock.skew.doubt_s <= min(sum(each) for each in ways[-SAMPLES:]) / 2 + 1e-9 or len(ways) > SAMPLES


def test_a_clock_that_has_been_set_is_noticed_at_the_next_message():
    clock = ClockSkew()
    for k in range(20):
        answered(clock, float(k), (0.01, 0.01), 0.0)
    answered(clock, 20.0, (0.3, 0.1), -5.0)
    assert clock.skew.ahead_s == pytest.approx(-5.0, abs=0.2)
    assert clock.skew.exceeds(4.7)
    assert not clock.skew.exceeds(4.95), "it may be off by half the round trip"
