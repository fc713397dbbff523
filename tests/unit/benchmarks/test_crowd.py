"""A crowd of strangers: what its benchmark calls a failure, and that what strangers say can be sent and read."""

from __future__ import annotations

import pytest

from agents.messages.packing import decode, encode
from benchmarks.crowd.command import MOST_MEMORY_MIB, find_failures
from benchmarks.crowd.stranger import NAMES, readings_of, state_of, tokens_of

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("k", range(len(NAMES)))
def test_what_strangers_say_is_a_message_of_this_version(k: int) -> None:
    for message in (state_of("run", k, 3), readings_of("run", k)):
        assert decode(encode(message)) == message
    assert len(set(tokens_of("run", 100 * k))) == 3


def test_a_disturbed_estimate_and_an_onlooker_that_grows_are_failures() -> None:
    fine = {
        "largest gap of good areas to the centralised estimate": {"before": 1e-13, "there": 1e-12},
        "share of looks at which an area was good": {"before": 1.0, "there": 0.99},
        "most memory, MiB": {"serve": 100.0, "area1": 2 * MOST_MEMORY_MIB},
        "ended unasked": [],
    }
    assert find_failures(fine) == []
    wrong = {"largest gap of good areas to the centralised estimate": {"there": 1e-4}}
    assert find_failures(fine | wrong) == ["a good estimate is off by more than 1e-08"]
    silent = {"share of looks at which an area was good": {"before": 1.0, "there": 0.1}}
    assert find_failures(fine | silent) == ["areas were good at less than 95% of the looks"]
    assert find_failures(fine | {"most memory, MiB": {"serve": 2 * MOST_MEMORY_MIB}}) == ["more than 400 MiB: serve"]
    assert find_failures(fine | {"ended unasked": ["serve"]}) == ["a process ended unasked"]
