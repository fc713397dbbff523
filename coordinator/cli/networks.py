"""Commands about networks and scenarios: ``dsse partition``, ``generate``, ``import`` and ``scenarios``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from coordinator.cli.command import STUDY, TRY, Command, command, group, removed_option
from coordinator.cli.terminal import Number, answer, json_option, next_run, scenario_argument, show
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LARGEST_SEED
from dsse_core.printable import printable

PICTURES = (".png", ".pdf", ".svg")
BUSES_OF_AN_AREA = 10  # the areas of a generated feeder, unless a number is given
MAX_DEFAULT_AREAS = 8
TWO_CUTS = "--areas and --switches are two ways to cut; give one of them"


folder_option = click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="DIR",
    required=True,
    help="Folder for network.toml, scenario.toml.",
)


@command(STUDY, short_help="Show the areas of a scenario, or try others.")
@scenario_argument
@click.option("--areas", "count", type=click.IntRange(min=1), help="Cut into so many areas instead.")
@removed_option("--count", "--areas N says into how many areas to cut")
@click.option(
    "--switches", multiple=True, metavar="BRANCHES", help="Cut at these branches instead: 6-7,6-26; repeatable."
)
@click.option("--out", type=click.Path(path_type=Path), help="Draw the areas into this file (.png, .pdf, .svg).")
@click.option("--toml", is_flag=True, help="Print the areas as bus lists, to paste into a scenario file.")
@json_option
def partition(
    scenario: str, count: int | None, switches: tuple[str, ...], out: Path | None, toml: bool, as_json: bool
) -> None:
    """Show the areas of SCENARIO, or those that another cut of its network makes: table, picture or bus lists.

    \b
    Examples:  dsse partition ieee33 --out areas.png
               dsse partition ieee33 --areas 5 --toml
               dsse partition ieee33 --switches 6-7,6-26
    """
    if count is not None and switches:
        raise click.UsageError(TWO_CUTS)
    if out is not None and out.suffix.lower() not in PICTURES:
        raise InvalidInputError("--out", [f"{out} has none of the endings {', '.join(PICTURES)}; give it one"])
    from agents.strategies.installed import list_strategies
    from coordinator.show.report.area_table import format_area_tables, format_areas
    from scenarios.scenario import load_scenario

    changes: dict[str, object] = {}
    if count is not None:
        changes = {"areas": {"count": count}, "faults": {}}
    elif switches:
        changes = {"areas": {"switches": _list_names(switches)}, "faults": {}}
    loaded = load_scenario(scenario, strategies=list_strategies(), changes=changes)
    areas = loaded.partition.listed
    text = format_area_tables(loaded.partition) if toml else format_areas(loaded)
    answer(as_json, {"network": loaded.network.name, "areas": areas, "picture": out}, text)
    if out is not None:
        from coordinator.show.figures.draw_areas import draw_areas

        out.parent.mkdir(parents=True, exist_ok=True)
        draw_areas(loaded.partition, out)
        if not (toml or as_json):
            show(f"picture: {out}")


@command(STUDY, short_help="Make up a radial feeder and a scenario on it.")
@click.option(
    "--buses", "n_bus", type=click.IntRange(min=2, max=1_000_000), metavar="N", required=True, help="How many buses."
)
@folder_option
@click.option(
    "--seed",
    type=click.IntRange(min=0, max=LARGEST_SEED),
    default=1,
    show_default=True,
    help="Another seed, another feeder.",
)
@click.option(
    "--areas", "n_area", type=click.IntRange(min=1), help="How many areas.  [default: one per 10 buses, up to 8]"
)
@click.option(
    "--lowest-vm", type=float, default=0.94, show_default=True, metavar="PU", help="The load is scaled until this."
)
@click.option(
    "--meters",
    type=click.Choice(["standard", "sparse"]),
    default="standard",
    show_default=True,
    help="standard: flows on all branches; sparse: where trunks and laterals begin.",
)
@click.option("--pv", "n_pv", type=click.IntRange(min=0), default=0, show_default=True, help="How many PV generators.")
@json_option
def generate(
    n_bus: int,
    out: Path,
    seed: int,
    n_area: int | None,
    lowest_vm: float,
    meters: Literal["standard", "sparse"],
    n_pv: int,
    as_json: bool,
) -> None:
    """Make up a radial medium-voltage feeder with typical values, and a scenario that runs on it.

    The same options write the same files. docs/how-to/generate.md says which values are typical.

    \b
    Example:  dsse generate --buses 200 --seed 7 --areas 6 --out feeder && dsse run feeder/scenario.toml
    """
    from scenarios.files.saved_network import name_network_file
    from scenarios.generate.generated_files import write_generated

    network_file = name_network_file(n_bus)
    if present := [name for name in (network_file, "scenario.toml") if (out / name).exists()]:
        raise InvalidInputError(
            f"folder {out}", [f"{name} is there already; choose another folder" for name in present]
        )
    if n_area is None:
        n_area = min(MAX_DEFAULT_AREAS, max(1, n_bus // BUSES_OF_AN_AREA))
    path = write_generated(out, n_bus, seed, n_area=n_area, lowest_vm=lowest_vm, n_pv=n_pv, meters=meters)
    files = [out / network_file, path]
    answer(as_json, {"files": files, "scenario": path}, "\n".join([*map(str, files), next_run(path)]))


@command(STUDY, "import", short_help="Take over a network of MATPOWER, OpenDSS, pandapower, power-grid-model.")
@click.argument("file", type=click.Path(path_type=Path))
@folder_option
@click.option("--areas", "n_area", type=click.IntRange(min=1), help="How many areas.  [default: 1]")
@click.option(
    "--switches", multiple=True, metavar="BRANCHES", help="Cut at these branches instead, ids or names; repeatable."
)
@click.option("--name", help="Name of the network.  [default: its own, else that of the file]")
@click.option(
    "--frequency",
    "frequency_hz",
    type=Number(min=0, min_open=True),
    default=50.0,
    show_default=True,
    metavar="HZ",
    help="For power-grid-model, whose files do not hold it.",
)
@click.option(
    "--within",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="For OpenDSS: FILE may name files in DIR.  [default: its own folder]",
)
@json_option
def import_file(
    file: Path,
    out: Path,
    n_area: int | None,
    switches: tuple[str, ...],
    name: str | None,
    frequency_hz: float,
    within: Path | None,
    as_json: bool,
) -> None:
    """Take over FILE as a scenario: a MATPOWER case (.m), an OpenDSS circuit (.dss), a pandapower network or
    power-grid-model input (.json).

    Writes network.toml (or .json, if large), scenario.toml, import.txt and, where FILE has measurements, readings.csv.

    \b
    Example:  dsse import case33bw.m --areas 4 --out bw && dsse run bw/scenario.toml
    """
    if n_area is not None and switches:
        raise click.UsageError(TWO_CUTS)
    from scenarios.importers import import_grid
    from scenarios.importers.imported_files import write_imported

    cut = _list_names(switches) or n_area or 1
    imported = import_grid(file, name=name, frequency_hz=frequency_hz, within=within)
    path, summary = write_imported(out, imported, cut, lambda scenario: _check(scenario, file))
    answer(as_json, {"summary": summary, "scenario": path}, f"{summary}\n{next_run(path)}")


def _list_names(given: tuple[str, ...]) -> list[str]:
    return [name.strip() for text in given for name in text.split(",") if name.strip()]


def _check(path: Path, source: Path) -> None:
    """Check the scenario written from ``source``.

    Raises:
        InvalidInputError: it cannot be estimated, as for a source with too few measurements."""
    from agents.strategies.installed import list_strategies
    from coordinator.lab.strategy_check import check_with_strategy
    from scenarios.scenario import load_scenario

    try:
        check_with_strategy(load_scenario(path, strategies=list_strategies()))
    except InvalidInputError as error:
        raise InvalidInputError(f"{source} is read, but cannot be estimated as it is", error.problems) from None


@group(TRY, "scenarios", invoke_without_command=True)
@json_option
@click.pass_context
def scenarios_commands(context: click.Context, as_json: bool) -> None:
    """List the shipped scenarios, show one, or copy one to change it.

    \b
    Examples:  dsse scenarios
               dsse scenarios show ieee33
               dsse scenarios copy ieee33 my
    """
    if context.invoked_subcommand is not None:
        return
    from scenarios.scenario import list_scenarios

    listed = list_scenarios()
    width = max(len(name) for name, _ in listed)
    lines = [f"{name:{width}}  {printable(description)}" for name, description in listed]
    answer(as_json, {"scenarios": dict(listed)}, "\n".join(lines))


@scenarios_commands.command(name="show", cls=Command, part=TRY, short_help="Print the file of a shipped scenario.")
@click.argument("name")
@json_option
def show_scenario(name: str, as_json: bool) -> None:
    """Print the commented file of the shipped scenario NAME.

    \b
    Example:  dsse scenarios show ieee33
    """
    from dsse_core.files.bounded_parsing import parse_toml
    from scenarios.files.shipped_files import find_scenario

    text = find_scenario(name).read_text(encoding="utf-8")
    answer(as_json, parse_toml(text), text.rstrip("\n"))


@scenarios_commands.command(cls=Command, part=TRY, short_help="Copy a shipped scenario with its network into a folder.")
@click.argument("name")
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@json_option
def copy(name: str, folder: Path, as_json: bool) -> None:
    """Copy the shipped scenario NAME to DIR/NAME.toml and its network to DIR/network.toml; files there stay.

    \b
    Example:  dsse scenarios copy ieee33 my && dsse run my/ieee33.toml
    """
    from scenarios.files.shipped_files import copy_scenario

    path = copy_scenario(name, folder)
    answer(as_json, {"scenario": path}, printable(next_run(path)))
