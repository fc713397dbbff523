"""``report.html`` and figures of ``dsse compare`` and ``dsse sweep``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median_low

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.lab.studies.strategy_comparison import HEADER, list_cells, list_reasons
from coordinator.lab.studies.study_row import COLUMNS, CONSENSUS, ORIGIN, StudyRow, to_cells
from coordinator.lab.studies.sweep_plan import SweepPlan, Task
from coordinator.show.figures.gap_figure import draw_gaps_of, find_course
from coordinator.show.figures.run_figures import save_figures
from coordinator.show.figures.style import styled
from coordinator.show.figures.sweep_figure import draw_sweep, place_of_value
from coordinator.show.report.page import MAX_ROWS, Page, PageTable, write_page
from coordinator.show.report.settings import find_origin
from scenarios.scenario import Scenario

SHOWN = tuple(name for name in COLUMNS if name not in ORIGIN)  # the columns of ORIGIN are the last ones
PER_RUN = ("strategy", "seed")  # settings that the runs of a study differ in


def report_comparison(
    folder: Path,
    scenario: Scenario,
    rows: Sequence[StudyRow],
    outcomes: Mapping[str, RunOutcome],
    formats: Sequence[str],
    arguments: Sequence[str],
) -> None:
    """Writes figure and report of a comparison of strategies. ``arguments``: of the command ``dsse``.

    Raises:
        OSError: a file cannot be written.
    """
    with styled():
        drawing = draw_gaps_of({name: find_course(outcome) for name, outcome in outcomes.items()})
    agreed = sum(row.outcome == CONSENSUS for row in rows)
    page = Page(
        title=f"{scenario.name}: strategies side by side",
        subtitle=_describe(scenario),
        outcome=f"{agreed} of {len(rows)} strategies end in consensus",
        good=None,
        reasons=[],
        findings=list_reasons(rows),
        tables=[PageTable("Strategies", HEADER, [list_cells(row) for row in rows])],
        drawings=[drawing],
        more_tables=[],
        origin=find_origin(scenario, arguments, ("strategy",)),
    )
    _write(folder, page, formats)


def report_sweep(
    folder: Path, plan: SweepPlan, rows: Mapping[Task, StudyRow], formats: Sequence[str], arguments: Sequence[str]
) -> None:
    """Writes figure and report of the runs of a sweep done so far. ``arguments``: of the command ``dsse``.

    Raises:
        OSError: a file cannot be written.
    """
    agreed = sum(row.outcome == CONSENSUS for row in rows.values())
    missing = sum(task not in rows for task in plan.tasks)
    page = Page(
        title=f"{plan.base.name}: sweep of {plan.key}",
        subtitle=f"{_describe(plan.base)}; on the simulator",
        outcome=f"{agreed} of {len(rows)} runs end in consensus",
        good=None,
        reasons=[f"{missing} runs of this sweep are not done yet"] if missing else [],
        findings=[],
        tables=[_sum_up(plan.key, rows)],
        drawings=[draw_sweep(plan.key, rows)],
        more_tables=[_list_runs(plan.key, rows)],
        origin=find_origin(plan.base, arguments, PER_RUN),
    )
    _write(folder, page, formats)


def _describe(scenario: Scenario) -> str:
    buses, areas = len(scenario.network.buses), len(scenario.partition.areas)
    return f"{scenario.name}, {buses} buses in {areas} areas, seed {scenario.seed}"


def _write(folder: Path, page: Page, formats: Sequence[str]) -> None:
    write_page(page, folder)
    save_figures(page.drawings, folder, formats)


def _sum_up(key: str, rows: Mapping[Task, StudyRow]) -> PageTable:
    """A row for each value and strategy: the number of runs that end in consensus, and medians over all its runs."""
    groups: dict[tuple[str, str], list[StudyRow]] = {}
    for task in sorted(rows, key=lambda task: (place_of_value(task.value), task.strategy)):
        groups.setdefault((task.value, task.strategy), []).append(rows[task])
    lines = []
    for (value, strategy), of_group in groups.items():
        agreed = sum(row.outcome == CONSENSUS for row in of_group)
        gap = _median([row.gap for row in of_group], ".1e")
        time = _median([row.below_1e6_s for row in of_group], ".3g")
        messages = _median([row.messages for row in of_group], "d")
        lines.append((value, strategy, f"{agreed} of {len(of_group)}", gap, time, messages))
    header = (key, "strategy", "consensus", "median gap (p.u. or rad)", "median time to 1e-6 (s)", "median of messages")
    note = "Runs without a figure count as infinite; a dash says that half of them have none."
    return PageTable("Medians of all seeds", header, lines, note)


def _median(values: Sequence[float | None], form: str) -> str:
    known = [float("inf") if value is None else value for value in values]
    middle = median_low(known)
    return "-" if middle == float("inf") else format(int(middle) if form == "d" else middle, form)


def _list_runs(key: str, rows: Mapping[Task, StudyRow]) -> PageTable:
    tasks = sorted(rows, key=lambda task: (place_of_value(task.value), task.strategy, task.seed))
    cells = [[task.value, *to_cells(rows[task])[: len(SHOWN)]] for task in tasks[:MAX_ROWS]]
    note, left_out = "The same as sweep.csv beside this file.", len(tasks) - len(cells)
    return PageTable(f"Runs ({len(tasks)})", [key, *SHOWN], cells, note, left_out)
