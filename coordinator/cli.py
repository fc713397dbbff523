"""The command line ``dsse``: every command in a few lines that call the package and print."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli_keys import keys_commands
from coordinator.cli_networks import network_commands
from coordinator.cli_studies import study_commands
from coordinator.cli_watch import watch
from coordinator.terminal import (
    DEFAULT_ENDPOINT,
    SECURE_ENDPOINT,
    Number,
    bus_timeout_option,
    choose_endpoints,
    connect_option,
    end_orderly_on_signals,
    finish_run,
    keys_option,
    no_plots_option,
    progress,
    quiet_option,
    run_folder_option,
    run_id_option,
    say,
    scenario_argument,
    seed_option,
    strategy_option,
    timeout_option,
)
from dsse_core.errors import DsseError

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from scenarios.scenario import Scenario


SHORTEST_SCAN_S = 0.001
SCAN_SECONDS = Number(min=SHORTEST_SCAN_S, max=86400)


def run_command(arguments: Sequence[str]) -> int:
    """Run ``dsse`` with ``arguments``; a user's mistake becomes one message and exit code 2."""
    try:
        code = commands.main(list(arguments), prog_name="dsse", standalone_mode=False)
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except click.ClickException as error:
        error.show()
        return 2
    except OSError as error:  # a full disk, a folder that cannot be written, a file that is none
        name = f"{error.filename}: " if error.filename else ""
        say(f"error: {name}{error.strerror or error}; choose another place, or make room there")
        return 2
    except (KeyboardInterrupt, click.Abort):
        print("interrupted", file=sys.stderr)
        return 1
    return int(code or 0)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
def commands() -> None:
    """Decentralised state estimation of power grids: one process per area, over Zenoh.

    \b
    Example:  dsse run ieee33
    """


@commands.command(short_help="Run a scenario as real processes and judge it.")
@scenario_argument
@run_folder_option
@timeout_option
@seed_option
@quiet_option
@no_plots_option
@strategy_option
@click.option("--secure", is_flag=True, help="Certificates, TLS and access control, with keys made for this run.")
@click.option("--keys", type=click.Path(path_type=Path), metavar="DIR", help="The same with the keys in DIR.")
def run(
    scenario: str,
    out: Path | None,
    timeout: float | None,
    seed: int | None,
    quiet: bool,
    no_plots: bool,
    strategy: str | None,
    secure: bool,
    keys: Path | None,
) -> int:
    """Run SCENARIO, a shipped name or a file: start router, plant and one agent per area, watch, judge.

    Exit code 0: the areas agree; 1: they do not; 2: wrong input.

    \b
    Examples:  dsse run ieee33
               dsse run ieee33-lossy --strategy information
               dsse run my/scenario.toml --seed 7 --out results
               dsse run ieee33 --secure
    """
    import coordinator

    end_orderly_on_signals()
    with progress(scenario, quiet) as on_update:
        result = coordinator.run(
            scenario,
            out=out,
            seed=seed,
            strategy=strategy,
            timeout_s=timeout,
            on_update=on_update,
            plots=False,
            secure=secure,
            keys=keys,
        )
    return finish_run(result, no_plots)


@commands.command(short_help="Check a scenario without running it.")
@scenario_argument
def check(scenario: str) -> None:
    """Check SCENARIO without running it: keys, network, areas, meters, observability of the grid and each area.

    \b
    Example:  dsse check my/scenario.toml
    """
    prepared = _prepare(scenario, None)
    from coordinator.report import format_check

    print(format_check(prepared))


@commands.command()
def scenarios() -> None:
    """List the shipped scenarios.

    \b
    Example:  dsse scenarios
    """
    from scenarios.scenario import list_scenarios

    listed = list_scenarios()
    width = max(len(name) for name, _ in listed)
    for name, description in listed:
        print(f"{name:{width}}  {description}")


@commands.command(short_help="Solve the power flow of the whole network.")
@scenario_argument
def powerflow(scenario: str) -> None:
    """Solve the power flow of SCENARIO's whole network: the truth that its meters read.

    \b
    Example:  dsse powerflow industrial13
    """
    from coordinator.report import format_power_flow
    from dsse_core.power_flow import solve_power_flow
    from scenarios.scenario import load_scenario

    print(format_power_flow(solve_power_flow(load_scenario(scenario).network)))


@commands.command(short_help="Estimate the whole grid in one place.")
@scenario_argument
@seed_option
def estimate(scenario: str, seed: int | None) -> None:
    """Estimate the whole grid of SCENARIO in one place, with bad-data processing: what a control centre would do.

    \b
    Example:  dsse estimate ieee33 --seed 7
    """
    prepared = _prepare(scenario, seed)
    from coordinator.report import format_estimate
    from dsse_core.bad_data import process_bad_data
    from scenarios.telemetry import make_telemetry

    telemetry = make_telemetry(prepared)
    report = process_bad_data(prepared.network, telemetry.union, tolerance=prepared.tolerances.estimator)
    print(format_estimate(report, telemetry.truth))


