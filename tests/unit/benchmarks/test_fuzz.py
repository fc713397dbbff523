"""The fuzzer's inputs are repeatable, and no decoder falls for those of the first few numbers."""

import json
import tomllib

import pytest

from benchmarks.fuzz.command import FINDING, make_input, try_input
from benchmarks.fuzz.targets import TARGETS

pytestmark = pytest.mark.slow

# pandapower takes 3 s to read what it has written itself
DRAWN = [pytest.param(name, marks=pytest.mark.long) if "pandapower" in name else name for name in TARGETS]


@pytest.mark.parametrize("name", DRAWN)
def test_the_same_number_makes_the_same_input(name):
    samples = [make_input(name, 1, number) for number in range(5)]
    assert samples == [make_input(name, 1, number) for number in range(5)]
    assert len(set(samples)) > 1
    assert make_input(name, 2, 0) != samples[0]


@pytest.mark.random_cases(few=1, long=3, many=100)
@pytest.mark.parametrize("name", DRAWN)
def test_spoilt_input_is_accepted_or_rejected(name, random_seed, tmp_path):
    for number in range(10 if name == "messages" else 1):
        outcome = try_input(name, make_input(name, random_seed, number), tmp_path)
        assert not outcome.startswith(FINDING), outcome


def test_a_module_that_a_file_has_imported_is_a_finding(monkeypatch, tmp_path):
    monkeypatch.setattr("scenarios.importers.pandapower.reader.write_anew", lambda _, tree: json.dumps(tree))
    outcomes = (
        try_input("foreign-pandapower.json", make_input("foreign-pandapower.json", 1, number), tmp_path)
        for number in range(9, 12)
    )
    assert any(outcome.startswith("FINDING: TwoReadingsError") and "was imported" in outcome for outcome in outcomes)


def test_a_key_given_twice_and_a_deep_one_that_are_read_are_findings(monkeypatch, tmp_path):
    monkeypatch.setattr("dsse_core.files.strict_table.parse_json", json.loads)
    monkeypatch.setattr("benchmarks.fuzz.parsing.parse_toml", tomllib.loads)
    lenient, deep = ("lenient-network.json", "a key is given twice"), ("keys.toml", "parts was accepted")
    for (name, what), first in ((lenient, 0), (deep, 19)):  # some before it take tomllib many seconds
        outcomes = (try_input(name, make_input(name, 1, number), tmp_path) for number in range(first, 200))
        assert any(outcome.startswith("FINDING: TwoReadingsError") and what in outcome for outcome in outcomes)


def test_anything_else_is_a_finding(monkeypatch, tmp_path):
    monkeypatch.setattr("benchmarks.fuzz.targets.messages.decode", lambda *_: 1 / 0)
    assert try_input("messages", b"", tmp_path).startswith("FINDING: ZeroDivisionError in test_fuzz.py")
