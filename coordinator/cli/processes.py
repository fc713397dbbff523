"""Commands of a system that is started by hand, on one host or several: area files, keys, router, plant."""

from __future__ import annotations

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.command import OPERATE, Command, command, group, removed_option
from coordinator.cli.terminal import (
    DEFAULT_ENDPOINT,
    SECURE_ENDPOINT,
    Number,
    answer,
    check_connect,
    check_listen,
    choose_endpoints,
    connect_option,
    json_option,
    keys_option,
    name_program,
    optional_scenario_argument,
    run_id_option,
    scenario_argument,
    seed_option,
    wait_option,
)
from dsse_core.endpoints import add_protocol
from dsse_core.limits import LONGEST_S, SHORTEST_SCAN_S
from dsse_core.printable import printable

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from agents.security.access import Access


from coordinator.cli.terminal import notify

YEAR_DAYS = 365.0
LONGEST_DAYS = 36500.0
SCAN_SECONDS = Number(min=SHORTEST_SCAN_S, max=LONGEST_S)


@command(OPERATE, short_help="Write one file per area.")
@scenario_argument
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True, help="Folder for the area files.")
@run_id_option
@connect_option("--secure")
@click.option("--secure", is_flag=True, help="For agents with --keys: areas that link directly do so with TLS.")
@seed_option
@json_option
def split(
    scenario: str,
    out: Path,
    run_id: str | None,
    endpoints: tuple[str, ...],
    secure: bool,
    seed: int | None,
    as_json: bool,
) -> None:
    """Write one file per area of SCENARIO: all that `dsse agent` needs, here or on another host.

    \b
    Examples:  dsse split ieee33 --out areas --connect tcp/192.0.2.7:7447
               dsse split ieee33 --out areas --secure
    """
    from agents.messages.keys import choose_run_id
    from coordinator.lab.deployment.endpoints import choose_area_endpoints
    from coordinator.lab.deployment.split import write_area_files
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.strategy_check import check_with_strategy
    from scenarios.files.whole_folder import written_whole

    prepared = check_with_strategy(choose_scenario(scenario, seed))
    endpoints = choose_endpoints(endpoints, secure)
    direct = prepared.transport.kind == "neighbours"
    area_endpoints = choose_area_endpoints(prepared, "tls" if secure else "tcp") if direct else {}
    run = choose_run_id(prepared.name, run_id)
    with written_whole(out) as new:
        names = [path.name for _, path in write_area_files(prepared, run, endpoints, new, area_endpoints)]
    files = [out / name for name in names]
    answer(as_json, {"run": run, "files": files}, "\n".join(map(printable, files)))


@command(
    OPERATE,
    codes={3: "a newer process of the same area runs", 4: "the operator has stopped it"},
    serves=True,
    short_help="Run the agent of one area.",
    context_settings={"ignore_unknown_options": True},
    add_help_option=False,
)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED, metavar="AREA_FILE")
def agent(arguments: tuple[str, ...]) -> int:
    """Run the agent of one area from its area file.

    \b
    Example:  dsse agent areas/area1.toml --connect tcp/192.0.2.7:7447
    """
    from agents.__main__ import main

    return main(arguments)


@command(OPERATE, serves=True, short_help="Run the router that all the others connect to.")
@click.option(
    "--listen",
    "endpoints",
    multiple=True,
    callback=check_listen,
    metavar="HOST:PORT",
    help=f"Where; repeatable.  [default: {DEFAULT_ENDPOINT}; with --keys {SECURE_ENDPOINT}]",
)
@click.option(
    "--connect",
    "others",
    multiple=True,
    callback=check_connect,
    metavar="HOST:PORT",
    help="Another router to link with, now or later; repeatable.",
)
@keys_option
@click.option("--run", "run_id", help="Apply the rules to this run.  [default: that in DIR; the scenario's name]")
@optional_scenario_argument
@removed_option("--scenario", "give the scenario without an option: dsse router SCENARIO")
def router(
    endpoints: tuple[str, ...], others: tuple[str, ...], keys: Path | None, run_id: str | None, scenario: str | None
) -> int:
    """Run the Zenoh router that agents, plant and coordinator connect to, until Ctrl-C. Linked routers are one bus.

    With SCENARIO, without keys: only what the processes of its run publish passes.

    \b
    Examples:  dsse router --listen 0.0.0.0:7447
               dsse router --listen 0.0.0.0:7447 --keys keys
               dsse router --listen 0.0.0.0:7448 --connect 192.0.2.7:7447
               dsse router ieee33
    """
    from coordinator.lab.process_run.router_process import main

    if scenario and keys:
        raise click.UsageError("SCENARIO and --keys: the rules of access beside the keys name the areas already")
    secured = keys is not None
    arguments = [part for here in add_protocol(endpoints, secured=secured) for part in ("--listen", here)]
    arguments += [part for there in add_protocol(others, secured=secured) for part in ("--connect", there)]
    arguments += ["--keys", str(keys)] if keys else []
    arguments += ["--run", run_id] if run_id else []
    return main(arguments, _access_of(scenario, run_id) if scenario else None)


