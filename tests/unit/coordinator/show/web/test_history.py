"""The past has a bounded size, whatever comes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from coordinator.show.web.history import Series


def test_a_day_of_scans_takes_no_more_memory_than_allowed():
    series, n = Series(("a", "b"), most_bytes=300_000), 1000
    for k in range(500):
        series.take(float(k), range(n), {"a": np.full(n, k), "b": np.zeros(n)})
        assert series.bytes <= 300_000
    past = series.read(7)
    assert past["columns"]["a"] == past["time"]
    assert past["time"][-1] == 499.0


def test_ids_that_come_and_go_keep_their_past_and_an_unknown_one_has_none():
    series = Series(("a",), 1000)
    series.take(1.0, ("x", "y"), {"a": np.array([1.0, 2.0])})
    assert series.read("z") == {"time": [], "columns": {"a": []}}
    series.take(2.0, ("y",), {"a": np.array([5.0])})
    assert series.read("y") == {"time": [1.0, 2.0], "columns": {"a": [2.0, 5.0]}}
    assert series.read("x") == {"time": [1.0], "columns": {"a": [1.0]}}


@given(st.lists(st.integers(0, 20), max_size=30))
def test_whatever_sizes_come_the_newest_moment_is_kept(sizes: list[int]):
    series = Series(("a",), 100)
    for k, n in enumerate(sizes):
        series.take(float(k), range(n), {"a": np.arange(n)})
    if sizes and sizes[-1]:
        assert series.read(sizes[-1] - 1)["time"][-1] == float(len(sizes) - 1)
