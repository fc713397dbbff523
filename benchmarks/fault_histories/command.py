"""``python -m benchmarks.fault_histories``: thousands of seeded histories of faults on the simulator, summed up."""

from __future__ import annotations

import os

for _library in ("OPENBLAS", "OMP", "MKL"):  # one thread each, also in the child processes; before numpy is imported
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import csv  # noqa: E402
import math  # noqa: E402
import multiprocessing  # noqa: E402
import platform  # noqa: E402
from collections.abc import Callable, Iterator, Sequence  # noqa: E402
from concurrent.futures import ProcessPoolExecutor  # noqa: E402
from dataclasses import astuple, fields  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402

import click  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from benchmarks.fault_histories.history import AREAS, GAP, HistoryOutcome, run_history  # noqa: E402
from benchmarks.measuring.figures import figures_option, list_facts, write_section  # noqa: E402
from benchmarks.measuring.machine import describe_machine  # noqa: E402
from coordinator.lab.studies.executors import open_executor, run_units  # noqa: E402
from coordinator.lab.studies.study_row import describe_versions  # noqa: E402
from dsse_core.linear import choose  # noqa: E402

PACKAGES = ("numpy", "scipy", "numba")
COLUMNS = tuple(field.name for field in fields(HistoryOutcome))
ORIGIN = ("host", "versions")
UNIT_HERE = 4  # histories at a time for a process of this machine


@click.command(context_settings={"show_default": True})
@click.option("--count", type=click.IntRange(1), default=1000, help="Histories: so many seeds.")
@click.option("--first", type=click.IntRange(0), default=0, help="The first seed.")
@click.option("--jobs", type=click.IntRange(1), default=2, help="Processes at a time.")
@click.option("--phases", type=click.Choice([*AREAS]), help="Of this feeder with all its phases; else balanced ones.")
@click.option("--switching", is_flag=True, help="Ties are added, and switches operated.")
@click.option("--executor", metavar="dask://HOST:PORT", help="Run on the workers of this scheduler instead.")
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Table, a row for each seed; seeds that it has are not run again. "
    "By default runs/fault-histories.csv; -of-ieee13 or -of-ieee123 with --phases, -switching with --switching.",
)
@figures_option
def main(
    count: int,
    first: int,
    jobs: int,
    phases: str | None,
    switching: bool,
    executor: str | None,
    out: Path | None,
    figures: str | None,
) -> None:
    """Run histories of faults and say how many ended at the fixed point and how many good states were wrong."""
    kind = f"{f'-of-{phases}' if phases else ''}{'-switching' if switching else ''}"
    out = out or Path("runs") / f"fault-histories{kind}.csv"
    out.parent.mkdir(parents=True, exist_ok=True)
    done = read_table(out)
    seeds = range(first, first + count)
    missing = [seed for seed in seeds if seed not in done]
    with out.open("a", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        if not file.tell():
            table.writerow((*COLUMNS, *ORIGIN))
        console, run = Console(stderr=True), partial(run_history, phases=phases or "", switching=switching)
        for outcome, *origin in track(_run(missing, jobs, executor, run), "histories", len(missing), console=console):
            table.writerow((*astuple(outcome), *origin))
            file.flush()
            done[outcome.seed] = outcome
    facts = summarise([done[seed] for seed in seeds])
    click.echo("\n".join(f"{what}: {figure}" for what, figure in facts.items()))
    if figures:
        write_section(figures, describe_machine(PACKAGES), list_facts(facts))


def read_table(path: Path) -> dict[int, HistoryOutcome]:
    """Seed -> outcome of every whole row of an earlier run."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]
    kinds = {field.name: int if field.type == "int" else float for field in fields(HistoryOutcome)}
    outcomes = [HistoryOutcome(**{name: kinds[name](row[name]) for name in COLUMNS}) for row in rows]  # type: ignore[arg-type]
    return {outcome.seed: outcome for outcome in outcomes}


def summarise(outcomes: Sequence[HistoryOutcome]) -> dict[str, str]:
    """Name of a figure -> its text, over all histories."""
    states, good, wrong = (sum(getattr(o, name) for o in outcomes) for name in ("states", "good", "wrong"))
    lost = [o.seed for o in outcomes if not o.gap <= GAP or math.isnan(o.settled_s)]
    settled = sorted(o.settled_s for o in outcomes if not math.isnan(o.settled_s))
    areas, buses = ([getattr(o, name) for o in outcomes] for name in ("areas", "buses"))
    share = 100 * wrong / max(1, good)
    facts = {
        "histories": f"{len(outcomes)} of {min(areas)} to {max(areas)} areas, {min(buses)} to {max(buses)} buses",
        f"in the end at the fixed point (gap <= {GAP:g})": (
            f"{len(outcomes) - len(lost)}, largest gap {max(o.gap for o in outcomes):.2g}"
        ),
        "states": f"{states}, marked good {good}, of these beyond three sigma {wrong} = {share:.3g} %",
        "largest distance of a good state": f"{max(o.worst for o in outcomes):.3g} sigma",
    }
    if settled:
        median, worst = settled[len(settled) // 2], settled[-1]
        facts["all good again after the faults"] = f"median {median:.1f} s, worst {worst:.1f} s of virtual time"
    if lost:
        facts["NOT at the fixed point"] = f"seeds {', '.join(map(str, lost[:20]))}"
    return facts


def run_histories(run: Callable[[int], HistoryOutcome], seeds: Sequence[int]) -> list[tuple[HistoryOutcome, str, str]]:
    """Outcomes of one unit of work, each with host and versions. Small areas, too, use the compiled back end."""
    before, choose.RADIAL_FROM = choose.RADIAL_FROM, 0
    try:
        return [(run(seed), platform.node(), describe_versions()) for seed in seeds]
    finally:
        choose.RADIAL_FROM = before


def _run(
    seeds: Sequence[int], jobs: int, address: str | None, run: Callable[[int], HistoryOutcome]
) -> Iterator[tuple[HistoryOutcome, str, str]]:
    run_some = partial(run_histories, run)
    if address is not None:
        with open_executor(address) as executor:
            yield from run_units(executor, run_some, seeds)
    elif jobs == 1:
        for seed in seeds:
            yield run(seed), platform.node(), describe_versions()
    else:
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            yield from run_units(pool, run_some, seeds, UNIT_HERE)
