"""A long recording, a few scans of it: nothing is missing, and it plays back."""

from pathlib import Path

import pytest

from benchmarks import live_recording
from benchmarks.long_recording import find_failures, record_long
from benchmarks.recorder_kills import RecorderRun, count_holes, find_due

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("benchmarks")]


@pytest.mark.long
def test_a_recording_of_many_scans_lacks_nothing(tmp_path: Path) -> None:
    seen = record_long(tmp_path, 12)
    assert seen["scans played back"] == 12
    assert seen["scans of areas that are missing"] == 0
    assert seen["states that differ"] == 0


@pytest.mark.long
def test_what_a_recording_lacks_is_a_failure(tmp_path: Path) -> None:
    seen = record_long(tmp_path, 8)
    assert "the recording lacks something" not in find_failures(seen)
    assert "the recording lacks something" in find_failures({**seen, "scans of areas that are missing": 1})
    assert "a state is not that of the recording" in find_failures({**seen, "states that differ": 1})


def test_what_passed_before_an_area_knew_of_the_recorder_is_not_lost_by_it() -> None:
    keys = [("states", "area1", scan) for scan in range(5)]
    passed = [(float(k), one) for k, one in enumerate(keys)]
    due = find_due(passed, RecorderRun(1.0, 3.0), {keys[2]})
    assert due == [(2.0, keys[2]), (3.0, keys[3])]


def test_a_kill_may_cut_off_the_end_and_makes_no_hole() -> None:
    due = [(float(k), ("states", "area1", k)) for k in range(5)]
    recorded = {said for _, said in due}
    assert count_holes(due, recorded - {due[3][1], due[4][1]}) == 0
    assert count_holes(due, recorded - {due[1][1], due[2][1], due[4][1]}) == 2


def test_a_process_that_grows_and_a_message_that_is_not_recorded_are_failures() -> None:
    assert live_recording.find_growth([9.0] * 40) == 0.0
    assert live_recording.find_growth([0.1 * k for k in range(40)]) == pytest.approx(2.0)
    grown = {"growth in the second half, MiB": {"area1": 0.1, "plant": 2.0}}
    seen = {"messages received and not recorded": 0, "ended unasked": [], **grown}
    assert live_recording.find_failures(seen) == ["grew by more than 1 MiB: plant"]
    lacking = {**seen, "messages received and not recorded": 1, "growth in the second half, MiB": {}}
    assert live_recording.find_failures(lacking) == ["the recording lacks what was received"]
