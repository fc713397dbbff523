"""The benchmark of areas in pieces times a step of each size beside the tableau, and finds it in one dense piece."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

import consensus_dsse as dsse
from benchmarks import pieces


def test_a_step_in_pieces_takes_time_beside_the_tableau_and_is_that_in_one_dense_piece() -> None:
    cut = dsse.load_scenario("ieee13", changes={"areas": {"count": 3}})
    found = dict(pieces.compare_steps(cut, (3, 10), 1))
    assert list(found) == [3, 10]
    for of_size in found.values():
        assert of_size["ratio"] > 0
        assert of_size["ms"] > 0
        assert of_size["apart"] < 1e-10


def test_a_line_for_each_division_and_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "SIZES", (10,))
    done = CliRunner().invoke(pieces.main, ["--scenario", "ieee13", "--runs", "1"])
    assert done.exit_code == 0, done.output
    lines = [line.split(" | ")[0] for line in done.output.splitlines()[-2:]]
    assert lines == ["| one area, pieces of 10 nodes", "| 3 areas, pieces of 10 nodes"]
