"""``dsse scenarios``: the shipped scenarios, listed, shown, or copied to be changed."""

from __future__ import annotations

from pathlib import Path

import click

from coordinator.cli.terminal import next_run, show
from dsse_core.printable import printable


@click.group(name="scenarios", invoke_without_command=True)
@click.pass_context
def scenarios_commands(context: click.Context) -> None:
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
    for name, description in listed:
        show(f"{name:{width}}  {printable(description)}")


@scenarios_commands.command(name="show", short_help="Print the file of a shipped scenario.")
@click.argument("name")
def show_scenario(name: str) -> None:
    """Print the commented file of the shipped scenario NAME.

    \b
    Example:  dsse scenarios show ieee33
    """
    from scenarios.files.shipped_files import find_scenario

    show(find_scenario(name).read_text(encoding="utf-8").rstrip("\n"))


@scenarios_commands.command(short_help="Copy a shipped scenario with its network into a folder.")
@click.argument("name")
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
def copy(name: str, folder: Path) -> None:
    """Copy the shipped scenario NAME to DIR/NAME.toml and its network to DIR/network.toml; files there stay.

    \b
    Example:  dsse scenarios copy ieee33 my && dsse run my/ieee33.toml
    """
    from scenarios.files.shipped_files import copy_scenario

    show(printable(next_run(copy_scenario(name, folder))))