@commands.command(short_help="Write one file per area.")
@scenario_argument
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the area files.")
@run_id_option
@connect_option("--secure")
@click.option("--secure", is_flag=True, help="For agents with --keys: areas that link directly do so with TLS.")
@seed_option
def split(
    scenario: str, out: Path, run_id: str | None, endpoints: tuple[str, ...], secure: bool, seed: int | None
) -> None:
    """Write one file per area of SCENARIO: all that `dsse agent` needs, here or on another host.

    \b
    Examples:  dsse split ieee33 --out areas --connect tcp/192.0.2.7:7447
               dsse split ieee33 --out areas --secure
    """
    prepared = _prepare(scenario, seed)
    from coordinator.places import choose_places
    from coordinator.split import choose_run_id, write_area_files

    endpoints = choose_endpoints(endpoints, secure)
    direct = prepared.transport.kind == "neighbours"
    places = choose_places(prepared, "tls" if secure else "tcp") if direct else {}
    for path in dict(write_area_files(prepared, choose_run_id(prepared, run_id), endpoints, out, places)).values():
        print(path)


@commands.command(
    short_help="Run the agent of one area.", context_settings={"ignore_unknown_options": True}, add_help_option=False
)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def agent(arguments: tuple[str, ...]) -> int:
    """Run the agent of one area from its area file.

    \b
    Example:  dsse agent areas/area1.toml --connect tcp/192.0.2.7:7447
    """
    from agents.__main__ import main

    return main(arguments)


@commands.command(short_help="Run the router that all the others connect to.")
@click.option(
    "--listen",
    "endpoints",
    multiple=True,
    help=f"Where; repeatable.  [default: {DEFAULT_ENDPOINT}; with --keys {SECURE_ENDPOINT}]",
)
@click.option("--connect", "others", multiple=True, help="Another router to link with, now or later; repeatable.")
@keys_option
@click.option("--run", "run_id", help="Apply the rules of access in DIR to this run.  [default: the run named there]")
def router(endpoints: tuple[str, ...], others: tuple[str, ...], keys: Path | None, run_id: str | None) -> int:
    """Run the Zenoh router that agents, plant and coordinator connect to, until Ctrl-C. Linked routers are one bus.

    \b
    Examples:  dsse router --listen tcp/0.0.0.0:7447
               dsse router --listen tls/0.0.0.0:7447 --keys keys
               dsse router --listen tcp/0.0.0.0:7448 --connect tcp/192.0.2.7:7447
    """
    from coordinator.router_process import main

    arguments = [part for endpoint in endpoints for part in ("--listen", endpoint)]
    arguments += [part for other in others for part in ("--connect", other)]
    arguments += ["--keys", str(keys)] if keys else []
    return main([*arguments, "--run", run_id] if run_id else arguments)


@commands.command(short_help="Publish the meter readings of a scenario.")
@scenario_argument
@connect_option()
@keys_option
@run_id_option
@bus_timeout_option
@seed_option
@click.option(
    "--every", type=SCAN_SECONDS, metavar="S", help="Make a new scan every so many seconds.  [default: one only]"
)
def plant(
    scenario: str,
    endpoints: tuple[str, ...],
    keys: Path | None,
    run_id: str | None,
    timeout: float,
    seed: int | None,
    every: float | None,
) -> int:
    """Publish the meter readings of SCENARIO on the bus until Ctrl-C; in the field a gateway does this.

    \b
    Example:  dsse plant ieee33 --connect tcp/192.0.2.7:7447
    """
    prepared = _prepare(scenario, seed)
    from coordinator.plant import run_plant
    from coordinator.split import choose_run_id

    # a plant that is started anew has new readings: the clock is ahead of all numbers of its last life
    scan = int(time.time() / SHORTEST_SCAN_S)
    endpoints = choose_endpoints(endpoints, keys is not None)
    direct = prepared.transport.kind == "neighbours"
    return run_plant(prepared, choose_run_id(prepared, run_id), endpoints, timeout, scan, every, keys, direct)


def _prepare(scenario: str, seed: int | None) -> Scenario:
    from agents.strategies import STRATEGIES
    from scenarios.check import check_scenario
    from scenarios.scenario import load_scenario

    loaded = load_scenario(scenario, strategies=tuple(STRATEGIES))
    check_scenario(loaded)
    return loaded if seed is None else replace(loaded, seed=seed)


for command in (*network_commands, *study_commands, keys_commands, watch):
    commands.add_command(command)
