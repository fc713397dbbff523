"""The commands ``dsse record`` and ``dsse replay``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.command import INSPECT, command, removed_option
from coordinator.cli.figure_options import asked_for_formats, figure_options, given_arguments
from coordinator.cli.live.address import address_options
from coordinator.cli.outputs import check_parquet_option, parquet_option, write_files
from coordinator.cli.terminal import (
    DEFAULT_ENDPOINT,
    Number,
    answer,
    json_option,
    notify,
    optional_scenario_argument,
    quiet_option,
)
from coordinator.watch.interrupts import end_orderly_on_signals
from coordinator.watch.observe.run_address import RunAddress
from coordinator.watch.run_folder import result_folder

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from agents.messages.packing import StateMessage
    from coordinator.watch.replay.ticks import Tick

PARTS_CODE = 5  # of a replay that agrees where the recording has gaps
LINE_S = 1.0  # between two lines of progress
ABOVE_ZERO = Number(min=0, min_open=True)


@command(INSPECT, serves=True, short_help="Record what a running system uses and shows.")
@address_options
@click.option("--out", type=click.Path(path_type=Path), help="Folder, new or of this run.  [default: recordings/RUN]")
@click.option("--limit-gb", type=ABOVE_ZERO, metavar="GB", help="Remove the oldest hours beyond so many GiB.")
@optional_scenario_argument
@removed_option("--scenario", "give the scenario without an option: dsse record SCENARIO")
def record(address: RunAddress, out: Path | None, limit_gb: float | None, scenario: str | None) -> int:
    """Record readings, states, commands and presence of a running system until Ctrl-C: a log that survives kill -9.

    With SCENARIO, from which the areas were split, it has kV, kW and A, and can be replayed.

    What has ended, each hour, becomes Parquet: readings, states, buses, branches, events. Start it again in the same
    folder after a crash: it goes on there.

    \b
    Examples:  dsse record ieee33
               dsse record --connect tcp/192.0.2.7:7447 --out /var/lib/dsse --limit-gb 20
    """
    from agents.runtime.log import start_log
    from coordinator.lab.deployment.split import area_files
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.watch.observe.attachment import join_run
    from coordinator.watch.recording.bus_recorder import record_from
    from coordinator.watch.recording.folder import RecordingOrder
    from coordinator.watch.recording.parquet import has_parquet
    from dsse_core.files.installation import install_command

    start_log()
    prepared = None if scenario is None else choose_scenario(scenario)
    with join_run(address) as (session, run):
        folder = out or Path("recordings") / run
        files = [] if prepared is None else area_files(prepared, run, [DEFAULT_ENDPOINT])

        def on_begun() -> None:
            notify(f"recording run {run} into {folder}; Ctrl-C ends it")
            if not has_parquet():
                notify(f"note: pyarrow is not installed, so the logs stay logs; {install_command('parquet')}")

        record_from(session, RecordingOrder(folder, run, files, limit_gb), on_begun)
    return 0


@command(
    INSPECT,
    codes={
        0: "all good states came out again",
        1: "some did not",
        PARTS_CODE: "those of a part did; the other scans were left out, or are lost",
    },
    short_help="Play a recording back.",
)
@click.argument("folder", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option("--processes", is_flag=True, help="On a router and agents of its own instead of the simulator.")
@click.option(
    "--speed", type=ABOVE_ZERO, metavar="X", help="So many times as fast as recorded.  [default: as fast as it goes]"
)
@optional_scenario_argument
@removed_option("--scenario", "give the scenario without an option: dsse replay FOLDER SCENARIO")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write the tables of all scans here.")
@parquet_option
@figure_options
@quiet_option
@json_option
def replay(
    folder: Path,
    processes: bool,
    speed: float | None,
    scenario: str | None,
    out: Path | None,
    parquet: bool,
    formats: tuple[str, ...] | None,
    quiet: bool,
    as_json: bool,
) -> int:
    """Play the readings in FOLDER, as they were used, to the same areas again, and compare what they make of them.

    On the simulator the states are those that were recorded, to the bit; of processes, within 1e-9. Scans of which
    readings are missing are named and left out. SCENARIO: its areas instead of the recorded ones. DIR gets the tables
    of `dsse run` with the rows of all scans, and a report; that needs SCENARIO.

    \b
    Examples:  dsse replay recordings/ieee33
               dsse replay recordings/ieee33 --processes --speed 10
               dsse replay recordings/ieee33 ieee33 --out day
    """
    from coordinator.lab.evaluation.answers import replay_as_json
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.evaluation.replayed_scans import ReplayedScans
    from coordinator.lab.stages.play import play_on_processes, play_on_simulator
    from coordinator.watch.replay.replay import format_replay

    end_orderly_on_signals()
    other = None if scenario is None else choose_scenario(scenario)
    play = play_on_processes if processes else play_on_simulator
    began = time.monotonic()
    check_parquet_option(parquet)
    if out is None and (parquet or asked_for_formats()):
        raise click.UsageError(f"--{'parquet' if parquet else 'format'} writes files; say where with --out DIR")
    if out is not None and other is None:
        raise click.UsageError("--out: tables are of a whole grid; name it: dsse replay FOLDER SCENARIO --out DIR")
    with nullcontext() if out is None else result_folder(out):
        scans = None if other is None or out is None else ReplayedScans(other)
        progress = None if quiet else _Progress()

        def on_scan(tick: Tick, states: Mapping[str, StateMessage]) -> None:
            if progress is not None:
                progress.show(tick)
            if scans is not None:
                scans.take(tick, states)

        found = play(folder, other, speed, on_scan)
        if other is not None and out is not None and scans is not None:
            write_files(out, parquet, scans.tables, replay_as_json(other, found.as_json()))
            if formats is not None:
                from coordinator.show.report.scan_report import write_scan_report

                write_scan_report(out, other, scans.tables, formats, given_arguments())
    text = format_replay(found, "processes" if processes else "the simulator", time.monotonic() - began)
    answer(as_json, found.as_json(), text)
    if not found.agrees:
        return 1
    return 0 if found.is_whole else PARTS_CODE


class _Progress:
    """Prints a line of progress every LINE_S."""

    def __init__(self) -> None:
        self._next = time.monotonic() + LINE_S
        self._scans = 0

    def show(self, tick: Tick) -> None:
        self._scans += 1
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + LINE_S
            notify(f"{self._scans} scans, the last is {tick.scan}")
