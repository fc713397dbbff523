"""The commands that run scenarios on the simulator: ``dsse simulate``, ``compare``, ``sweep``, ``thesis``."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from coordinator.cli.command import STUDY, TRY, command
from coordinator.cli.figure_options import asked_for_formats, figure_options, given_arguments
from coordinator.cli.outputs import check_parquet_option, parquet_option
from coordinator.cli.terminal import (
    Number,
    answer,
    changed,
    finish_run,
    invite_to,
    json_option,
    notify,
    progress,
    quiet_option,
    run_folder_option,
    scenario_argument,
    seed_option,
    set_option,
    show,
    strategy_option,
    timeout_option,
)
from coordinator.watch.interrupts import end_orderly_on_signals
from dsse_core import operating_system
from dsse_core.printable import printable

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from concurrent.futures import Executor

    from coordinator.lab.evaluation.result import RunOutcome
    from coordinator.lab.studies.sweep_plan import SweepPlan
    from coordinator.lab.studies.sweep_table import SweepTable
    from scenarios.faults.faults import LinkChanges
    from scenarios.scenario import Scenario

from contextlib import nullcontext

THESIS_FILE = "thesis.csv"
MILLISECONDS = Number(min=0, max=86_400_000)
strategies_option = click.option("--strategies", metavar="A,B,...", help="Only these strategies.  [default: all]")


executor_option = click.option(
    "--executor", metavar="dask://HOST:PORT", help="Run on the workers of this scheduler instead of this machine."
)


def link_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Faults of all links as options; the command gets those that are given as ``links``."""

    @click.option("--loss", type=Number(0, 1), metavar="P", help="Instead of the scenario's faults.loss.")
    @click.option("--delay-ms", type=MILLISECONDS, metavar="MS", help="Instead of the scenario's faults.delay_ms.")
    @click.option("--jitter-ms", type=MILLISECONDS, metavar="MS", help="Instead of the scenario's faults.jitter_ms.")
    @click.option("--duplicate", type=Number(0, 1), metavar="P", help="Instead of the scenario's faults.duplicate.")
    @functools.wraps(command)
    def with_links(
        *arguments: Any,
        loss: float | None,
        delay_ms: float | None,
        jitter_ms: float | None,
        duplicate: float | None,
        **options: Any,
    ) -> Any:
        given = {
            "loss": loss,
            "delay_s": None if delay_ms is None else delay_ms / 1000,
            "jitter_s": None if jitter_ms is None else jitter_ms / 1000,
            "duplicate": duplicate,
        }
        links = {key: value for key, value in given.items() if value is not None}
        return command(*arguments, links=links, **options)

    return with_links


@command(
    TRY,
    codes={0: "the areas agree", 1: "they do not"},
    short_help="Run a scenario on the simulator, in virtual time, repeatable to the bit.",
)
@scenario_argument
@run_folder_option
@timeout_option
@seed_option
@strategy_option
@set_option
@link_options
@quiet_option
@parquet_option
@json_option
@figure_options
def simulate(
    scenario: str,
    out: Path | None,
    timeout: float | None,
    seed: int | None,
    strategy: str | None,
    changes: Mapping[str, object],
    links: LinkChanges,
    quiet: bool,
    formats: tuple[str, ...] | None,
    parquet: bool,
    as_json: bool,
) -> int:
    """Run SCENARIO, a shipped name or a file, on the simulator: the same areas on a simulated bus, in this process.

    Virtual time passes while messages travel and areas wait for their heartbeat; computing takes none. Verdict and
    files are those of `dsse run`.

    \b
    Examples:  dsse simulate ieee33-lossy --strategy information
               dsse simulate ieee33 --delay-ms 20 --jitter-ms 100 --duplicate 0.1
               dsse simulate ieee33 --loss 0.3 --set areas={count=5}
    """
    from coordinator.lab.simulator.simulate import simulate_scenario

    check_parquet_option(parquet)
    end_orderly_on_signals()
    with progress(f"{scenario}, virtual time", quiet) as on_update:
        result = simulate_scenario(changed(scenario, changes), out, seed, strategy, timeout, on_update, links)
    return finish_run(result, formats, parquet, as_json)


