"""The command ``dsse gateway``: readings of meters in the field to the bus, results back."""

from __future__ import annotations

from pathlib import Path

import click

from coordinator.cli.command import OPERATE, command
from coordinator.cli.terminal import Number, answer, choose_endpoints, connect_option, keys_option, wait_option


@command(
    OPERATE,
    codes={1: "with --check: something looks wrong", 3: "a newer gateway of this name runs"},
    serves=True,
    short_help="Publish what meters in the field read, and pass results on.",
)
@click.argument("map_file", metavar="MAP", type=click.Path(path_type=Path))
@connect_option(default="[default: where MAP says]")
@keys_option
@wait_option
@click.option("--check", is_flag=True, help="Publish nothing: read for a while and say what looks wrong.")
@click.option(
    "--seconds",
    type=Number(min=0.1, max=3600.0),
    default=5.0,
    show_default=True,
    metavar="S",
    help="With --check: read for so long.",
)
@click.option(
    "--status-file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write there in JSON, every second, what became of the readings.",
)
@click.option("--json", "as_json", is_flag=True, help="With --check: print one JSON object instead.")
def gateway(
    map_file: Path,
    endpoints: tuple[str, ...],
    keys: Path | None,
    timeout: float,
    check: bool,
    seconds: float,
    status_file: Path | None,
    as_json: bool,
) -> int:
    """Read meters as MAP says, from a CSV file, JSON lines, MQTT, OPC UA, Modbus or a source of your own, and publish
    the newest reading of each until Ctrl-C. MAP gives address, meter and unit of each reading.

    \b
    Examples:  dsse gateway map.toml --check
               dsse gateway map.toml --connect tcp/192.0.2.7:7447
    """
    from coordinator.field.gateway.maps.map_file import load_map
    from coordinator.lab.deployment.endpoints import known_area_endpoints

    content = load_map(map_file)
    if check:
        from coordinator.field.gateway.check import check_map

        report = check_map(content, seconds)
        answer(
            as_json, {"is_sound": report.is_sound, "problems": report.problems, "remarks": report.remarks}, report.text
        )
        return 0 if report.is_sound else 1
    if as_json:
        raise click.UsageError("--json prints the report of --check; a gateway that publishes has none")
    from coordinator.field.gateway.gateway import run_gateway

    direct = content.scenario.transport.kind == "neighbours"
    endpoints = endpoints or content.endpoints
    if direct and not endpoints:
        endpoints = tuple(known_area_endpoints(content.scenario, "tls" if keys else "tcp").values())
    return run_gateway(content, choose_endpoints(endpoints, keys is not None), timeout, keys, status_file, direct)
