"""The command ``dsse serve``: a page that shows a running system, or plays back a simulated run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from coordinator.cli.command import INSPECT, command
from coordinator.cli.live.address import address_options
from coordinator.cli.terminal import notify, optional_scenario_argument, set_option, show
from coordinator.watch.interrupts import end_orderly_on_signals
from coordinator.watch.observe.run_address import RunAddress
from dsse_core.errors import InvalidInputError

if TYPE_CHECKING:  # the real imports stand in the command, so that every other starts fast
    from collections.abc import Mapping

    from coordinator.show.web.sources import Source


@command(INSPECT, serves=True, short_help="Show a running system, or a simulated run, as a page in a browser.")
@optional_scenario_argument
@click.option("--simulate", "is_simulated", is_flag=True, help="Run SCENARIO on the simulator, and play that back.")
@click.option("--recording", type=click.Path(path_type=Path), help="Play what `dsse record` has put there, or results.")
@set_option
@click.option("--listen", default="127.0.0.1:8080", show_default=True, metavar="HOST:PORT", help="Where; port 0: any.")
@click.option("--tls-cert", type=click.Path(path_type=Path), help="Certificate (PEM), needed beyond loopback.")
@click.option("--tls-key", type=click.Path(path_type=Path), help="Its private key (PEM).")
@click.option(
    "--token-file",
    type=click.Path(path_type=Path),
    help="Keep the token here; made if missing.",
)
@click.option(
    "--name",
    "names",
    multiple=True,
    metavar="NAME[:PORT]",
    help="Name for browsers, or of a proxy; repeatable.",
)
@address_options
def serve(
    scenario: str | None,
    is_simulated: bool,
    recording: Path | None,
    changes: Mapping[str, object],
    listen: str,
    tls_cert: Path | None,
    tls_key: Path | None,
    token_file: Path | None,
    names: tuple[str, ...],
    address: RunAddress,
) -> int:
    """Serve a page: the feeder coloured by voltage, profile, meters, areas and their reasons, events, history.

    With SCENARIO, a shipped name or a file, the network is drawn and powers are shown; without it, what the bus tells.
    The page can only be read. Beyond loopback it needs a certificate, and a reader the token that is printed.
    Ctrl-C ends it and nothing else.

    \b
    Examples:  dsse serve
               dsse serve ieee33 --connect tcp/192.0.2.7:7447
               dsse serve ieee33-lossy --simulate
               dsse serve ieee33 --recording recordings/ieee33
               dsse serve ieee33 --recording day
    """
    if is_simulated and scenario is None:
        raise click.UsageError("--simulate runs a scenario; name one")
    if is_simulated and recording is not None:
        raise click.UsageError("--simulate and --recording are two things to play back; choose one")
    _check_packages()
    from coordinator.show.web.server import choose_place
    from coordinator.show.web.server import serve as serve_source

    place = choose_place(listen, tls_cert, tls_key, token_file, names)
    end_orderly_on_signals()
    try:
        if is_simulated:
            assert scenario is not None
            sources = _simulated(scenario, changes)
        elif recording is not None:
            sources = _recorded(recording, scenario, changes)
        else:
            sources = _live(scenario, changes, address)
        with sources as source:
            serve_source(source, place, names, lambda url: show(place.invite(url)))
    except KeyboardInterrupt:
        return 0
    return 0


def _check_packages() -> None:
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        from dsse_core.files.installation import install_command

        problem = f"{error.name} is not installed; {install_command('web')}"
        raise InvalidInputError("dsse serve", [problem]) from None


@contextmanager
def _simulated(scenario: str, changes: Mapping[str, object]) -> Iterator[Source]:
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.strategy_check import check_with_strategy
    from coordinator.show.web.playback.growing import GrowingPlayback

    chosen = check_with_strategy(choose_scenario(scenario, changes=changes))
    notify(f"simulating {scenario}; the page plays it as far as it is computed ...")
    source = GrowingPlayback(chosen, lambda: notify(f"{scenario} is simulated: all of it can be played"))
    source.start()
    try:
        yield source
    finally:
        source.close()


@contextmanager
def _recorded(folder: Path, scenario: str | None, changes: Mapping[str, object]) -> Iterator[Source]:
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.show.web.playback.source import play_recording

    notify(f"reading {folder} ...")
    notes: list[str] = []
    source = play_recording(folder, choose_scenario(scenario, changes=changes) if scenario else None, notes)
    for note in dict.fromkeys(notes):
        notify(f"note: {note}")
    yield source


@contextmanager
def _live(scenario: str | None, changes: Mapping[str, object], address: RunAddress) -> Iterator[Source]:
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.show.web.sources import LiveSource
    from coordinator.watch.observe.attachment import attach
    from coordinator.watch.observe.grid_tables import GridTables

    known = GridTables(choose_scenario(scenario, changes=changes)) if scenario else None
    areas = frozenset(area.name for area in known.partition.areas) if known else None
    with attach(address, areas=areas) as look:
        source = LiveSource(look, known, look(0.0).run)
        source.start()
        try:
            yield source
        finally:
            source.close()