@command(STUDY, short_help="Run the strategies side by side and print one table.")
@scenario_argument
@strategies_option
@click.option("--processes", is_flag=True, help="Run real processes over Zenoh instead of the simulator.")
@executor_option
@click.option("--out", type=click.Path(path_type=Path), help="Keep table and run folders here, new or empty.")
@timeout_option
@seed_option
@set_option
@link_options
@json_option
@figure_options
def compare(
    scenario: str,
    strategies: str | None,
    processes: bool,
    executor: str | None,
    out: Path | None,
    timeout: float | None,
    seed: int | None,
    changes: Mapping[str, object],
    links: LinkChanges,
    as_json: bool,
    formats: tuple[str, ...] | None,
) -> None:
    """Run every strategy on the telemetry and the faults of SCENARIO and print one table.

    Gaps are those to the centralised estimate at the verdict; `s to 1e-6`: the time from which on all areas stay
    closer to it than 1e-6 p.u. and rad, `-` if never.

    \b
    Examples:  dsse compare ieee33-lossy
               dsse compare ieee33 --strategies angle-offset,information --processes --out comparison
    """
    from coordinator.lab.evaluation.answers import head_json
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.studies.strategy_comparison import choose_strategies, compare_strategies, format_comparison

    if out is None and asked_for_formats():
        raise click.UsageError("--format draws figures into files; say where with --out DIR")
    end_orderly_on_signals()
    chosen = choose_strategies(strategies)
    loaded = choose_scenario(scenario, seed, timeout_s=timeout, links=links, changes=changes)
    outcomes: dict[str, RunOutcome] = {}
    if executor is not None and (processes or out is not None):
        raise click.UsageError("--executor gives the table only; leave out --processes and --out")
    if not processes and out is None:
        from coordinator.lab.studies.executors import open_executor
        from coordinator.lab.studies.sweep import compare_side_by_side

        with contextlib.nullcontext() if executor is None else open_executor(executor) as workers:
            rows = compare_side_by_side(loaded, chosen, workers)
    else:
        run = functools.partial(_run_and_keep, outcomes, _run_processes if processes else _run_on_simulator)
        rows = compare_strategies(loaded, chosen, run, out)
    buses, areas = len(loaded.network.buses), len(loaded.partition.areas)
    where = "real processes" if processes else "on the simulator, virtual time"
    heading = f"{printable(loaded.name)}, {buses} buses in {areas} areas, seed {loaded.seed}, {where}"
    content = head_json(loaded) | {"on": "processes" if processes else "simulator", "rows": list(map(asdict, rows))}
    answer(as_json, content | {"folder": out}, f"{heading}\n\n{format_comparison(rows)}")
    if out is not None:
        if formats is not None:
            from coordinator.show.report.study_report import report_comparison

            report_comparison(out, loaded, rows, outcomes, formats, given_arguments())
        report = "" if formats is None else f"\n{invite_to(out / 'report.html')}"
        (notify if as_json else show)(f"\nfiles: {printable(out)}{report}")


def _run_and_keep(
    kept: dict[str, RunOutcome], run: Callable[[Scenario, Path], RunOutcome], scenario: Scenario, folder: Path
) -> RunOutcome:
    kept[scenario.strategy] = run(scenario, folder)
    return kept[scenario.strategy]


def _run_processes(scenario: Scenario, folder: Path) -> RunOutcome:
    import coordinator

    notify(f"{scenario.strategy} ...")
    return coordinator.run(scenario, out=folder, plots=False)


def _run_on_simulator(scenario: Scenario, folder: Path) -> RunOutcome:
    from coordinator.lab.simulator.simulate import simulate_scenario

    notify(f"{scenario.strategy} ...")
    return simulate_scenario(scenario, folder)