def _access_of(scenario: str, run_id: str | None) -> Access:
    """Processes and rights of a run of ``scenario``."""
    from agents.messages.keys import choose_run_id
    from agents.security.access import access_without_keys
    from scenarios.scenario import load_scenario

    loaded = load_scenario(scenario)
    return access_without_keys(loaded.partition, choose_run_id(loaded.name, run_id), loaded.reading_rules)


@command(
    OPERATE,
    codes={3: "a newer plant runs", 4: "the operator has stopped it"},
    serves=True,
    short_help="Publish the meter readings of a scenario.",
)
@scenario_argument
@connect_option()
@keys_option
@run_id_option
@wait_option
@seed_option
@click.option(
    "--every",
    type=SCAN_SECONDS,
    metavar="S",
    help="Make a new scan every so many seconds.  [default: the scenario's run.scan_s, else one only]",
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

    With `kind = "neighbours"` it links with every area, where the scenario or --connect says that it listens.

    \b
    Example:  dsse plant ieee33 --connect tcp/192.0.2.7:7447
    """
    from agents.messages.keys import choose_run_id
    from coordinator.lab.deployment.endpoints import known_area_endpoints
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.plant.plant import run_plant
    from coordinator.lab.plant.scans import OwnScans
    from coordinator.lab.strategy_check import check_with_strategy

    prepared = check_with_strategy(choose_scenario(scenario, seed))
    every = every or prepared.run.scan_s or prepared.renew_s
    # a restarted plant has new readings: the clock is ahead of all scan numbers of its last incarnation
    scan = int(time.time() / SHORTEST_SCAN_S)
    direct = prepared.transport.kind == "neighbours"
    if direct and not endpoints:
        endpoints = tuple(known_area_endpoints(prepared, "tls" if keys else "tcp").values())
    endpoints = choose_endpoints(endpoints, keys is not None)
    return run_plant(
        OwnScans(prepared, many=bool(every)),
        choose_run_id(prepared.name, run_id),
        endpoints,
        timeout,
        scan,
        every,
        keys,
        direct,
    )


@command(OPERATE, "compile", short_help="Compile the solvers of large radial networks ahead.")
@json_option
def compile_(as_json: bool) -> None:
    """Compile the solvers of large radial networks now, so that no run has to: for an image, or by an administrator.

    They are kept in the folder of NUMBA_CACHE_DIR if that is set, else beside the package if that can be written, else
    in the cache folder of the user. A processor of another kind compiles anew.

    \b
    Example:  sudo /opt/dsse/bin/dsse compile
    """
    from coordinator.lab.process_run.compile_ahead import compile_ahead

    ahead = compile_ahead()
    text = f"kept in {ahead.folder}" if ahead.folder else f"is compiled already, in {' or '.join(ahead.found_in)}"
    answer(as_json, {"kept_in": ahead.folder, "found_in": ahead.found_in}, text)


@group(OPERATE, "keys")
def keys_commands() -> None:
    """Certificates and private keys, for --keys and `dsse run --secure`.

    \b
    Example:  dsse keys create ieee33 --out keys
    """


@keys_commands.command(cls=Command, part=OPERATE, short_help="Make a private authority and the keys of every process.")
@scenario_argument
@click.option("--out", type=click.Path(path_type=Path), default="keys", show_default=True, help="Folder, new or empty.")
@click.option(
    "--days",
    type=Number(min=0, min_open=True, max=LONGEST_DAYS),
    default=YEAR_DAYS,
    show_default=True,
    help="They are valid so long.",
)
@click.option(
    "--host",
    "hosts",
    multiple=True,
    help="Name or address under which those who listen are reached, beside localhost; NAME=HOST for NAME alone; "
    "repeatable.",
)
@run_id_option
@json_option
def create(scenario: str, out: Path, days: float, hosts: tuple[str, ...], run_id: str | None, as_json: bool) -> None:
    """Make a private authority, and for each process of SCENARIO a folder with all that it needs on its host: its
    certificate and key, that of the authority, and the rules of who may publish.

    \b
    Examples:  dsse keys create ieee33 --out keys
               dsse keys create ieee33 --host grid-a.example --host 192.0.2.7
               dsse keys create my/neighbours.toml --host area1=grid-a.example
    """
    from agents.messages.keys import choose_run_id
    from agents.security.access import access_of
    from agents.security.credential_files import AUTHORITY
    from coordinator.lab.deployment.certificates import create_keys
    from scenarios.reading_rules import find_gateway_remark
    from scenarios.scenario import load_scenario

    loaded = load_scenario(scenario)
    access = access_of(loaded.partition, choose_run_id(loaded.name, run_id), loaded.reading_rules)
    create_keys(out, access, days, hosts, direct=loaded.transport.kind == "neighbours", apart=True)
    lines = [
        f"{out}: a folder for each of {', '.join(access.names)}, valid for {days:g} days",
        f"copy each to the host of its process, into the folder of its --keys; {out / AUTHORITY} stays away from all",
        f"next: {shlex.join([name_program(), 'run', scenario, '--keys', str(out)])}",
    ]
    answer(as_json, {"run": access.run, "folder": out, "processes": access.names}, "\n".join(map(printable, lines)))
    if remark := find_gateway_remark(loaded.reading_rules):
        notify(f"warning: {remark}, then make the keys anew")
