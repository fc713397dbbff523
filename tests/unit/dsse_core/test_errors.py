"""However much is wrong with an input, the text that says so can be read."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from dsse_core import errors
from dsse_core.errors import (
    LONGEST_LINE,
    MOST_SHOWN,
    DsseError,
    EstimationDivergedError,
    InvalidInputError,
    NotObservableError,
    PowerFlowDivergedError,
)
from dsse_core.files.kinds import AREA_FILE, SCENARIO_FILE
from dsse_core.files.strict_table import OtherKindError

ERRORS = [
    DsseError("no area answers"),
    InvalidInputError("scenario.toml", ["buses[1].vm: found 0; give a voltage", "key: unknown key"]),
    PowerFlowDivergedError("ieee33", 18, 0.25, 30),
    NotObservableError([3, 4], ["vm@3"], ["p@4 = 0"]),
    EstimationDivergedError(50, 0.5, "check vm@3", "vm@3", "out of reach"),
    OtherKindError(Path("grid.toml"), AREA_FILE, SCENARIO_FILE),
]


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


def test_all_classes_of_errors_are_pickled_below():
    classes = {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, Exception)}
    assert classes <= {type(error) for error in ERRORS}


def test_an_error_reaches_the_parent_of_its_worker_process():
    error = InvalidInputError("scenario.toml", ["key: unknown key"])
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, pytest.raises(InvalidInputError, match="unknown key"):
        pool.submit(_raise, error.what, error.problems).result()


def _raise(what, problems):
    raise InvalidInputError(what, problems)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_a_worker_process_arrives_whole(error, protocol):
    for restored in (pickle.loads(pickle.dumps(error, protocol)), copy.copy(error)):
        assert type(restored) is type(error)
        assert str(restored) == str(error)
        assert restored.args == error.args
        assert vars(restored) == vars(error)
