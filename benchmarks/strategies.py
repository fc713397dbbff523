"""``python -m benchmarks.strategies``: the strategies side by side on the simulator, the same every time."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import click

from agents.strategies.installed import list_strategies
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.studies.study_row import StudyRow
from coordinator.lab.studies.sweep import run_on_simulator, run_tasks
from coordinator.lab.studies.sweep_plan import make_plan, parse_vary

Case = tuple[str, list[StudyRow]]  # runs of one strategy
PACKAGES = ("numpy", "scipy", "numba")
SIDE_BY_SIDE = ("ieee33", "ieee33-lossy", "ieee33-load-error")
FEEDER = ("--buses", "300", "--seed", "7", "--areas", "12")
LOSSES = "0", "0.3", "0.6", "0.9"
METERS = {"vm@22": 20, "p_flow@6:6-7": 20, "p_flow@7:7-8": 30}  # in area1, at a boundary, inside area2: sigmas
PENALTIES = "0.1", "0.3", "1", "3", "10"
HEADER = (
    *("case", "strategy", "runs", "gap p.u.: median, largest", "gap deg: median, largest"),
    *("messages: median", "bytes: median", "s to 1e-6: median, slowest"),
)


def compare_scenarios() -> Iterator[Case]:
    """Shipped scenarios, and a feeder of 12 areas with standard and with sparse meters; one run each."""
    for name in SIDE_BY_SIDE:
        yield from _run_all(name, name)
    with tempfile.TemporaryDirectory() as folder:
        for meters in ("standard", "sparse"):
            out = Path(folder) / meters
            command = [sys.executable, "-m", "coordinator", "generate", *FEEDER, "--meters", meters, "--out", str(out)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            yield from _run_all(f"12 areas, 300 buses, {meters} meters", str(out / "scenario.toml"))


def lose_messages(seeds: int = 20) -> Iterator[Case]:
    """Sweep of the share of messages lost."""
    return _sweep("ieee33", "faults.loss", {f"loss {loss}": loss for loss in LOSSES}, list_strategies(), seeds)


def spoil_meters(seeds: int = 20) -> Iterator[Case]:
    """Sweep of one wrong meter."""
    values = {meter: f'[{{meter="{meter}",sigmas={sigmas}}}]' for meter, sigmas in METERS.items()}
    return _sweep("ieee33", "telemetry.gross_error", {"none": "[]", **values}, list_strategies(), seeds)


def change_penalty() -> Iterator[Case]:
    """Sweep of ADMM's penalty, on two networks."""
    for network in ("ieee33", "industrial13"):
        values = {f"{network}, penalty {penalty}": penalty for penalty in PENALTIES}
        yield from _sweep(network, "admm.penalty", values, ("admm",), 1)


SECTIONS: dict[str, Callable[[], Iterable[Case]]] = {
    "strategies": compare_scenarios,
    "loss": lose_messages,
    "wrong-meters": spoil_meters,
    "penalty": change_penalty,
}


def _run_all(case: str, name_or_path: str) -> Iterator[Case]:
    scenario = choose_scenario(name_or_path)
    for strategy in list_strategies():
        yield case, [run_on_simulator(replace(scenario, strategy=strategy))]


def _sweep(scenario: str, key: str, values: Mapping[str, str], strategies: Sequence[str], seeds: int) -> Iterator[Case]:
    """Rows of all seeds for each value of ``key`` and each strategy; ``values``: name of the case -> value in TOML."""
    plan = make_plan(scenario, [parse_vary(f"{key}={','.join(values.values())}")], strategies, seeds)
    rows = dict(run_tasks(plan, plan.tasks, os.cpu_count() or 1))
    for case, varied in zip(values, plan.scenarios, strict=True):
        for strategy in strategies:
            yield case, [row for task, row in rows.items() if (task.values, task.strategy) == (varied, strategy)]


def write_line(case: str, rows: Sequence[StudyRow]) -> str:
    """A line of the Markdown table; a run without a gap, or that never comes close, counts as infinite."""
    cells = (
        *(case, rows[0].strategy, str(len(rows))),
        *(_pair([getattr(row, name) for row in rows], ".1e") for name in ("gap_vm_pu", "gap_va_deg")),
        *(f"{statistics.median(getattr(row, name) or 0 for row in rows):.0f}" for name in ("messages", "bytes")),
        _pair([row.below_1e6_s for row in rows], ".2g"),
    )
    return "| " + " | ".join(cells) + " |"


def _pair(values: Iterable[float | None], form: str) -> str:
    found = [math.inf if value is None else value for value in values]
    pair = [statistics.median(found)] if len(found) == 1 else [statistics.median(found), max(found)]
    return ", ".join("never" if math.isinf(value) else format(value, form) for value in pair)


@click.command(context_settings={"show_default": True})
@click.argument("section", type=click.Choice([*SECTIONS]))
@figures_option
def main(section: str, figures: str | None) -> None:
    """Gap, messages and virtual time of the strategies: side by side, with messages lost, with a wrong meter, and of
    ADMM with other penalties. Up to some minutes each."""
    lines = ["| " + " | ".join(HEADER) + " |", "|---|---|" + "---:|" * (len(HEADER) - 2)]
    lines += [write_line(*case) for case in SECTIONS[section]()]
    click.echo("\n".join(lines))
    if figures:
        write_section(figures, describe_machine(PACKAGES), "\n".join(lines))


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.strategies")
