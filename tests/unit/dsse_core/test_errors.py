"""However much is wrong with an input, the text that says so can be read."""

from __future__ import annotations

from dsse_core.errors import LONGEST_LINE, MOST_SHOWN, InvalidInputError, NotObservableError


def test_a_hundred_thousand_problems_do_not_fill_the_terminal():
    error = InvalidInputError("scenario.toml", [f"key{i}: unknown key" for i in range(100_000)])
    lines = str(error).splitlines()
    assert lines[0] == "scenario.toml: 100000 problems"
    assert lines[1:-1] == [f"  - key{i}: unknown key" for i in range(MOST_SHOWN)]
    assert lines[-1] == "  ... and 99,950 more"
    assert len(error.problems) == 100_000


def test_as_many_as_are_shown_are_not_counted():
    assert str(InvalidInputError("x", ["y"] * MOST_SHOWN)).splitlines()[1:] == ["  - y"] * MOST_SHOWN


def test_one_endless_problem_is_cut_inside_so_that_place_and_cure_stay():
    error = InvalidInputError("p" * 10_000, [f"bus {'7' * 100_000}: is far too large; make it smaller"])
    what, problem = str(error).splitlines()
    assert len(what) == len(problem) == LONGEST_LINE
    assert what.endswith(": 1 problem")
    assert problem.startswith("  - bus 777")
    assert problem.endswith("777: is far too large; make it smaller")


def test_a_feeder_without_meters_does_not_name_a_million_buses():
    text = str(NotObservableError(range(1_000_000), [f"vm@{i}" for i in range(1000)]))
    assert len(text) < LONGEST_LINE
    assert "98, 99 and 999900 more; any one of these added meters would cure it: vm@0; vm@1" in text
