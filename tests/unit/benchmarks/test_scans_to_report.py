"""A day of scans from CSV to report and page, a few scans of it."""

from pathlib import Path

import pytest

from benchmarks.scans_to_report import count_differences, estimate_day, find_failures, measure, write_day

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("benchmarks")]


@pytest.mark.long
def test_tables_of_many_scans_are_those_of_single_ones_and_are_played(tmp_path: Path) -> None:
    seen = measure(tmp_path, 3)
    assert seen["moments on the page"] == seen["scans"] == 3
    assert seen["cells that differ from single scans"] == 0
    assert "the page does not play every scan" in find_failures({**seen, "moments on the page": 2})


@pytest.mark.long
def test_another_number_is_a_difference(tmp_path: Path) -> None:
    write_day(tmp_path / "day.csv", 2)
    estimate_day(tmp_path / "day.csv", tmp_path / "out")
    path = tmp_path / "out" / "branches.csv"
    head, first, *others = path.read_text().splitlines()
    path.write_text("\n".join([head, first.replace("1-2", "1-3", 1), *others]))
    assert count_differences(tmp_path / "day.csv", tmp_path / "out", 2) == 1
