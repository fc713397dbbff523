"""The table of ``python -m benchmarks.commands``."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from benchmarks.commands.inputs import BUSES_OF_AN_AREA, SEED, count_areas
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine

STEEPEST = 6.0
LEAST_GROWTH = 0.05  # from the first of three points to the second, of the first: less is chance
PACKAGES = ("numpy", "scipy", "pydantic", "numba", "consensus-dsse")
LEEWAY = 0.15  # of an exponent: its scatter on a machine with other work


@dataclass(frozen=True, slots=True)
class Cost:
    """``cpu_s``: user and system time; ``peak_mib``: largest resident memory of one process."""

    cpu_s: float
    peak_mib: float


def measure(arguments: Sequence[str], folder: Path) -> Cost:
    """Run ``dsse`` with ``arguments`` in ``folder`` to its end.

    Raises:
        click.ClickException: it fails; with its last lines.
    """
    errors = folder / "errors.txt"
    with errors.open("w", encoding="utf-8") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "coordinator", *arguments],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=err,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        last = errors.read_text(encoding="utf-8", errors="replace")[-500:]
        raise click.ClickException(f"dsse {' '.join(arguments)} ended with {process.returncode}: {last}")
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def find_exponent(sizes: Sequence[int], figures: Sequence[float]) -> float | None:
    """The k of ``a + b n^k`` through the last three points, whose start-up ``a`` cancels; None if there is no such
    k.
    """
    if len(sizes) < 3 or len(sizes) != len(figures):
        return None
    (n1, n2, n3), (f1, f2, f3) = sizes[-3:], figures[-3:]
    if not (f1 * (1 + LEAST_GROWTH) < f2 < f3):
        return None
    wanted = (f3 - f2) / (f2 - f1)

    def ratio(k: float) -> float:
        return float((n3**k - n2**k) / (n2**k - n1**k))

    low, high = 1e-3, STEEPEST
    if not ratio(low) < wanted < ratio(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if ratio(middle) < wanted else (low, middle)
    return low


def find_n_log_n(sizes: Sequence[int]) -> float | None:
    """The exponent that ``n log n`` has through the same points."""
    return find_exponent(sizes, [n * math.log(n) for n in sizes])


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
    table = "\n".join(format_rows(costs))
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


def format_rows(costs: Mapping[str, Mapping[int, Cost]]) -> list[str]:
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
