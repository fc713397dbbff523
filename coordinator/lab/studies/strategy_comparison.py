"""``dsse compare``: the strategies side by side, on the same telemetry and the same faults."""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from agents.strategies.installed import list_strategies
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.lab.process_run.stop_run import has_processes
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.lab.studies.study_row import (
    COLUMNS,
    StudyRow,
    check_one_is_possible,
    make_impossible_row,
    make_row,
    to_cells,
)
from coordinator.lab.studies.sweep_plan import hash_scenario
from coordinator.watch.run_folder import make_run_folder
from coordinator.watch.tables import format_table
from dsse_core.errors import InvalidInputError
from dsse_core.files.drafts import draft_folder, remove_leftovers, whole_file
from dsse_core.files.wording import describe_unknown
from dsse_core.printable import printable
from scenarios.scenario import Scenario

UNKEPT = "dsse-compare-"  # of the names of temporary folders, for runs that are not kept
HEADER = (
    *(
        "strategy",
        "outcome",
        "gap p.u.",
        "gap deg",
        "error p.u.",
        "error deg",
        "exchanges",
        "messages",
        "bytes",
        "lost",
    ),
    *("s to 1e-3", "s to 1e-6", "s to 1e-8"),
)


def choose_strategies(names: str | None) -> tuple[str, ...]:
    """The strategies in ``names``, separated by commas; all installed ones if it is None.

    Raises:
        InvalidInputError: a strategy is unknown or given twice.
    """
    known = list_strategies()
    if names is None:
        return known
    listed = [name.strip() for name in names.split(",")]
    unknown = [name for name in listed if name not in known]
    twice = [name for name in dict.fromkeys(listed) if listed.count(name) > 1]
    problems = [describe_unknown("strategy", name, known) for name in unknown]
    problems += [f"{name!r} is given twice; keep one" for name in twice]
    if problems:
        raise InvalidInputError("strategies", problems)
    return tuple(listed)


def compare_strategies(
    scenario: Scenario,
    strategies: Sequence[str],
    run: Callable[[Scenario, Path], RunOutcome],
    out: Path | None = None,
) -> tuple[StudyRow, ...]:
    """A row per strategy, each from one ``run(scenario, folder)``.

    ``out``: new or empty folder for the run folders and the table; without it no file is kept.

    Raises:
        InvalidInputError: ``out`` cannot be used, or no strategy can be run, with the reasons.
    """
    temporary = Path(tempfile.gettempdir())
    remove_leftovers(temporary, UNKEPT, has_processes)
    with draft_folder(temporary, UNKEPT) as unkept:
        folder = unkept if out is None else make_run_folder(out, scenario.name)
        content = hash_scenario(scenario)
        found = (_run_one(replace(scenario, strategy=name), run, folder / name) for name in strategies)
        rows = tuple(replace(row, scenario_sha256=content) for row in found)
        check_one_is_possible(scenario, rows)
        if out is not None:
            _write(folder, scenario, rows)
    return rows


def format_comparison(rows: Sequence[StudyRow]) -> str:
    """The table of a comparison for the terminal, and the reasons of strategies that did not end in consensus."""
    return "\n".join([format_table(HEADER, [list_cells(row) for row in rows]), *_separate(rows)])


def format_markdown(rows: Sequence[StudyRow]) -> str:
    """The table of a comparison in Markdown, and the reasons of strategies that did not end in consensus."""
    lines = [HEADER, ("---", "---", *["---:"] * (len(HEADER) - 2)), *map(list_cells, rows)]
    return "\n".join(["| " + " | ".join(cells) + " |" for cells in lines] + _separate(rows))


def _run_one(scenario: Scenario, run: Callable[[Scenario, Path], RunOutcome], folder: Path) -> StudyRow:
    try:
        check_with_strategy(scenario)
    except InvalidInputError as error:
        return make_impossible_row(scenario, error)
    return make_row(run(scenario, folder))


def _write(folder: Path, scenario: Scenario, rows: Sequence[StudyRow]) -> None:
    title = f"# {scenario.name}: {scenario.description}\n\nSeed {scenario.seed}.\n\n"
    with whole_file(folder / "comparison.md") as draft:
        draft.write_text(title + format_markdown(rows) + "\n", encoding="utf-8")
    with whole_file(folder / "comparison.csv") as draft, draft.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        table.writerows(map(to_cells, rows))


def list_cells(row: StudyRow) -> tuple[str, ...]:
    """The cells of ``row`` in the columns of ``HEADER``."""
    differences = (row.gap_vm_pu, row.gap_va_deg, row.error_vm_pu, row.error_va_deg)
    counts = (row.exchanges, row.messages, row.bytes, row.lost)
    times = (row.below_1e3_s, row.below_1e6_s, row.below_1e8_s)
    return (
        *(row.strategy, row.outcome),
        *("-" if each is None else f"{each:.1e}" for each in differences),
        *("-" if count is None else str(count) for count in counts),
        *("-" if time is None else f"{time:.3f}" for time in times),
    )


def list_reasons(rows: Sequence[StudyRow]) -> list[str]:
    """Lines with the reasons of strategies that did not end in consensus."""
    return [f"{row.strategy}: {row.outcome}: {printable(row.reason)}" for row in rows if row.reason]


def _separate(rows: Sequence[StudyRow]) -> list[str]:
    return [line for reason in list_reasons(rows) for line in ("", reason)]
