"""What a soak may not end with, each found by itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.soak import AREAS, CUT_FOR_S, build_scenario, find_failures, find_trouble

WELL = {
    "s from the last fault to it": 1.0,
    "s until all areas are good": 1.5,
    "processes alive of": [AREAS + 2, AREAS + 2],
    "ended unasked": [],
    "trouble in logs": [],
    "growth of the longest incarnations in their second half, MiB": {"area1": 0.1, "area2": -0.2},
}


def test_a_soak_that_ended_well_has_no_failure():
    assert find_failures(WELL) == []


@pytest.mark.parametrize(
    ("key", "value", "failure"),
    [
        ("s from the last fault to it", None, "the gap at the end exceeds 1e-08"),
        ("s until all areas are good", None, "an area is not good at the end"),
        ("processes alive of", [AREAS + 1, AREAS + 2], "a process is lost"),
        ("ended unasked", ["Ended(area1)"], "a process is lost"),
        ("trouble in logs", ["area1.log: Traceback"], "a log tells of an exception"),
        (
            "growth of the longest incarnations in their second half, MiB",
            {"area1": 9.0},
            "a process grew by more than 3 MiB",
        ),
    ],
)
def test_each_failure_is_found(key: str, value: object, failure: str):
    assert find_failures(WELL | {key: value}) == [failure]


def test_an_exception_in_a_log_is_found(tmp_path: Path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "area1.log").write_text("INFO all is well\nTraceback (most recent call last):\n")
    assert list(find_trouble(tmp_path)) == ["area1.log: Traceback (most recent call last):"]


def test_the_faults_of_a_soak_depend_on_its_seed_and_end_in_time():
    one, same, other = (build_scenario(seed, 30.0).faults for seed in (1, 1, 2))
    assert one == same != other
    assert len({name for link in one.links for name in link}) == AREAS
    assert all(event.over_s <= 30.0 for event in one.events)
    assert all(faults.until_s == 30.0 and faults.loss <= 0.5 for faults in one.links.values())
    assert max(event.for_s for event in one.events) <= max(CUT_FOR_S)
