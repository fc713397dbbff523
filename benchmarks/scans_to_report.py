"""``python -m benchmarks.scans_to_report``: a day of readings from CSV to tables, report and page.

A scan a minute, 1,440 of them, with loads that move over the day. ``dsse estimate ieee33 --readings`` in a process of
its own must end in a minute. All tables of some scans must be to the bit those of the scan alone, and the page must
play every scan.
"""

from __future__ import annotations

import csv
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click
import numpy as np

from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.evaluation.scan_estimates import estimate_whole_grid, load_scans_of, with_one_scan
from coordinator.show.web.playback.source import play_recording
from dsse_core.grid.columns import read_column
from dsse_core.grid.meter_table import read_meters_of
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import TABLES, results_of_estimate
from scenarios.files.readings.units import WRITTEN_IN, unit_size
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

PACKAGES = ("numpy", "scipy", "matplotlib")
SCENARIO = "ieee33"
BEGIN = datetime(2026, 11, 26, tzinfo=UTC)
UNITS = ("pu", "mw", "mvar")  # of its meters
GROSS_EVERY = 100  # scans, of which one has a gross error
COMPARED = 12  # scans beside themselves alone
MOST_S = 60.0


def write_day(path: Path, scans: int) -> int:
    """Write a readings file of ``scans`` scans of one day; the number of meters."""
    scenario, rng = load_scenario(SCENARIO), np.random.default_rng(1)
    network, readings = scenario.network, make_telemetry(scenario).union
    meters, sigmas = read_meters_of(readings), read_column(readings, "sigma", float)
    unit = [WRITTEN_IN[meter.kind.quantity] for meter in meters]
    sizes = np.array([unit_size(name, meter, network) for name, meter in zip(unit, meters, strict=True)])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["meter", "scan", *(f"{what}_{name}" for name in UNITS for what in ("value", "sigma"))])
        for scan in range(scans):
            share = 0.75 - 0.25 * math.cos(2 * math.pi * scan / scans)
            buses = [replace(bus, p_load=share * bus.p_load, q_load=share * bus.q_load) for bus in network.buses]
            values = solve_power_flow(replace(network, buses=tuple(buses))).read_all(meters)
            values += sigmas * rng.standard_normal(len(meters))
            if scan % GROSS_EVERY == 0:
                values[scan // GROSS_EVERY % len(meters)] += 30 * sigmas[scan // GROSS_EVERY % len(meters)]
            at = (BEGIN + timedelta(days=1) * scan / scans).isoformat(timespec="milliseconds").removesuffix("+00:00")
            for meter, name, value, sigma in zip(meters, unit, values / sizes, sigmas / sizes, strict=True):
                cells = [cell for each in UNITS for cell in ((value, sigma) if each == name else ("", ""))]
                writer.writerow([meter.id, at, *cells])
    return len(meters)


def estimate_day(readings: Path, out: Path) -> tuple[float, float]:
    """Wall time and processor time, s, of ``dsse estimate`` from ``readings`` to the tables and report in ``out``."""
    command = [sys.executable, "-m", "coordinator", "estimate", SCENARIO, "--readings", str(readings)]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - began, used_s


def count_differences(readings: Path, out: Path, compared: int) -> int:
    """Number of cells in the tables in ``out`` that are not those of ``compared`` scans, each estimated alone."""
    scenario = load_scenario(SCENARIO)
    scans = load_scans_of(scenario, readings)
    chosen = np.unique(np.linspace(0, len(scans.names) - 1, compared).round().astype(int)).tolist()
    found = 0
    rows = {name: _rows_of(out / f"{name}.csv", {scans.names[k] for k in chosen}) for name in TABLES}
    for k in chosen:
        alone = with_one_scan(scenario, replace(scans, names=("",), values=scans.values[[k]], sigmas=scans.sigmas[[k]]))
        tables = results_of_estimate(estimate_whole_grid(alone)[0], partition=scenario.partition, meters=alone.meters)
        for name in TABLES:
            table = getattr(tables, name)
            ours = rows[name][scans.names[k]]
            assert len(ours) == len(table)
            columns = [column for column in table.columns if column not in ("scan", "time", "quality")]
            for row, theirs in zip(ours, zip(*(table[column] for column in columns), strict=True), strict=True):
                found += sum(not _is_same(row[column], cell) for column, cell in zip(columns, theirs, strict=True))
    return found


def _rows_of(path: Path, names: set[str]) -> dict[str, list[dict[str, str]]]:
    found: dict[str, list[dict[str, str]]] = {name: [] for name in names}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["scan"] in names:
                found[row["scan"]].append(row)
    return found


def _is_same(cell: str, value: object) -> bool:
    if isinstance(value, float):
        return cell == "" if math.isnan(value) else bool(cell) and float(cell) == value
    return cell == (str(value).lower() if isinstance(value, bool | np.bool_) else str(value))


def play_day(out: Path) -> tuple[int, float]:
    """Number of moments of the folder ``out`` on the page, and processor time until the last can be shown, s."""
    began = time.process_time()
    source = play_recording(out, load_scenario(SCENARIO), [])
    source.frame(len(source.times()) - 1)
    return len(source.times()), time.process_time() - began


def measure(folder: Path, scans: int) -> dict[str, object]:
    """Figures of ``scans`` scans of one day."""
    readings, out = folder / "readings.csv", folder / "out"
    meters = write_day(readings, scans)
    wall_s, used_s = estimate_day(readings, out)
    moments, played_s = play_day(out)
    return {
        "scans": scans,
        "meters": meters,
        "from CSV to tables and report, s": round(wall_s, 1),
        "processor time of it, s": round(used_s, 1),
        "tables and report, MiB": round(sum(path.stat().st_size for path in out.iterdir()) / 2**20, 1),
        "moments on the page": moments,
        "processor time until the page plays them, s": round(played_s, 1),
        "cells that differ from single scans": count_differences(readings, out, COMPARED),
    }


def find_failures(seen: dict[str, object]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    wall_s = seen["from CSV to tables and report, s"]
    assert isinstance(wall_s, float)
    checks = {
        f"it took more than {MOST_S:g} s": wall_s <= MOST_S,
        "the page does not play every scan": seen["moments on the page"] == seen["scans"],
        "tables differ from those of single scans": seen["cells that differ from single scans"] == 0,
    }
    return [failure for failure, good in checks.items() if not good]


@click.command(context_settings={"show_default": True})
@click.option("--scans", type=click.IntRange(min=2), default=1440)
@figures_option
def main(scans: int, figures: str | None) -> None:
    """Exit code 0: in a minute, to the bit, and played as a whole; 1: not."""
    with tempfile.TemporaryDirectory() as scratch:
        machine, seen = describe_machine(PACKAGES), measure(Path(scratch), scans)
    conclude(machine, seen, find_failures(seen), figures)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.scans_to_report")
