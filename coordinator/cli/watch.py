"""The command ``dsse watch``: attach to a running system and show it."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.terminal import (
    bus_timeout_option,
    choose_endpoints,
    connect_option,
    keys_option,
    show,
)
from coordinator.interrupts import end_orderly_on_signals

if TYPE_CHECKING:  # the real imports stand in the command, so that every other starts fast
    from coordinator.observe.watch import View

UPDATE_S = 0.2
LINE_S = 1.0  # between two lines where there is no terminal


@click.command(short_help="Watch a running system from outside.")
@connect_option()
@click.option("--direct", is_flag=True, help="There is no router: link with the endpoint of every area.")
@keys_option
@click.option(
    "--run", "run_id", help="Name of the run.  [default: the only one on the bus; with --keys the one named there]"
)
@click.option("--once", is_flag=True, help="Show it once, when all areas that are there have been received, and end.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
@bus_timeout_option
def watch(
    endpoints: tuple[str, ...],
    direct: bool,
    keys: Path | None,
    run_id: str | None,
    once: bool,
    as_json: bool,
    timeout: float,
) -> int:
    """Watch the areas of a running system, started by any command: what they estimate, receive and lack.

    Ctrl-C ends the watching and nothing else. Exit code 1: with --once, no area was received.

    \b
    Examples:  dsse watch
               dsse watch --connect tcp/192.0.2.7:7447 --once --json
    """
    from coordinator.cli.watch_session import attach, wait_until_whole

    end_orderly_on_signals()
    try:
        with attach(choose_endpoints(endpoints, keys is not None), run_id, timeout, keys, direct) as look:
            if once:
                watcher = wait_until_whole(look, timeout)
                show(_format(watcher.look(time.monotonic()), as_json))
                return 0 if watcher.is_whole() else 1
            live = sys.stdout.isatty() and not as_json
            _show_on(lambda: look(UPDATE_S).look(time.monotonic()), live, as_json)
            return 0
    except KeyboardInterrupt:
        return 0


def _show_on(look: Callable[[], View], live: bool, as_json: bool) -> None:
    """Go on showing what ``look`` sees, until Ctrl-C or until nobody reads it any more."""
    if live:
        from coordinator.observe.live import live_view

        with live_view() as update:
            while True:
                update(look())
    next_line = 0.0
    while True:
        view = look()
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + LINE_S
            if not show(_format(view, as_json)):
                return


def _format(view: View, as_json: bool) -> str:
    if as_json:
        areas = {area.name: {"state": area.state} | asdict(area) for area in view.areas}
        for area in areas.values():
            del area["name"]
        about = {"others": view.others, "duplicates": view.duplicates, "other_versions": view.other_versions}
        return json.dumps({"time": time.time(), "run": view.run, **about, "areas": areas})
    from coordinator.observe.live import format_view

    return format_view(view)
