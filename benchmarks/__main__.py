"""The command line: ``python -m benchmarks --help``."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

for _library in ("OPENBLAS", "OMP", "MKL"):  # one thread each, also in the child processes; before numpy is imported
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import click  # noqa: E402

from benchmarks.estimates.batch import PEER, BatchRow, format_batches  # noqa: E402
from benchmarks.estimates.cases import SETS, SHARP  # noqa: E402
from benchmarks.estimates.comparison import DrawRow, Limits, Row, compare, compare_batches, compare_draws  # noqa: E402
from benchmarks.measuring.figures import figures_option, write_section  # noqa: E402
from benchmarks.measuring.machine import describe_machine  # noqa: E402
from benchmarks.measuring.report import format_draws, format_estimates, format_ratios, write_report  # noqa: E402
from benchmarks.methods.compared import OURS, OURS_WITH_RESIDUALS, PEERS  # noqa: E402
from benchmarks.phases import compare_phases, find_missed, format_phases  # noqa: E402
from dsse_core.errors import InvalidInputError  # noqa: E402

ALL_SETS = (*SETS, *(name + SHARP for name in SETS))
SMALLEST = 3
SIZES_OF_PHASES = [10, 100, 1000]
ENVIRONMENT = ("numpy", "scipy", "numba", "cvxopt")


def _parse_sizes(_context: click.Context, _option: click.Parameter, text: str | None) -> list[int] | None:
    if text is None:
        return None
    words = [word.strip() for word in text.split(",")]
    if wrong := [word for word in words if not word.isdecimal() or int(word) < SMALLEST]:
        raise click.BadParameter(f"{', '.join(map(repr, wrong))}: give numbers of buses from {SMALLEST}, as 33,1000")
    return list(dict.fromkeys(int(word) for word in words))


def _parse_sets(_context: click.Context, _option: click.Parameter, text: str) -> list[str]:
    words = [word.strip() for word in text.split(",")]
    if wrong := [word for word in words if word not in ALL_SETS]:
        raise click.BadParameter(f"{', '.join(map(repr, wrong))}: choose from {', '.join(ALL_SETS)}")
    return list(dict.fromkeys(words))


@click.command(context_settings={"show_default": True})
@click.option("--sizes", callback=_parse_sizes, help="Buses.  [default: 33,1000,10000; reduced: 33,1000]")
@click.option("--sets", callback=_parse_sets, default="full,dist", help=f"Out of {', '.join(ALL_SETS)}.")
@click.option("--reduced", is_flag=True, help="Smaller defaults: a few minutes.")
@click.option("--runs", type=click.IntRange(1), help="Timed runs of a case, at most.  [default: 15; reduced: 3]")
@click.option("--draws", type=click.IntRange(0), help="Random draws, 0 for none.  [default: 256; reduced: 8]")
@click.option("--peers/--no-peers", default=True, help="Without peers: ours alone, which leaves it time for all draws.")
@click.option("--limit-s", type=click.FloatRange(1), default=600.0, help="Seconds for a case with one method.")
@click.option("--limit-gib", type=click.FloatRange(1), default=8.0, help="Memory for a case with one method.")
@click.option("--phases", type=click.Choice(["1", "3"]), default="1", help="3: unbalanced, beside power-grid-model.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("runs/benchmarks"))
@figures_option
def main(
    sizes: list[int] | None,
    sets: list[str],
    reduced: bool,
    runs: int | None,
    draws: int | None,
    peers: bool,
    limit_s: float,
    limit_gib: float,
    phases: str,
    out: Path,
    figures: str | None,
) -> None:
    """Time our centralised estimate side by side with power-grid-model, pandapower and gridstate.

    Writes results.md, results.json and times.png. Exits with 1 if an estimate of ours is missing or is not the minimum.
    """
    if phases == "3":
        of_phases = compare_phases(sizes or SIZES_OF_PHASES, _report)
        if figures:
            write_section(figures, describe_machine((PEER, *ENVIRONMENT)), format_phases(of_phases))
        click.echo(format_phases(of_phases))
        if missed := find_missed(of_phases):
            raise click.ClickException("; ".join(missed))
        return
    sizes = sizes or ([33, 1000] if reduced else [33, 1000, 10000])
    runs = runs or (3 if reduced else 15)
    draws = (8 if reduced else 256) if draws is None else draws
    limits = Limits(runs, limit_s, limit_gib)
    others = PEERS if peers else ()
    methods = (*OURS, *OURS_WITH_RESIDUALS, *others)
    packages = [method.package for method in methods]
    machine = describe_machine(dict.fromkeys([*packages, PEER, *ENVIRONMENT]))
    try:
        out.mkdir(parents=True, exist_ok=True)  # before the hours of work, not after
        rows = compare(sizes, sets, OURS, (*OURS_WITH_RESIDUALS, *others), limits, _report)
        solved = compare_draws(sizes, sets, (*OURS, *others), draws, limits, _report)
        batches = compare_batches(sizes, sets, limits, _report)
        command = shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]])
        written = write_report(out, command, machine, rows, solved, batches)
    except InvalidInputError as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(f"{out}: {error.strerror or error}") from None
    if figures:
        write_section(figures, machine, _table_for(figures, rows, solved, batches))
    click.echo(format_estimates(rows))
    if solved:
        click.echo("\n" + format_draws(solved))
    if batches:
        click.echo("\n" + format_batches(batches))
    click.echo("\nwritten: " + ", ".join(map(str, written)))
    if missed := _find_missed(rows):
        raise click.ClickException("; ".join(missed))


def _table_for(section: str, rows: list[Row], solved: list[DrawRow], batches: list[BatchRow]) -> str:
    if section == "batches":
        return format_batches(batches)
    if section == "cold":
        return format_ratios(rows, "cold")
    return format_draws(solved) if solved else format_ratios(rows)


def _find_missed(rows: list[Row]) -> list[str]:
    ours = {method.name for method in OURS}
    return [
        f"{row.n_bus} buses, {row.set_name}: {row.method} {row.remark}"
        for row in rows
        if row.method in ours and row.remark
    ]


def _report(what: str) -> None:
    click.echo(what, err=True)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
