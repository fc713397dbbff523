"""The table of ``python -m benchmarks.commands``."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import click

from benchmarks.commands.cost import Cost, measure
from benchmarks.commands.growth import find_exponent, find_n_log_n
from benchmarks.commands.sizes import BUSES_OF_AN_AREA, SEED, count_areas
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine

PACKAGES = ("numpy", "scipy", "pydantic", "numba", "consensus-dsse")
LEEWAY = 0.15  # of an exponent: its scatter on a machine with other work


@dataclass(frozen=True, slots=True)
class Command:
    """``arguments`` for a number of buses; ``share``: the command is measured at sizes divided by it."""

    arguments: Callable[[int], list[str]]
    share: int = 1


COMMANDS: Mapping[str, Command] = {
    "generate": Command(
        lambda n: ["generate", "--buses", str(n), "--seed", str(SEED), "--areas", str(count_areas(n)), "--out", "new"]
    ),
    "check": Command(lambda _: ["check", "scenario.toml"]),
    "powerflow": Command(lambda _: ["powerflow", "scenario.toml"]),
    "estimate": Command(lambda _: ["estimate", "scenario.toml"]),
    "estimate, readings in a file": Command(lambda _: ["estimate", "measured.toml"]),
    "partition": Command(lambda _: ["partition", "scenario.toml"]),
    "split": Command(lambda _: ["split", "scenario.toml", "--out", "new"]),
    "import": Command(lambda n: ["import", "case.m", "--areas", str(count_areas(n)), "--out", "new"]),
    "simulate": Command(lambda _: ["simulate", "scenario.toml", "--quiet", "--no-plots", "--out", "new"], share=10),
}


@click.command(context_settings={"show_default": True})
@click.option("--sizes", default="1000,10000,100000", help="Buses, in rising order; of simulate a tenth.")
@click.option("--only", help=f"Some of the commands, joined by commas: {'; '.join(COMMANDS)}.")
@click.option("--runs", type=click.IntRange(1), default=3, help="Runs of which the least counts.")
@click.option("--out", type=click.Path(path_type=Path), help="Write commands.md and commands.json there, too.")
@figures_option
def main(sizes: str, only: str | None, runs: int, out: Path | None, figures: str | None) -> None:
    """Processor time and memory of every command against the size of a generated feeder, with the exponent of growth.

    A feeder has an area for every 500 buses. The exponent k is that of a + b n^k through the last three sizes, so that
    the start of Python does not count.
    """
    asked = [int(size) for size in sizes.split(",")]
    chosen = {name: COMMANDS[name] for name in COMMANDS if only is None or name.split(",")[0] in only.split(",")}
    costs: dict[str, dict[int, Cost]] = {name: {} for name in chosen}
    for n_bus in sorted({n // command.share for n in asked for command in chosen.values()}):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            # in a process of its own: the memory of this process would count in the processes that it starts
            subprocess.run([sys.executable, "-m", "benchmarks.commands.inputs", str(folder), str(n_bus)], check=True)
            for key, command in chosen.items():
                if n_bus * command.share in asked:
                    costs[key][n_bus] = _measure_least(command, n_bus, folder, runs)
                    click.echo(f"{key}, {n_bus} buses: {costs[key][n_bus].cpu_s:.2f} s", err=True)
    machine = describe_machine(PACKAGES)
    table = "\n".join(_format_rows(costs))
    areas = f"Areas of {BUSES_OF_AN_AREA} buses. s of a processor / MiB; k of the last three sizes."
    text = "\n".join([*(f"- {name}: {value}" for name, value in machine.items()), "", areas, "", table])
    click.echo(text)
    if figures:
        write_section(figures, machine, table)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "commands.md").write_text(text + "\n", encoding="utf-8")
        rows = {key: {str(n): [c.cpu_s, c.peak_mib] for n, c in of.items()} for key, of in costs.items()}
        (out / "commands.json").write_text(json.dumps({"machine": machine, "commands": rows}, indent=1))


def _measure_least(command: Command, n_bus: int, folder: Path, runs: int) -> Cost:
    """Least time and least memory of ``runs`` runs; the first run fills the caches of files."""
    found = []
    for _ in range(runs):
        found.append(measure(command.arguments(n_bus), folder))
        shutil.rmtree(folder / "new", ignore_errors=True)
    return Cost(min(cost.cpu_s for cost in found), min(cost.peak_mib for cost in found))


def _format_rows(costs: Mapping[str, Mapping[int, Cost]]) -> list[str]:
    """A markdown table: time and memory at each size, the exponents, and a mark where growth is faster than n log n."""
    lines = [
        "| command | buses: s / MiB | k of time | k of memory | faster than n log n |",
        "|---|---|---|---|---|",
    ]
    for name, by_size in costs.items():
        sizes = list(by_size)
        cells = ", ".join(f"{n}: {cost.cpu_s:.2f} / {cost.peak_mib:.0f}" for n, cost in by_size.items())
        growth = [find_exponent(sizes, [getattr(c, key) for c in by_size.values()]) for key in ("cpu_s", "peak_mib")]
        allowed = find_n_log_n(sizes)
        too_fast = allowed is not None and any(k is not None and k > allowed + LEEWAY for k in growth)
        shown = " | ".join("-" if k is None else f"{k:.2f}" for k in growth)
        lines.append(f"| {name} | {cells} | {shown} | {'**yes**' if too_fast else 'no'} |")
    return lines
