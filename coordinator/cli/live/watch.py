"""The command ``dsse watch``: attach to a running system and show it."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
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
    from coordinator.watch.observe.causes import Cause, Onsets
    from coordinator.watch.observe.grid_tables import GridTables
    from coordinator.watch.observe.summary import Summary
    from coordinator.watch.observe.view import View
    from coordinator.watch.observe.watcher import Watcher
    from dsse_core.results.table import Table

UPDATE_S = 0.2
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
    shown = Shown(known, buses or as_json, meters or as_json, as_json)
    areas = frozenset(area.name for area in known.partition.areas) if known else None
    try:
        with attach(address, areas=areas) as look:
            if once:
                watcher = wait_until_whole(look, address.timeout_s, with_readings=meters)
                show(shown.write(watcher))
                return 0 if watcher.is_whole() else 1
            _show_on(lambda: look.for_whole(UPDATE_S), shown, live=sys.stdout.isatty() and not as_json)
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


@dataclass(frozen=True)
class Shown:
    """The content of a view: of the grid ``known``, if it is, with the tables that are wanted, as text or JSON."""

    known: GridTables | None
    buses: bool
    meters: bool
    as_json: bool

    def find(self, watcher: Watcher) -> tuple[View, Mapping[str, Table], Sequence[Cause], Summary]:
        """View, tables by name, causes and summary."""
        from coordinator.watch.observe.causes import find_causes
        from coordinator.watch.observe.grid_tables import find_tables, worst_first
        from coordinator.watch.observe.summary import summarise
        from dsse_core.results.table import Table

        view = watcher.look(time.monotonic())
        tables, found = find_tables(watcher, view, self.known), {}
        if self.buses:
            found["buses"] = tables.buses
        if self.as_json and tables.branches is not None:
            found["branches"] = tables.branches
        if self.meters:
            found["meters"] = worst_first(Table("meters", tables.meters))
        summary = summarise(tables, self.known)
        now = time.time()
        return view, found, self._onsets.date(find_causes(view, now, summary), now), summary

    @cached_property
    def _onsets(self) -> Onsets:
        from coordinator.watch.observe.causes import Onsets

        return Onsets()

    def write(self, watcher: Watcher) -> str:
        """The view as text, or as JSON in a line."""
        view, tables, causes, summary = self.find(watcher)
        if self.as_json:
            from coordinator.watch.observe import view_json

            of_all = {"causes": view_json.describe_causes(causes), "summary": view_json.describe_summary(summary)}
            described = of_all | view_json.describe_view(view) | view_json.describe_tables(tables)
            return json.dumps({"time": time.time(), **described})
        from coordinator.watch.observe.view_text import format_view

        return format_view(view, tables.values(), causes, summary)


def _show_on(look: Callable[[], Watcher], shown: Shown, *, live: bool) -> None:
    """Show the views of ``look`` until Ctrl-C, or until the reader of standard output has closed it."""
    if live:
        from coordinator.watch.observe.view_text import live_view

        with live_view() as update:
            while True:
                view, tables, causes, summary = shown.find(look())
                update(view, tables.values(), causes, summary)
    next_line = 0.0
    while True:
        watcher = look()
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + LINE_S
            if not show(shown.write(watcher)):
                return


@command(INSPECT, serves=True, short_help="Serve /metrics, /health and /ready of a running system over HTTP.")
@click.option("--listen", default=DEFAULT_LISTEN, show_default=True, metavar="HOST:PORT", help="Where to answer.")
@click.option(
    "--name",
    "names",
    multiple=True,
    metavar="NAME[:PORT]",
    help="Name under which it is asked, also of a proxy, beside its addresses; repeatable.",
)
@connect_option()
@direct_option
@keys_option
@run_option
@optional_scenario_argument
def metrics(
    scenario: str | None,
    listen: str,
    names: tuple[str, ...],
    endpoints: tuple[str, ...],
    direct: bool,
    keys: Path | None,
    run_id: str | None,
) -> int:
    """Watch the areas of a running system and serve what is seen to Prometheus, until Ctrl-C.

    SCENARIO adds loading, currents and powers, and its limits of operation.

    /health answers 200 while the bus is reachable, /ready while every area that was ever seen shows a fresh state, else
    503 with the reasons. Beyond loopback it is asked for by an address in digits, or by a --name.

    \b
    Examples:  dsse metrics
               dsse metrics ieee33
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
    known = _load_grid(scenario)
    areas = frozenset(area.name for area in known.partition.areas) if known else None
    with MetricsPage(*parse_listen(listen, DEFAULT_LISTEN), names, known) as page:
        serve_metrics(page, lambda: attach(address, areas=areas), renews=keys is not None)
    return 0