@command(STUDY, short_help="Run a scenario many times while one key varies; table and picture.")
@scenario_argument
@click.option(
    "--vary",
    required=True,
    multiple=True,
    metavar="KEY=VALUES",
    help="START:STOP:N or a list, e.g. faults.loss=0:0.9:10; KEY,KEY=... take the same values; repeated, all pairs.",
)
@click.option("--seeds", type=click.IntRange(1, 100_000), default=5, show_default=True, help="Runs per value.")
@strategies_option
@click.option(
    "--quantity", multiple=True, metavar="COLUMN", help="Draw it; repeatable.  [default: gap_vm_pu, below_1e6_s]"
)
@click.option("--jobs", type=click.IntRange(1, 1024), help="Processes at a time.  [default: one per core]")
@executor_option
@click.option("--out", type=click.Path(path_type=Path), help="Folder; that of an earlier sweep is gone on with.")
@timeout_option
@set_option
@link_options
@quiet_option
@json_option
@figure_options
def sweep(
    scenario: str,
    vary: tuple[str, ...],
    seeds: int,
    strategies: str | None,
    quantity: tuple[str, ...],
    jobs: int | None,
    executor: str | None,
    out: Path | None,
    timeout: float | None,
    changes: Mapping[str, object],
    links: LinkChanges,
    quiet: bool,
    as_json: bool,
    formats: tuple[str, ...] | None,
) -> None:
    """Run SCENARIO on the simulator for each value of its keys, each strategy and each seed.

    Leaves sweep.csv, one row per run, sweep.png, quantities against the first key, and report.html. Runs that the table
    has already are not run again: after Ctrl-C the same command with the same --out goes on.

    \b
    Examples:  dsse sweep ieee33 --vary faults.loss=0:0.9:10 --seeds 20 --out sweep
               dsse sweep ieee33 --vary measurements.voltage.sigma_percent=0.1,0.2,0.5 --strategies information
               dsse sweep ieee33 --vary faults.loss=0,0.3 --vary 'areas={count=2},{count=4}'
               dsse sweep ieee33-load-error --quantity error_vm_pu --seeds 20
                   --vary faults.load_error.all.p_mw,faults.load_error.all.q_mvar=0:0.6:4
               dsse sweep ieee33 --vary faults.loss=0:0.9:10 --executor dask://127.0.0.1:8786 --out sweep
    """
    from coordinator.lab.studies.executors import open_executor
    from coordinator.lab.studies.strategy_comparison import choose_strategies
    from coordinator.lab.studies.sweep_plan import make_plan, parse_vary
    from coordinator.lab.studies.sweep_table import SweepTable
    from coordinator.show.figures.sweep_figure import check_quantities

    if executor is not None and jobs is not None:
        raise click.UsageError("--jobs is of this machine; give one of --executor and --jobs")
    end_orderly_on_signals()
    axes, drawn = [parse_vary(each) for each in vary], check_quantities(quantity)
    plan = make_plan(scenario, axes, choose_strategies(strategies), seeds, links, timeout, changes)
    folder = out or Path("runs") / f"sweep-{plan.base.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    with SweepTable(folder, plan.settings) as table:
        if table.cut_off:
            notify(f"the last line of {table.path} was half written; that run is done again")
        try:
            with open_executor(executor) if executor else contextlib.nullcontext() as workers:
                _run_missing(plan, table, jobs or operating_system.count_processors(), quiet, workers)
        except KeyboardInterrupt:
            notify(
                f"{len(table.rows)} runs are in {table.path}; the same command with --out {folder} goes on from there"
            )
            raise
        finally:
            _report(plan, table, drawn, folder, formats)
    report = None if formats is None else folder / "report.html"
    looked_at = "" if report is None else f"\n{invite_to(report)}"
    content = {"table": table.path, "report": report, "rows": table.list_rows()}
    answer(as_json, content, printable(f"{len(table.rows)} runs in {table.path}") + looked_at)


def _run_missing(plan: SweepPlan, table: SweepTable, jobs: int, quiet: bool, executor: Executor | None = None) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from coordinator.lab.studies.sweep import run_tasks

    missing = [task for task in plan.tasks if task not in table.rows]
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as bar:
        shown = bar.add_task(printable(plan.base.name), total=len(plan.tasks), completed=len(plan.tasks) - len(missing))
        for task, row in run_tasks(plan, missing, jobs, executor):
            table.add(task, row)
            bar.advance(shown)


def _report(
    plan: SweepPlan, table: SweepTable, quantities: tuple[str, ...], folder: Path, formats: tuple[str, ...] | None
) -> None:
    if table.rows and formats is not None:
        from coordinator.show.report.study_report import report_sweep

        report_sweep(folder, plan, table.rows, quantities, formats, given_arguments())


@command(STUDY, short_help="Print the tables of the thesis beside ours.")
@click.option("--table", "tables", multiple=True, metavar="NUMBER", help="Only this table, e.g. 5.9; repeatable.")
@click.option("--summary", is_flag=True, help="Print the last table only: one line per table of the thesis.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help=f"Write all rows to DIR/{THESIS_FILE}.")
@json_option
def thesis(tables: tuple[str, ...], summary: bool, out: Path | None, as_json: bool) -> None:
    """Run the scenarios of the thesis and print its tables of states beside ours, with the differences.

    The runs are on the simulator. Misprints are marked and left out of the largest differences. What each table of ours
    is stands above it; `dsse run ieee33-thesis` makes the same estimate with real processes.

    \b
    Examples:  dsse thesis --summary
               dsse thesis --table 5.9 --table 5.12 --out thesis
    """
    from coordinator.lab.thesis.comparison import as_one_table, compare_tables, format_compared, format_summary
    from coordinator.watch.run_folder import result_folder
    from coordinator.watch.tables import rows_as_json
    from dsse_core.files.drafts import whole_file

    end_orderly_on_signals()
    with nullcontext() if out is None else result_folder(out) as folder:
        compared = compare_tables(tables)
        texts = [] if summary else [f"{format_compared(table)}\n" for table in compared]
        content = {"rows": rows_as_json(as_one_table(compared)), "folder": out}
        answer(as_json, content, "\n".join([*texts, format_summary(compared)]))
        if folder is not None:
            with whole_file(folder / THESIS_FILE) as draft, draft.open("w", encoding="utf-8", newline="") as file:
                as_one_table(compared).to_csv(file)
            (notify if as_json else show)(f"\nfiles: {printable(folder)}")
