"""``python -m benchmarks.start``: from ``dsse run`` to its printed verdict, beside the imports that it rests on."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click

from benchmarks.measuring.machine import describe_machine

IMPORTS = "import numpy, scipy.sparse.linalg, zenoh"
MOMENTS = ("scenario_loaded", "router_listens", "agents_started", "areas_joined", "last_change", "verdict")


@click.command(context_settings={"show_default": True})
@click.option("--scenario", default="ieee33", help="Shipped name or file.")
@click.option("--runs", type=click.IntRange(1), default=11, help="Timed runs, the imports beside each.")
def main(scenario: str, runs: int) -> None:
    """Time `dsse run` to its verdict and Python's import of numpy, scipy.sparse.linalg and zenoh in turn; medians."""
    imports, verdicts, moments = [], [], []
    for run in range(runs + 1):
        taken = _time_imports(), *_time_run(scenario)
        if run:  # the first fills the caches
            imports.append(taken[0])
            verdicts.append(taken[1])
            moments.append(taken[2])
    for name, text in describe_machine(("numpy", "scipy", "eclipse-zenoh", "consensus-dsse")).items():
        click.echo(f"{name}: {text}")
    click.echo(f"\n{runs} runs in turn; medians")
    click.echo(f'python -c "{IMPORTS}": {statistics.median(imports):.3f} s')
    click.echo(f"dsse run {scenario} to the printed verdict: {statistics.median(verdicts):.3f} s")
    ratio = statistics.median(verdict / base for verdict, base in zip(verdicts, imports, strict=True))
    click.echo(f"median of the ratios: {ratio:.2f}")
    for moment in MOMENTS:
        click.echo(f"  {moment}: {statistics.median(timing[moment] for timing in moments):.3f} s")


def _time_imports() -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", IMPORTS], check=True)
    return time.perf_counter() - start


def _time_run(scenario: str) -> tuple[float, dict[str, float]]:
    """Seconds until the first line of the verdict can be read, and the run's own ``timing_s``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "coordinator", "run", scenario, "--quiet", "--no-plots", "--out", str(out)]
        start = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            verdict = process.stdout.readline()
            elapsed = time.perf_counter() - start
            process.stdout.read()
        if process.returncode:
            raise click.ClickException(f"dsse run {scenario} ended with {process.returncode}: {verdict}")
        return elapsed, json.loads((out / "result.json").read_text())["timing_s"]


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.start")
