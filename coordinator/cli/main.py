"""The command line ``dsse``: every command in a few lines that call the package and print."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.command import STUDY, TRY, Group, command
from coordinator.cli.figure_options import asked_for_formats, figure_options, given_arguments
from coordinator.cli.flows import flows
from coordinator.cli.live.gateway import gateway
from coordinator.cli.live.record import record, replay
from coordinator.cli.live.serve import serve
from coordinator.cli.live.watch import metrics, watch
from coordinator.cli.networks import generate, import_file, partition, scenarios_commands
from coordinator.cli.operator import meter, scan, stop, switch
from coordinator.cli.outputs import Output, check_parquet_option, hand_over, output_options, parquet_option
from coordinator.cli.processes import agent, compile_, keys_commands, plant, router, split
from coordinator.cli.studies import compare, link_options, simulate, sweep, thesis
from coordinator.cli.terminal import (
    answer,
    answering_once,
    changed,
    end_output,
    finish_run,
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
from coordinator.watch.interrupts import INTERRUPTED_CODE, decide, end_orderly_on_signals
from dsse_core import compiling
from dsse_core.errors import DsseError

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from scenarios.faults.faults import LinkChanges
    from scenarios.files.readings.file import Scans
    from scenarios.scenario import Scenario

DISTRIBUTION = "consensus-dsse"


def run_command(arguments: Sequence[str]) -> int:
    """Run ``dsse`` with ``arguments``; a user's mistake becomes one message and exit code 2."""
    try:
        code = commands.main(list(arguments), prog_name="dsse", standalone_mode=False, obj=tuple(arguments))
    except DsseError as error:
        notify(f"error: {error}")
        return 2
    except click.ClickException as error:
        usage = io.StringIO()
        error.show(usage)
        notify(usage.getvalue().rstrip())
        return 2
    except OSError as error:  # a full disk, a folder that cannot be written, a path that is no file
        name = f"{error.filename}: " if error.filename else ""
        notify(f"error: {name}{error.strerror or error}; choose another place, or make room there")
        return 2
    except (KeyboardInterrupt, click.Abort):
        return report_interrupted()
    code = int(code or 0)
    _compile_for_next_time(code)
    return code


def _compile_for_next_time(code: int) -> None:
    """Compile the solvers that this command has done without, so that the next one is faster; see ``only_loading``.

    Compilation runs in this process, so that no process stays behind. Standard output ends before, for a reader of a
    pipe. A signal ends the command with ``code``.
    """
    if not compiling.has_done_without():
        return
    from coordinator.lab.process_run.compile_ahead import compile_for_next_time

    decide(code)
    notify(
        "the answer is complete; the compiled solver for the next ones is made now, once, in half a minute of a "
        "processor: Ctrl-C leaves it out (`dsse compile` makes all of it)"
    )
    end_output()
    with suppress(KeyboardInterrupt):
        compile_for_next_time()


def report_interrupted() -> int:
    """Print that the command was interrupted; its exit code."""
    notify("interrupted")
    return INTERRUPTED_CODE


def _show_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        from coordinator.lab.evaluation.answers import version_of

        show(f"{DISTRIBUTION} {version_of(DISTRIBUTION) or 'in a folder, not installed'}")
        context.exit()


