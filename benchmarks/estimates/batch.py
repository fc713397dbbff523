"""Many scans of one network at once: ours beside power-grid-model's batch, on the same numbers of threads."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.estimates.cases import SEED, Case
from benchmarks.measuring.machine import find_version
from benchmarks.methods.method import MAX_ITERATIONS, TOLERANCE
from benchmarks.methods.ours import Ours, Scan
from benchmarks.methods.power_grid_model import PowerGridModelMethod
from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import EstimationPlan

READINGS = 10_000_000  # of all scans of a batch, at most
MOST_SCANS = 4000
PEER = "power-grid-model"
ALGORITHMS = ("newton_raphson", "iterative_linear")
Solve = Callable[[], int]


@dataclass(frozen=True)
class BatchRow:
    """One tool on ``scans`` scans: wall-clock and processor seconds of the fastest run, and scans without estimate."""

    n_bus: int
    set_name: str
    method: str
    threads: int
    scans: int
    failed: int
    wall_s: float
    cpu_s: float


def measure_batches(case: Case, runs: int) -> list[BatchRow]:
    """All tools in turn, ``runs`` times, after one run of each that is not counted.

    Scans have the meters and sigmas of ``case`` and noise of their own; every one begins at the flat start.
    """
    n_bus, ours = len(case.network.buses), Ours("ours, radial", "radial")
    plan, scan = ours.build(ours.translate(case))
    count = max(1, min(MOST_SCANS, READINGS // (10 * len(scan.values))))
    values = _draw_scans(plan, scan, count)
    solves: dict[tuple[str, int], Solve] = {}
    for threads in dict.fromkeys((1, len(os.sched_getaffinity(0)))):
        solves[ours.name, threads] = partial(_solve_ours, plan, values, scan.sigmas, threads)
        if find_version(PEER) is not None:
            for algorithm in ALGORITHMS:
                solves[f"{PEER} {algorithm}", threads] = _peer(case, algorithm, values, threads)
    failed = {key: solve() for key, solve in solves.items()}
    fastest = dict.fromkeys(solves, (np.inf, np.inf))
    for _ in range(runs):
        for key, solve in solves.items():
            wall, cpu = time.perf_counter(), time.process_time()
            solve()
            took = time.perf_counter() - wall, time.process_time() - cpu
            fastest[key] = min(fastest[key][0], took[0]), min(fastest[key][1], took[1])
    return [BatchRow(n_bus, case.set_name, *key, count, failed[key], *fastest[key]) for key in solves]


def _draw_scans(plan: EstimationPlan, scan: Scan, count: int) -> np.ndarray:
    """Readings (count, n_meas) around those of the estimate of ``scan``."""
    exact = scan.values - estimate_with_plan(plan, scan.values, scan.sigmas).residual
    rng = np.random.default_rng([SEED, len(exact)])
    drawn: np.ndarray = exact + scan.sigmas * rng.standard_normal((count, len(exact)))
    return drawn


def _solve_ours(plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, threads: int) -> int:
    return len(estimate_batch(plan, values, sigmas, tolerance=TOLERANCE, threads=threads).failures)


def _peer(case: Case, algorithm: str, values: np.ndarray, threads: int) -> Solve:
    """Batch solver of the peer; ``values``: the voltages, then P and Q by turns, as ``Case.measurements`` has them."""
    import power_grid_model as pgm

    method = PowerGridModelMethod(algorithm, algorithm)
    data = method.translate(case)
    model: Any = method.build(data)
    voltage, power = data["sym_voltage_sensor"], data["sym_power_sensor"]
    n_voltage, va = len(voltage), case.network.base_mva * 1e6
    of_voltage = pgm.initialize_array("update", "sym_voltage_sensor", (len(values), n_voltage))
    of_power = pgm.initialize_array("update", "sym_power_sensor", (len(values), len(power)))
    of_voltage["id"], of_power["id"] = voltage["id"], power["id"]
    of_voltage["u_measured"] = values[:, :n_voltage] * (voltage["u_measured"] / case.vm.value.real)
    of_power["p_measured"], of_power["q_measured"] = values[:, n_voltage::2] * va, values[:, n_voltage + 1 :: 2] * va

    def solve() -> int:
        model.calculate_state_estimation(
            symmetric=True,
            error_tolerance=TOLERANCE,
            max_iterations=MAX_ITERATIONS,
            calculation_method=pgm.CalculationMethod[algorithm],
            update_data={"sym_voltage_sensor": of_voltage, "sym_power_sensor": of_power},
            threading=-1 if threads == 1 else threads,
            output_component_types=[pgm.ComponentType.node],
            continue_on_batch_error=True,
        )
        error = model.batch_error
        return 0 if error is None else len(error.failed_scenarios)

    return solve


def format_batches(rows: list[BatchRow]) -> str:
    """One line per tool and number of threads; ratios are our rate divided by the tool's on the same threads."""
    head = ["buses", "set", "method", "threads", "scans", "failed", "scans / s", "scans / processor s", "ours / it"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        alike = (row.n_bus, row.set_name, row.threads)
        first = next(r for r in rows if (r.n_bus, r.set_name, r.threads) == alike)
        of_wall, of_cpu = row.wall_s / first.wall_s, row.cpu_s / first.cpu_s
        cells = [
            *map(str, (row.n_bus, row.set_name, row.method, row.threads, row.scans, row.failed)),
            f"{row.scans / row.wall_s:,.0f}",
            f"{row.scans / row.cpu_s:,.0f}",
            "" if row is first else f"{of_wall:.2g} (processor time {of_cpu:.2g})",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
