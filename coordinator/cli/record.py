"""The commands ``dsse record`` and ``dsse replay``."""

from __future__ import annotations

from pathlib import Path

import click

from coordinator.cli.terminal import (
    DEFAULT_ENDPOINT,
    Number,
    bus_timeout_option,
    choose_endpoints,
    connect_option,
    keys_option,
    say,
)

GIGABYTES = Number(min=0, min_open=True)


@click.command(short_help="Record what a running system uses and shows.")
@connect_option()
@click.option("--direct", is_flag=True, help="There is no router: link with the endpoint of every area.")
@keys_option
@click.option("--run", "run_id", help="Name of the run.  [default: the only one; with --keys the one named there]")
@click.option("--out", type=click.Path(path_type=Path), help="Folder, new or of this run.  [default: recordings/RUN]")
@click.option("--limit-gb", type=GIGABYTES, metavar="GB", help="Remove the oldest hours beyond so many GiB.")
@click.option("--scenario", metavar="NAME|FILE", help="What the areas were split from: adds kV, kW, A, and replay.")
@bus_timeout_option
def record(
    endpoints: tuple[str, ...],
    direct: bool,
    keys: Path | None,
    run_id: str | None,
    out: Path | None,
    limit_gb: float | None,
    scenario: str | None,
    timeout: float,
) -> int:
    """Record readings, states, commands and presence of a running system until Ctrl-C: a log that survives kill -9.

    What has ended, each hour, becomes Parquet: readings, states, buses, branches, events. Start it again in the same
    folder after a crash: it goes on there.

    \b
    Examples:  dsse record --scenario ieee33
               dsse record --connect tcp/192.0.2.7:7447 --out /var/lib/dsse --limit-gb 20
    """
    from agents.runtime.log_format import start_log
    from coordinator.cli.watch_session import join_run
    from coordinator.deployment.split import area_files
    from coordinator.evaluation.evaluation import choose_scenario
    from coordinator.recording.bus_recorder import Order, record_from
    from coordinator.recording.parquet import has_parquet

    start_log()
    prepared = None if scenario is None else choose_scenario(scenario)
    with join_run(choose_endpoints(endpoints, keys is not None), run_id, timeout, keys, direct) as (session, run):
        folder = out or Path("recordings") / run
        files = [] if prepared is None else area_files(prepared, run, [DEFAULT_ENDPOINT])
        say(f"recording run {run} into {folder}; Ctrl-C ends it")
        if not has_parquet():
            say("note: pyarrow is not installed, so the logs stay logs; pip install 'consensus-dsse[parquet]'")
        record_from(session, Order(folder, run, files, limit_gb))
    return 0
