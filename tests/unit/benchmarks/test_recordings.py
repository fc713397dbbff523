"""A long recording, a few scans of it: nothing is missing, and it plays back."""

from pathlib import Path

import pytest

from benchmarks.long_recording import find_failures, record_long
from benchmarks.recorder_kills import RecorderRun, find_due

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("benchmarks")]


def test_a_recording_of_many_scans_lacks_nothing(tmp_path: Path) -> None:
    seen = record_long(tmp_path, 12)
    assert seen["scans played back"] == 12
    assert seen["scans of areas that are missing"] == 0
    assert seen["states that differ"] == 0


def test_what_a_recording_lacks_is_a_failure(tmp_path: Path) -> None:
    seen = record_long(tmp_path, 8)
    assert "the recording lacks something" not in find_failures(seen)
    assert "the recording lacks something" in find_failures({**seen, "scans of areas that are missing": 1})
    assert "a state is not that of the recording" in find_failures({**seen, "states that differ": 1})


def test_what_passed_before_an_area_knew_of_the_recorder_is_not_lost_by_it() -> None:
    said = [("states", "area1", scan) for scan in range(5)]
    passed = [(float(k), one) for k, one in enumerate(said)]
    due = find_due(passed, RecorderRun(1.0, 3.0), {said[2]})
    assert due == [(2.0, said[2]), (3.0, said[3])]
