"""``python -m benchmarks.exchange``: messages and times of a scan on the simulator, the same every time."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import json
import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass

import click

from benchmarks.exchange.watch import ScanFigures, WatchedBus
from benchmarks.exchange.worlds import SCANS, draw_feeder, draw_row, read_ieee33
from benchmarks.fault_histories.history import World
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine

EXACT = "information"
ASYNCHRONOUS = "admm", "angle-offset"
LIMIT_S = 60.0  # of virtual time, for a scan
HOP_S, LONG_HOP_S = 0.001, 0.05
LONGEST_PATH = 4  # of the eight areas, edges: the hub is in the middle
REST_AREAS, REST_RUNS = 12, 3
PACKAGES = ("consensus-dsse", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class Extent:
    """Extent of the measurements: counts of feeders, areas in a row, shares lost, and runs of each."""

    feeders: int = 25
    rows: tuple[int, ...] = (59, 100, 400)
    losses: tuple[float, ...] = (0.0, 0.3, 0.6, 0.9)
    runs: int = 21
    lossy_row: int = 100
    row_losses: tuple[float, ...] = (0.1, 0.3)
    row_runs: int = 5
    rest_losses: tuple[float, ...] = (0.0, 0.1, 0.3, 0.5)
    rest_s: float = 20.0  # virtual, of each of REST_RUNS
    worst_asynchronous: float = 0.6  # beyond, strategies that repeat at the heartbeat take minutes


QUICK = Extent(2, (6,), (0.0, 0.3), 3, 6, (0.3,), 2, (0.3,), 2.0, 0.0)


@dataclass(frozen=True)
class Row:
    """One line of the table, of ``runs`` scans; (median, most) of each figure, s and messages per edge."""

    case: str
    strategy: str
    scan: str
    runs: int
    boundary: tuple[float, float]
    repeats: float
    acknowledgements: float
    heartbeats: float
    loads: float
    rounds: tuple[float, float]
    agree_s: tuple[float, float]
    good_s: tuple[float, float]
    predicted_s: float
    gap: float
    good_share: float  # of the time of all areas, at rest


def summarise(
    case: str,
    strategy: str,
    scan: str,
    figures: Sequence[ScanFigures],
    predicted_s: float = math.nan,
    good_share: float = math.nan,
) -> Row:
    """One line of several scans; an area that never agrees or is never good makes the largest time infinite."""

    def per_edge(name: str) -> float:
        return float(statistics.median(getattr(f, name) / f.edges for f in figures))

    def spread(values: Iterable[float]) -> tuple[float, float]:
        found = [math.inf if math.isnan(value) else value for value in values]
        return statistics.median(found), max(found)

    return Row(
        case,
        strategy,
        scan,
        len(figures),
        spread(f.boundary_per_edge for f in figures),
        per_edge("repeats"),
        per_edge("acknowledgements"),
        per_edge("heartbeats"),
        per_edge("loads"),
        spread(f.rounds for f in figures),
        spread(f.agree_s for f in figures),
        spread(f.good_s for f in figures),
        predicted_s,
        max(f.gap for f in figures),
        good_share,
    )


def measure(extent: Extent) -> Iterator[Row]:
    """All lines of the table, as they are found."""
    ieee33 = read_ieee33()
    yield from _measure_feeders(extent, EXACT)
    yield from _measure_scans(f"8 areas, {LONG_HOP_S * 1000:.0f} ms a hop", _draw_eight(), LONG_HOP_S)
    yield from _measure_loss("ieee33", ieee33, EXACT, extent.losses, extent.runs)
    for n_area in extent.rows:
        yield from _measure_scans(f"{n_area} areas in a row", draw_row(n_area), HOP_S)
    yield from _measure_rest(extent)
    row = draw_row(extent.lossy_row)
    yield from _measure_loss(f"{extent.lossy_row} areas in a row", row, EXACT, extent.row_losses, extent.row_runs)
    for strategy in ASYNCHRONOUS:
        yield from _measure_feeders(extent, strategy)
        losses = [loss for loss in extent.losses if loss <= extent.worst_asynchronous]
        yield from _measure_loss("ieee33", ieee33, strategy, losses, extent.runs)


def _measure_feeders(extent: Extent, strategy: str) -> Iterator[Row]:
    """Rows of random feeders; scans with removals of bad data are apart, since each removal takes an iteration."""
    cold: list[ScanFigures] = []
    warm: list[ScanFigures] = []
    for seed in range(extent.feeders):
        first, *others = _run_scans(draw_feeder(seed), strategy, HOP_S)
        cold.append(first)
        warm += others
    for scan, figures in (("cold", cold), ("warm", warm)):
        for removals in (False, True):
            if some := [f for f in figures if bool(f.removed) is removals]:
                case = f"{extent.feeders} random feeders" + (", with removals" if removals else "")
                yield summarise(case, strategy, scan, some)


def _measure_scans(case: str, world: World, hop_s: float) -> Iterator[Row]:
    first, *others = _run_scans(world, EXACT, hop_s)
    for scan, figures in (("cold", [first]), ("warm", others)):
        rounds = max(f.rounds for f in figures)
        yield summarise(case, EXACT, scan, figures, predict(world, rounds, hop_s))


def predict(world: World, rounds: int, hop_s: float) -> float:
    """Time until the final message of the hub has reached the farthest area, s; readings come after ``HOP_S``."""
    longest = len(world.partition.longest_path) - 1
    return HOP_S + rounds * 2 * math.ceil(longest / 2) * hop_s


def _measure_loss(grid: str, world: World, strategy: str, losses: Sequence[float], runs: int) -> Iterator[Row]:
    for loss in losses:
        figures = [WatchedBus(world, strategy, loss=loss, seed=seed).watch(LIMIT_S) for seed in range(runs)]
        yield summarise(f"{grid}, {loss:.0%} lost", strategy, "cold", figures)


def _measure_rest(extent: Extent) -> Iterator[Row]:
    """Rows of the first scan, with the share of time in which areas are good while messages are lost."""
    world = read_ieee33(REST_AREAS)
    for loss in extent.rest_losses:
        buses = [WatchedBus(world, EXACT, loss=loss, seed=seed) for seed in range(REST_RUNS)]
        figures = [bus.watch(LIMIT_S) for bus in buses]
        share = statistics.mean(bus.share_good(extent.rest_s) for bus in buses)
        yield summarise(f"ieee33 in {REST_AREAS} areas, {loss:.0%} lost", EXACT, "cold", figures, good_share=share)


def _run_scans(world: World, strategy: str, hop_s: float) -> list[ScanFigures]:
    bus = WatchedBus(world, strategy, hop_s=hop_s)
    figures = [bus.watch(LIMIT_S)]
    for _ in range(SCANS - 1):
        bus.go_on()
        figures.append(bus.watch(LIMIT_S))
    return figures


def _draw_eight() -> World:
    worlds = (draw_feeder(seed, areas=8) for seed in range(100))
    return next(world for world in worlds if len(world.partition.longest_path) - 1 == LONGEST_PATH)


COLUMNS = (
    "case",
    "strategy",
    "scan",
    "runs",
    "boundary messages per edge: median, most",
    "repeats",
    "acknowledgements",
    "heartbeats",
    "load messages",
    "rounds",
    "all agree, s: median, most",
    "all good, s: median, most",
    "rounds x path, s",
    "good at rest",
    "gap",
)


def write_line(row: Row) -> str:
    """A line of the Markdown table."""
    cells = (row.case, row.strategy, row.scan, str(row.runs), _pair(row.boundary))
    counts = [f"{n:.1f}" for n in (row.repeats, row.acknowledgements, row.heartbeats, row.loads)]
    rounds = _pair(row.rounds) if row.rounds[1] else "-"
    times = (_pair(row.agree_s), _pair(row.good_s), _number(row.predicted_s), _number(row.good_share))
    return "| " + " | ".join((*cells, *counts, rounds, *times, f"{row.gap:.0e}")) + " |"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _pair(values: tuple[float, float]) -> str:
    return ", ".join("never" if math.isinf(value) else f"{value:.3g}" for value in values)


@click.command(context_settings={"show_default": True})
@click.option("--quick", is_flag=True, help="Small sizes, to see that it runs.")
@click.option("--json", "as_json", is_flag=True, help="JSON in place of the table; infinite times are null.")
@figures_option
def main(quick: bool, as_json: bool, figures: str | None) -> None:
    """Count messages and take virtual times of scans: random feeders, rows, loss, long hops. Ten minutes and more."""
    machine = describe_machine(PACKAGES)
    rows = measure(QUICK if quick else Extent())
    if as_json:
        found = [{key: _finite(value) for key, value in asdict(row).items()} for row in rows]
        click.echo(json.dumps({"machine": machine, "rows": found}, indent=2, allow_nan=False))
        return
    for name, text in machine.items():
        click.echo(f"{name}: {text}")
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    click.echo("\n" + "\n".join(lines))
    for row in rows:
        lines.append(write_line(row))
        click.echo(lines[-1])
    if figures:
        write_section(figures, machine, "\n".join(lines))


def _finite(value: object) -> object:
    if isinstance(value, tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
