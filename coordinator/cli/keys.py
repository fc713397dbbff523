"""``dsse keys``: certificates and private keys of a deployment."""

from __future__ import annotations

from pathlib import Path

import click

from coordinator.cli.terminal import Number, notify, run_id_option, scenario_argument, show
from dsse_core.printable import printable

YEAR_DAYS = 365.0
LONGEST_DAYS = 36500.0


@click.group(name="keys")
def keys_commands() -> None:
    """Certificates and private keys, for --keys and `dsse run --secure`.

    \b
    Example:  dsse keys create ieee33 --out keys
    """


@keys_commands.command(short_help="Make a private authority and the keys of every process.")
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
def create(scenario: str, out: Path, days: float, hosts: tuple[str, ...], run_id: str | None) -> None:
    """Make a private authority, a certificate for each process of SCENARIO, and the rules of who may publish.

    \b
    Examples:  dsse keys create ieee33 --out keys
               dsse keys create ieee33 --host grid-a.example --host 192.0.2.7
               dsse keys create my/neighbours.toml --host area1=grid-a.example
    """
    from coordinator.lab.deployment.certificates import create_keys
    from coordinator.lab.deployment.run_access import access_of
    from coordinator.watch.observe.run_address import choose_run_id
    from scenarios.reading_rules import find_gateway_remark
    from scenarios.scenario import load_scenario

    loaded = load_scenario(scenario)
    access = access_of(loaded.partition, choose_run_id(loaded, run_id), loaded.reading_rules)
    create_keys(out, access, days, hosts, direct=loaded.transport.kind == "neighbours")
    show(printable(f"{out}: keys of {', '.join(access.names)}, valid for {days:g} days"))
    authority = printable(out / "authority.key")
    show(f"keep {authority} off the hosts; each needs authority.crt and its own processes' .crt and .key")
    if remark := find_gateway_remark(loaded.reading_rules):
        notify(f"warning: {remark}, then make the keys anew")
