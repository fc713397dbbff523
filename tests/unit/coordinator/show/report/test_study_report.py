"""Reports of comparisons and sweeps: their tables, figures, and how to repeat them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.studies.study_row import CONSENSUS, NOT_POSSIBLE, StudyRow
from coordinator.lab.studies.sweep_plan import Task
from coordinator.show.figures.sweep_figure import draw_sweep
from tests.support.read_page import read_page


@pytest.mark.slow
def test_a_comparison_leaves_a_report_with_its_table_and_a_line_for_each_strategy(dsse, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["compare", "industrial13", "--strategies", "information,admm", "--set", "faults.loss=0.1"]
    assert dsse(*arguments, "--out", out, "--format", "png,svg")[0] == 0
    assert {path.name for path in out.iterdir() if path.is_file()} == {
        *("comparison.csv", "comparison.md", "report.html", "gap.png", "gap.svg")
    }
    page = read_page((out / "report.html").read_text(encoding="utf-8"))
    assert "2 of 2 strategies end in consensus" in page.text
    assert "faults.loss 0.1" in page.text
    assert "information consensus" in page.text
    assert f"dsse {' '.join(arguments)} --out NEW_FOLDER --format png,svg" in page.text
    assert page.count("svg") == 1
    assert "strategy information" not in page.text  # it is no setting of the comparison


@pytest.mark.slow
def test_a_sweep_leaves_a_report_with_medians_and_all_runs(dsse, tmp_path: Path) -> None:
    arguments = ["sweep", "industrial13", "--vary", "faults.loss=0,0.3", "--seeds", "3", "--strategies", "information"]
    assert dsse(*arguments, "--jobs", "1", "--out", tmp_path / "s", "--quiet", "--format", "pdf")[0] == 0
    assert {path.name for path in (tmp_path / "s").iterdir()} == {"report.html", "sweep.csv", "sweep.json", "sweep.pdf"}
    page = read_page((tmp_path / "s" / "report.html").read_text(encoding="utf-8"))
    assert "6 of 6 runs end in consensus" in page.text
    assert "0.3 information 3 of 3" in page.text
    assert "Runs (6)" in page.text
    assert [to for to in page.references if not to.startswith(("#", "data:"))] == []


def test_without_plots_a_study_leaves_its_tables_only(dsse, tmp_path: Path) -> None:
    small = ["industrial13", "--strategies", "information", "--no-plots"]
    assert dsse("compare", *small, "--out", tmp_path / "c")[0] == 0
    assert {path.name for path in (tmp_path / "c").iterdir() if path.is_file()} == {"comparison.csv", "comparison.md"}
    vary = ["--vary", "faults.loss=0,0.1", "--seeds", "1", "--jobs", "1", "--quiet"]
    code, out, _ = dsse("sweep", *small, *vary, "--out", tmp_path / "s")
    assert code == 0
    assert "report" not in out
    assert {path.name for path in (tmp_path / "s").iterdir()} == {"sweep.csv", "sweep.json"}


def test_formats_without_a_folder_are_one_error(dsse) -> None:
    code, _, err = dsse("compare", "industrial13", "--format", "pdf")
    assert code == 2
    assert "--out DIR" in err


def test_the_figure_of_a_sweep_has_medians_over_the_numbers_of_the_key() -> None:
    times = {0.0: (1.0, 2.0, 4.0), 0.5: (8.0, 16.0, None)}
    rows = {
        Task((str(value),), "information", seed): StudyRow(
            "information", seed, CONSENSUS if time else NOT_POSSIBLE, 1e-9, 1e-9, below_1e6_s=time
        )
        for value, of_value in times.items()
        for seed, time in enumerate(of_value)
    }
    drawing = draw_sweep([["faults.loss"]], rows)
    below = drawing.figure.axes[1]
    (line,) = below.lines
    assert np.asarray(line.get_xdata()).tolist() == [0.0, 0.5]
    assert np.asarray(line.get_ydata()).tolist() == [2.0, 16.0]
    assert line.get_label() == "information (never in 1 of 6 runs)"
    assert below.get_yscale() == "linear"  # 16 is not far from 2
    assert below.get_xlabel() == "faults.loss"
