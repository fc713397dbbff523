"""Estimates of feeders of three coupled phases beside power-grid-model: no larger J, with injections alone its own."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.phases import compare_phases, find_missed, format_phases

pytest.importorskip("power_grid_model")


def test_ours_is_the_minimum_that_the_peer_finds_and_a_larger_one_is_named() -> None:
    rows = compare_phases([10], lambda _: None)
    assert [row.set_name for row in rows] == ["injections", "flows"]
    assert find_missed(rows) == []
    assert rows[1].ours < rows[1].theirs
    assert format_phases(rows).count("\n") == 3
    assert find_missed([replace(rows[0], ours=1.1 * rows[0].theirs)]) != []
