"""The command ``dsse watch``: attach to a running system and show it."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.command import INSPECT, command, removed_option
from coordinator.cli.live.address import address_options
from coordinator.cli.terminal import (
    choose_endpoints,
    connect_option,
    direct_option,
    keys_option,
    optional_scenario_argument,
    run_option,
    show,
)
from coordinator.watch.interrupts import end_orderly_on_signals
from coordinator.watch.observe.run_address import RunAddress

if TYPE_CHECKING:  # the real imports stand in the command, so that every other starts fast
    from coordinator.watch.observe.grid_tables import GridTables
    from coordinator.watch.observe.watcher import Watcher
    from dsse_core.results.table import Table

    Tables = Callable[[Watcher], Mapping[str, Table]]

UPDATE_S = 0.2
BRANCHES = "branches"  # a table that only --json has
LINE_S = 1.0  # between two lines where there is no terminal
DEFAULT_LISTEN = "127.0.0.1:9464"  # of `dsse metrics`
ATTEMPT_S = 2.0  # to reach the bus; meanwhile `dsse metrics` answers requests, then it tries again


@command(
    INSPECT,
    codes={1: "with --once: no area was received"},
    serves=True,
    short_help="Watch a running system from outside.",
)
@address_options
@optional_scenario_argument
@removed_option("--grid", "give the scenario without an option: dsse watch SCENARIO")
@click.option("--buses", is_flag=True, help="Show the voltage of every bus, too.")
@click.option("--meters", is_flag=True, help="Show every reading and its normalised residual, too.")
@click.option("--once", is_flag=True, help="Show it once, when all areas that are there have been received, and end.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
def watch(address: RunAddress, scenario: str | None, buses: bool, meters: bool, once: bool, as_json: bool) -> int:
    """Watch the areas of a running system, started by any command: how good their estimates are, and why not better.

    A line for each area: quality, scan, age, range of voltages, and the meter of the largest normalised
    residual; below it the reason for its quality. SCENARIO adds kV and kW, and meters that are silent. --json has all
    that is known.

    Ctrl-C ends the watching and nothing else.

    \b
    Examples:  dsse watch
               dsse watch ieee33 --buses --meters
               dsse watch --connect tcp/192.0.2.7:7447 --once --json
    """
    from coordinator.watch.observe.attachment import attach, wait_until_whole

    end_orderly_on_signals()
    known = _load_grid(scenario)
    find_tables = _tables_of(known, buses or as_json, meters or as_json)
    areas = frozenset(area.name for area in known.partition.areas) if known else None
    try:
        with attach(address, areas=areas) as look:
            if once:
                watcher = wait_until_whole(look, address.timeout_s, with_readings=meters)
                show(_format(watcher, find_tables, as_json))
                return 0 if watcher.is_whole() else 1
            live = sys.stdout.isatty() and not as_json
            _show_on(lambda: look.for_whole(UPDATE_S), find_tables, live, as_json)
    except KeyboardInterrupt:
        if once:
            raise
    return 0


def _load_grid(scenario: str | None) -> GridTables | None:
    """The network and the meters of ``scenario``."""
    if scenario is None:
        return None
    from coordinator.watch.observe.grid_tables import GridTables
    from scenarios.scenario import load_scenario

    return GridTables(load_scenario(scenario))


def _tables_of(known: GridTables | None, buses: bool, meters: bool) -> Tables:
    """Function from a watcher to the tables that are wanted, by name."""
    if not (buses or meters):
        return lambda watcher: {}
    from coordinator.watch.observe.grid_tables import list_buses, list_meters, worst_first

    def find(watcher: Watcher) -> dict[str, Table]:
        states, readings = watcher.states, watcher.readings
        tables = {}
        if buses and known:
            tables = dict(zip(("buses", BRANCHES), known.buses_and_branches(states), strict=True))
        elif buses:
            tables["buses"] = list_buses(states)
        if meters:
            tables["meters"] = worst_first(known.meters(states, readings) if known else list_meters(states, readings))
        return tables

    return find


def _show_on(look: Callable[[], Watcher], find_tables: Tables, live: bool, as_json: bool) -> None:
    """Show the views of ``look`` until Ctrl-C, or until the reader of standard output has closed it."""
    if live:
        from coordinator.watch.observe.causes import find_causes
        from coordinator.watch.observe.view_text import live_view

        with live_view() as update:
            while True:
                watcher = look()
                view = watcher.look(time.monotonic())
                shown = [table for name, table in find_tables(watcher).items() if name != BRANCHES]
                update(view, shown, find_causes(view, time.time()))
    next_line = 0.0
    while True:
        watcher = look()
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + LINE_S
            if not show(_format(watcher, find_tables, as_json)):
                return


def _format(watcher: Watcher, find_tables: Tables, as_json: bool) -> str:
    from coordinator.watch.observe.causes import find_causes

    view, at, tables = watcher.look(time.monotonic()), time.time(), find_tables(watcher)
    if as_json:
        from coordinator.watch.observe.view_json import describe_causes, describe_tables, describe_view

        causes = describe_causes(find_causes(view, at))
        return json.dumps({"time": at, "causes": causes, **describe_view(view), **describe_tables(tables)})
    from coordinator.watch.observe.view_text import format_view

    return format_view(view, [table for name, table in tables.items() if name != BRANCHES], find_causes(view, at))


@command(INSPECT, serves=True, short_help="Serve /metrics, /health and /ready of a running system over HTTP.")
@click.option("--listen", default=DEFAULT_LISTEN, show_default=True, metavar="HOST:PORT", help="Where to answer.")
@click.option(
    "--name",
    "names",
    multiple=True,
    help="Name of this host under which it is asked, beside its addresses; repeatable.",
)
@connect_option()
@direct_option
@keys_option
@run_option
def metrics(
    listen: str, names: tuple[str, ...], endpoints: tuple[str, ...], direct: bool, keys: Path | None, run_id: str | None
) -> int:
    """Watch the areas of a running system and serve what is seen to Prometheus, until Ctrl-C.

    /health answers 200 while the bus is reachable, /ready while every area that was ever seen shows a fresh state, else
    503 with the reasons. Beyond loopback it is asked for by an address in digits, or by a --name.

    \b
    Examples:  dsse metrics
               dsse metrics --listen 0.0.0.0:9464 --connect tls/192.0.2.7:7447 --keys keys
    """
    from coordinator.watch.metrics.serve import check_prometheus, serve_metrics

    check_prometheus()
    from agents.runtime.log import start_log
    from coordinator.watch.listen import parse_listen
    from coordinator.watch.metrics.metrics_page import MetricsPage
    from coordinator.watch.observe.attachment import attach

    start_log()
    address = RunAddress(choose_endpoints(endpoints, keys is not None), run_id, ATTEMPT_S, keys, direct)
    with MetricsPage(*parse_listen(listen, DEFAULT_LISTEN), names) as page:
        serve_metrics(page, lambda: attach(address), renews=keys is not None)
    return 0