@click.group(cls=Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
def commands() -> None:
    """Decentralised state estimation of power grids: one process per area, over Zenoh.

    \b
    Example:  dsse run ieee33
    """


@command(
    TRY, codes={0: "the areas agree", 1: "they do not"}, short_help="Run a scenario as real processes and evaluate it."
)
@scenario_argument
@run_folder_option
@timeout_option
@seed_option
@quiet_option
@figure_options
@strategy_option
@set_option
@link_options
@parquet_option
@json_option
@click.option("--secure", is_flag=True, help="Certificates, TLS and access control, with keys made for this run.")
@click.option("--keys", type=click.Path(path_type=Path), metavar="DIR", help="The same with the keys in DIR.")
def run(
    scenario: str,
    out: Path | None,
    timeout: float | None,
    seed: int | None,
    quiet: bool,
    formats: tuple[str, ...] | None,
    strategy: str | None,
    changes: Mapping[str, object],
    links: LinkChanges,
    parquet: bool,
    as_json: bool,
    secure: bool,
    keys: Path | None,
) -> int:
    """Run SCENARIO, a shipped name or a file: start router, plant and one agent per area, watch, evaluate.

    \b
    Examples:  dsse run ieee33
               dsse run ieee33-lossy --strategy information
               dsse run my/scenario.toml --seed 7 --out results
               dsse run ieee33 --loss 0.3 --set measurements.voltage.sigma_percent=0.5
               dsse run ieee33 --secure
               dsse run ieee33 --format pdf,svg
    """
    import coordinator

    check_parquet_option(parquet)
    end_orderly_on_signals()
    with progress(scenario, quiet) as on_update:
        result = coordinator.run(
            changed(scenario, changes, links),
            out=out,
            seed=seed,
            strategy=strategy,
            timeout_s=timeout,
            on_update=on_update,
            plots=False,
            secure=secure,
            keys=keys,
        )
    return finish_run(result, formats, parquet, as_json)


@command(TRY, short_help="Check a scenario or an area file without running it.")
@scenario_argument
@set_option
@json_option
@answering_once()
def check(scenario: str, changes: Mapping[str, object], as_json: bool) -> None:
    """Check SCENARIO without running it: keys, network, areas, meters, observability of the grid and each area.

    An area file in its place is checked as `dsse agent` would.

    \b
    Examples:  dsse check my/scenario.toml
               dsse check areas/area1.toml
    """
    from agents.area_files.reader import load_area_file
    from agents.strategies.installed import list_strategies
    from coordinator.lab.evaluation.answers import head_json
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.strategy_check import check_with_strategy
    from coordinator.show.report.text import format_area_check, format_check
    from dsse_core.files.kinds import AREA_FILE
    from dsse_core.files.strict_table import OtherKindError

    try:
        found = check_with_strategy(choose_scenario(scenario, changes=changes))
        areas = found.partition.listed
        content = head_json(found) | {"meters": len(found.meters), "areas": areas}
        answer(as_json, content, format_check(found))
    except OtherKindError as error:
        if error.found is not AREA_FILE or changes:
            raise
        file = load_area_file(Path(scenario), list_strategies())
        neighbours = [neighbour.area for neighbour in file.area.neighbours]
        of_file = {"area": file.area.name, "run": file.run, "strategy": file.strategy, "neighbours": neighbours}
        answer(as_json, of_file | {"is_sound": file.identity.is_sound}, format_area_check(file))


@command(STUDY, short_help="Solve the power flow of the whole network.")
@scenario_argument
@set_option
@output_options
@answering_once()
def powerflow(scenario: str, changes: Mapping[str, object], output: Output) -> None:
    """Solve the power flow of SCENARIO's whole network: the truth that its meters read. A network file does, too.

    \b
    Examples:  dsse powerflow industrial13
               dsse powerflow network.toml
               dsse powerflow ieee33 --csv branches
               dsse powerflow ieee33 --out results
    """
    from coordinator.lab.evaluation.answers import power_flow_as_json
    from coordinator.show.report.grid_text import format_power_flow
    from dsse_core.grid.network import Network
    from dsse_core.power_flow.newton_raphson import solve_power_flow
    from dsse_core.results.results import TABLES, results_of_power_flow
    from scenarios.named_grid import load_grid

    output.check_table(TABLES, "of a power flow")
    loaded = load_grid(scenario, changes=changes, whole=output.is_text)
    if isinstance(loaded, Network):
        result = solve_power_flow(loaded)
        tables = results_of_power_flow(result)
    else:
        result = solve_power_flow(loaded.network)
        tables = results_of_power_flow(result, partition=loaded.partition, meters=loaded.meters)
    hand_over(output, tables, lambda: power_flow_as_json(loaded, result), lambda: format_power_flow(result, tables))


@command(STUDY, codes={1: "a scan has no estimate"}, short_help="Estimate the whole grid in one place.")
@scenario_argument
@seed_option
@set_option
@click.option("--readings", type=click.Path(path_type=Path), metavar="FILE", help="Estimate these readings instead.")
@click.option("--open", "opened", multiple=True, metavar="ID", help="Count this switch as open; repeatable.")
@click.option("--close", "closed", multiple=True, metavar="ID", help="Count this switch as closed; repeatable.")
@output_options
@figure_options
@answering_once()
def estimate(
    scenario: str,
    seed: int | None,
    changes: Mapping[str, object],
    readings: Path | None,
    opened: tuple[str, ...],
    closed: tuple[str, ...],
    output: Output,
    formats: tuple[str, ...] | None,
) -> int:
    """Estimate the whole grid of SCENARIO in one place, with bad-data processing: what a control centre would do.

    FILE is a readings file; with a column `scan`, all of its scans are estimated, and DIR gets a report with figures.

    \b
    Examples:  dsse estimate ieee33 --seed 7
               dsse estimate ieee33 --csv meters
               dsse estimate ieee33 --json --out results
               dsse estimate ieee33 --readings day.csv --out day
    """
    from coordinator.lab.evaluation.scan_estimates import load_scans_of, operate, operate_scans, with_one_scan
    from scenarios.scenario import load_scenario

    loaded = load_scenario(scenario, changes=changes, whole=output.is_text)
    loaded = loaded if seed is None else replace(loaded, seed=seed)
    loaded, all_closed = operate(loaded, opened, closed), operate(loaded, (), closed)
    if readings is not None:
        scans = operate_scans(load_scans_of(all_closed, readings), loaded.network)
        if scans.are_named:
            return _estimate_scans(loaded, scans, output, formats)
        loaded = with_one_scan(loaded, scans)
    if asked_for_formats():
        raise click.UsageError("--format: a single scan has no figures; give readings with a column scan")
    _estimate_once(loaded, output)
    return 0


def _estimate_once(loaded: Scenario, output: Output) -> None:
    from coordinator.lab.evaluation.answers import estimate_as_json
    from coordinator.lab.evaluation.scan_estimates import estimate_whole_grid
    from coordinator.show.report.grid_text import format_bad_data, format_estimate
    from dsse_core.results.results import TABLES, results_of_estimate

    output.check_table(TABLES, "of one scan")
    report, truth = estimate_whole_grid(loaded)
    tables = results_of_estimate(report, partition=loaded.partition, meters=loaded.meters, truth=truth)
    is_changed = report.removed or report.switched or report.detected or report.result.network.dead
    notes = format_bad_data(report)[1:] if is_changed else []
    hand_over(output, tables, lambda: estimate_as_json(loaded, report), lambda: format_estimate(report, tables), notes)


def _estimate_scans(loaded: Scenario, scans: Scans, output: Output, formats: tuple[str, ...] | None) -> int:
    """Estimate every scan and print the results; the exit code, 1 if a scan has no estimate."""
    from coordinator.lab.evaluation.answers import scans_as_json
    from coordinator.lab.evaluation.scan_estimates import estimate_scans
    from coordinator.show.report.grid_text import format_scans
    from dsse_core.results.scans import ScanTables

    output.check_table(ScanTables.names, "of many scans")
    if output.folder is None and asked_for_formats():
        raise click.UsageError("--format writes files; say where with --out DIR")
    found = estimate_scans(loaded, scans)
    tables, failures = found.tables, [f"no estimate of {failure}" for failure in found.describe_failures()]
    hand_over(output, tables, lambda: scans_as_json(loaded, found), lambda: format_scans(found, tables), failures)
    if output.folder is not None and formats is not None:
        from coordinator.show.report.scan_report import write_scan_report

        write_scan_report(output.folder, loaded, tables, formats, given_arguments())
    return 1 if failures else 0


ALL = (
    *(run, simulate, scenarios_commands, check),
    *(compare, sweep, thesis, estimate, powerflow, partition, generate, import_file),
    *(split, keys_commands, router, agent, plant, gateway, meter, switch, scan, stop, compile_),
    *(watch, serve, flows, metrics, record, replay),
)
for each in ALL:
    commands.add_command(each)
