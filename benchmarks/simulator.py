"""``python -m benchmarks.simulator``: growth of an area's messages with the number of areas, on the simulator."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine

SEED = 1
PACKAGES = ("numpy", "scipy", "numba", "consensus-dsse")
HEADER = (
    "| areas | buses | consensus | gap vm p.u. | gap va deg | last change, virtual ms "
    "| boundary messages of an area: median, most | all its messages: median, most | its bytes: median, most "
    "| CPU s | of it per area, ms | memory MiB |"
)


@dataclass(frozen=True)
class SimulatorRun:
    """One run: its ``result.json``, and processor time and memory of the process."""

    n_area: int
    n_bus: int
    result: dict[str, Any]
    cpu_s: float
    memory_mib: float

    def as_row(self) -> str:
        """Row of the table under HEADER."""
        verdict, areas = self.result["verdict"], self.result["areas"].values()
        counts = " | ".join(
            _median_and_most([area[key] for area in areas]) for key in ("exchanges", "messages", "bytes")
        )
        gaps = (
            f"{verdict['gap_vm_pu']:.1e} | {verdict['gap_va_deg']:.1e}" if verdict["gap_vm_pu"] is not None else "- | -"
        )
        last_change_ms = self.result["timing_s"]["last_change"] * 1000
        consensus = "yes" if verdict["consensus"] else "no"
        return (
            f"| {self.n_area} | {self.n_bus} | {consensus} | {gaps} | {last_change_ms:.0f} "
            f"| {counts} | {self.cpu_s:.0f} | {1000 * self.cpu_s / self.n_area:.0f} | {self.memory_mib:.0f} |"
        )


@click.command(context_settings={"show_default": True})
@click.option("--areas", type=click.IntRange(2), multiple=True, default=(100, 1000), help="May be given several times.")
@click.option("--buses", type=click.IntRange(2), default=100, help="Of an area.")
@click.option("--meters", type=click.Choice(["standard", "sparse"]), default="sparse", help="As for `dsse generate`.")
@click.option("--timeout", "timeout_s", type=float, default=120.0, help="Virtual s, of each run.")
@click.option("--delay-ms", type=float, default=1.0, help="Of a message, virtual.")
@figures_option
def main(areas: Sequence[int], buses: int, meters: str, timeout_s: float, delay_ms: float, figures: str | None) -> None:
    """Generate a feeder for each number of areas, run `dsse simulate` on it and print a Markdown table."""
    machine = describe_machine(PACKAGES)
    for name, text in machine.items():
        click.echo(f"{name}: {text}")
    lines = [HEADER, f"|{'---|' * (HEADER.count('|') - 1)}"]
    click.echo("\n" + "\n".join(lines))
    for n_area in areas:
        lines.append(_run(n_area, buses, meters, timeout_s, delay_ms).as_row())
        click.echo(lines[-1])
    if figures:
        write_section(figures, machine, "\n".join(lines))


def _run(n_area: int, buses: int, meters: str, timeout_s: float, delay_ms: float) -> SimulatorRun:
    n_bus = n_area * buses
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        size = ["--buses", str(n_bus), "--areas", str(n_area), "--meters", meters, "--seed", str(SEED)]
        _call("generate", *size, "--out", folder)
        scenario = str(Path(folder) / "scenario.toml")
        limits = ["--timeout", str(timeout_s), "--delay-ms", str(delay_ms)]
        cpu_s, memory_mib = _call("simulate", scenario, "--quiet", "--no-plots", *limits, "--out", str(out))
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    return SimulatorRun(n_area, n_bus, result, cpu_s, memory_mib)


def _call(*arguments: str) -> tuple[float, float]:
    """Run ``dsse`` and return its CPU seconds and its largest memory, MiB.

    Raises:
        ClickException: it ended with an error other than that there is no consensus.
    """
    command = [sys.executable, "-m", "coordinator", *arguments]
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    click.echo(f"dsse {arguments[0]}: {time.monotonic() - start:.0f} s of wall time", err=True)
    if process.returncode not in (0, 1):
        raise click.ClickException(f"{' '.join(command)} ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def _median_and_most(values: Sequence[int]) -> str:
    return f"{statistics.median(values):.0f}, {max(values)}"


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.simulator")
