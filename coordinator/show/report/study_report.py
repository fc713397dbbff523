"""``report.html`` and figures of ``dsse compare`` and ``dsse sweep``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median_low

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.lab.studies.strategy_comparison import HEADER, list_cells, list_reasons
from coordinator.lab.studies.study_row import COLUMNS, CONSENSUS, ORIGIN, StudyRow, to_cells
from coordinator.lab.studies.sweep_plan import SweepPlan, Task, sorted_tasks
from coordinator.show.figures.gap_figure import draw_gaps_of, find_course
from coordinator.show.figures.run_figures import save_figures
from coordinator.show.figures.style import styled
from coordinator.show.figures.sweep_figure import draw_sweep, name_keys
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
    folder: Path,
    plan: SweepPlan,
    rows: Mapping[Task, StudyRow],
    quantities: Sequence[str],
    formats: Sequence[str],
    arguments: Sequence[str],
) -> None:
    """Writes figure and report of the runs of a sweep done so far. ``arguments``: of the command ``dsse``.

    Raises:
        OSError: a file cannot be written.
    """
    agreed = sum(row.outcome == CONSENSUS for row in rows.values())
    missing = sum(task not in rows for task in plan.tasks)
    page = Page(
        title=f"{plan.base.name}: sweep of {' and '.join(map(name_keys, plan.keys))}",
        subtitle=f"{_describe(plan.base)}; on the simulator",
        outcome=f"{agreed} of {len(rows)} runs end in consensus",
        good=None,
        reasons=[f"{missing} runs of this sweep are not done yet"] if missing else [],
        findings=[],
        tables=[_sum_up(plan, rows, quantities)],
        drawings=[draw_sweep(plan.keys, rows, quantities)],
        more_tables=[_list_runs(plan, rows)],
        origin=find_origin(plan.base, arguments, PER_RUN),
    )
    _write(folder, page, formats)


def _describe(scenario: Scenario) -> str:
    buses, areas = len(scenario.network.buses), len(scenario.partition.areas)
    return f"{scenario.name}, {buses} buses in {areas} areas, seed {scenario.seed}"


def _write(folder: Path, page: Page, formats: Sequence[str]) -> None:
    write_page(page, folder)
    save_figures(page.drawings, folder, formats)


def _sum_up(plan: SweepPlan, rows: Mapping[Task, StudyRow], quantities: Sequence[str]) -> PageTable:
    """A row for each combination of values and strategy: runs that end in consensus, and medians of all its runs."""
    groups: dict[tuple[tuple[str, ...], str], list[StudyRow]] = {}
    for task in sorted_tasks(rows):
        groups.setdefault((task.values, task.strategy), []).append(rows[task])
    shown = [*quantities, *(["messages"] if "messages" not in quantities else [])]
    lines = []
    for (values, strategy), of_group in groups.items():
        agreed = sum(row.outcome == CONSENSUS for row in of_group)
        medians = [_median([getattr(row, name) for row in of_group]) for name in shown]
        lines.append((*values, strategy, f"{agreed} of {len(of_group)}", *medians))
    header = (*map(name_keys, plan.keys), "strategy", "consensus", *shown)
    note = "Runs without a figure count as infinite; a dash says that half of them have none."
    return PageTable("Medians of all seeds", header, lines, note)


def _median(values: Sequence[float | None]) -> str:
    middle = median_low([float("inf") if value is None else value for value in values])
    return "-" if middle == float("inf") else str(middle) if isinstance(middle, int) else format(middle, ".3g")


def _list_runs(plan: SweepPlan, rows: Mapping[Task, StudyRow]) -> PageTable:
    tasks = sorted_tasks(rows)
    cells = [[*task.values, *to_cells(rows[task])[: len(SHOWN)]] for task in tasks[:MAX_ROWS]]
    note, left_out = "The same as sweep.csv beside this file.", len(tasks) - len(cells)
    return PageTable(f"Runs ({len(tasks)})", [*map(name_keys, plan.keys), *SHOWN], cells, note, left_out)
