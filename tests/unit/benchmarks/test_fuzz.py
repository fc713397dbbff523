"""The fuzzer's inputs are repeatable, and no decoder falls for those of the first few numbers."""

import pytest

from benchmarks.fuzz import FINDING, make_input, try_input
from benchmarks.fuzz_targets import TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_the_same_number_makes_the_same_input(name):
    samples = [make_input(name, 1, number) for number in range(5)]
    assert samples == [make_input(name, 1, number) for number in range(5)]
    assert len(set(samples)) > 1
    assert make_input(name, 2, 0) != samples[0]


@pytest.mark.random_cases(few=3, many=100)
@pytest.mark.parametrize("name", TARGETS)
def test_spoilt_input_is_accepted_or_refused(name, random_seed, tmp_path):
    for number in range(10 if name == "messages" else 1):
        outcome = try_input(name, make_input(name, random_seed, number), tmp_path)
        assert not outcome.startswith(FINDING), outcome


def test_anything_else_is_a_finding(monkeypatch, tmp_path):
    monkeypatch.setattr("benchmarks.fuzz_targets.messages.decode", lambda *_: 1 / 0)
    assert try_input("messages", b"", tmp_path).startswith("FINDING: ZeroDivisionError in test_fuzz.py")
