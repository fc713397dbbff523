"""Whatever goes wrong for a while: afterwards the fixed point, and hardly ever a good state that was not."""

from __future__ import annotations

import csv
import math
from dataclasses import astuple
from pathlib import Path

import pytest
from click.testing import CliRunner

from benchmarks.fault_histories import command as fault_histories
from benchmarks.fault_histories.history import GAP, HistoryOutcome, run_history
from tests.support.back_ends import back_end
from tests.support.levels import further, many_more


@pytest.mark.random_cases(few=3, long=6, many=1000)
def test_after_any_history_of_faults_the_areas_are_good_and_at_the_centralised_estimate(random_seed: int):
    outcome = run_history(random_seed)
    assert outcome.gap <= GAP
    assert not math.isnan(outcome.settled_s)
    assert outcome.good >= outcome.areas
    assert outcome.wrong <= 0.003 * outcome.good


@pytest.mark.parametrize("feeder", ["ieee13", *many_more("ieee123")])
@pytest.mark.random_cases(few=1, long=4, many=100)
def test_so_they_are_where_buses_have_phases(random_seed: int, feeder: str):
    outcome = run_history(random_seed, feeder)
    assert outcome.gap <= GAP
    assert not math.isnan(outcome.settled_s)
    assert outcome.good >= outcome.areas
    assert outcome.wrong == 0


@pytest.mark.parametrize("phases", ["", *further("ieee13")])
@pytest.mark.parametrize("seed", [*further(3, 10, 156), *many_more(*range(100, 600))])
def test_so_they_are_where_switches_are_operated(seed: int, phases: str):
    outcome = run_history(seed, phases, switching=True)
    assert outcome.gap <= GAP
    assert not math.isnan(outcome.settled_s)
    assert outcome.wrong <= 0.003 * outcome.good


@pytest.mark.long
def test_a_section_without_supply_costs_no_digits_where_areas_solve_sparse_systems():
    with back_end("sparse"):
        assert run_history(25, switching=True).gap <= GAP


def test_a_history_repeats_to_the_bit():
    with back_end("sparse"):
        assert run_history(3) == run_history(3)


def an_outcome(seed: int, gap: float = 1e-12, wrong: int = 0) -> HistoryOutcome:
    return HistoryOutcome(seed, 3, 12, 60, 10, wrong, 0.5, gap, 0.2)


def test_the_command_goes_on_where_its_table_ends_and_sums_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    table = tmp_path / "histories.csv"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([fault_histories.COLUMNS, astuple(an_outcome(0, wrong=1)), (1, 3, 12)])
    ran = []
    monkeypatch.setattr(fault_histories, "run_history", lambda seed, **_: ran.append(seed) or an_outcome(seed))
    done = CliRunner().invoke(fault_histories.main, ["--count", "4", "--jobs", "1", "--out", str(table)])
    assert done.exit_code == 0, done.output
    assert ran == [1, 2, 3]
    assert "histories: 4 of" in done.output
    assert "(gap <= 1e-08): 4, largest gap 1e-12" in done.output
    assert "marked good 40, of these beyond three sigma 1 = 2.5 %" in done.output


def test_a_history_that_does_not_end_at_the_fixed_point_is_named():
    summary = fault_histories.summarise([an_outcome(0), an_outcome(7, gap=1e-3)])
    assert summary["NOT at the fixed point"] == "seeds 7"
