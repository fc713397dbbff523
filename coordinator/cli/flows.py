"""The command ``dsse flows``: flows in one area of a running system, in the units of engineers."""

from __future__ import annotations

import json
import time
from pathlib import Path

import click

from coordinator.cli.command import INSPECT, command
from coordinator.cli.terminal import connect_option, json_option, keys_option, notify, show, wait_option
from coordinator.watch.interrupts import end_orderly_on_signals
from dsse_core.endpoints import add_protocol

TABLES = ("buses", "branches")


@command(
    INSPECT,
    codes={1: "the area has published no estimate"},
    short_help="Show what flows in one area of a running system.",
)
@click.argument("area_file", type=click.Path(path_type=Path))
@connect_option(default="[default: where the area file says]")
@keys_option
@json_option
@click.option("--csv", type=click.Choice(TABLES), metavar="TABLE", help=f"Print one as CSV: {', '.join(TABLES)}.")
@wait_option
def flows(
    area_file: Path, endpoints: tuple[str, ...], keys: Path | None, as_json: bool, csv: str | None, timeout: float
) -> int:
    """Show voltages, flows in kW and A, losses and loading of the area of AREA_FILE, as it estimates them now.

    They follow from the voltages that the area publishes and from the network in AREA_FILE (`dsse split`).

    \b
    Examples:  dsse flows areas/area1.toml
               dsse flows areas/area1.toml --csv branches
    """
    if as_json and csv:
        raise click.UsageError("--json and --csv both print on standard output; give one of them")
    from agents.area_files.reader import load_area_file
    from agents.strategies.installed import list_strategies
    from coordinator.show.report.grid_text import format_state
    from coordinator.watch.observe.area_flows import make_area_flows
    from coordinator.watch.observe.attachment import attach, wait_for_state
    from coordinator.watch.observe.run_address import RunAddress
    from coordinator.watch.tables import rows_as_json

    end_orderly_on_signals()
    content = load_area_file(area_file, list_strategies())
    name, direct = content.area.name, bool(content.listen)
    given = add_protocol(endpoints, secured=keys is not None)
    chosen = given or (content.listen if direct else content.endpoints)
    with attach(RunAddress(chosen, content.run, timeout, keys, direct), areas=frozenset({name})) as look:
        watcher = wait_for_state(look, name, timeout)
    view = next((area for area in watcher.look(time.monotonic()).areas if area.name == name), None)
    state = watcher.state_of(name)
    if view is None or state is None or not state.buses:
        notify(f"area {name} of run {content.run} has published no estimate within {timeout:g} s")
        return 1
    buses, branches = make_area_flows(content.area, state, view.freshness)
    summary = f"area {name}: {view.quality}, scan {view.scan}, {view.age_s:.1f} s old"
    lines = [summary, *(f"note: {note}" for note in view.notes)]
    if as_json:
        about = {"time": time.time(), "run": content.run, "area": name, "quality": view.quality, "scan": view.scan}
        about |= {"age_s": view.age_s, "notes": view.notes}
        show(json.dumps(about | {"buses": rows_as_json(buses), "branches": rows_as_json(branches)}, allow_nan=False))
    elif csv:
        show((buses if csv == "buses" else branches).to_csv().removesuffix("\n"))
        for line in lines:
            notify(line)
    else:
        show("\n\n".join([format_state(buses, branches), "\n".join(lines)]))
    return 0
