"""``python -m benchmarks.large_feeder SCENARIO``: processor time of each part of an estimate, and of its areas."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import click
import numpy as np

import consensus_dsse as dsse
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine
from dsse_core.estimation.bad_data import process_bad_data_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.exchange.area_estimation import AreaEstimation
from dsse_core.grid.measurement import Measurement
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.deviations.choose import find_deviations
from scenarios.scenario import Scenario
from scenarios.telemetry import read_meters

Found = TypeVar("Found")
PACKAGES = ("numpy", "scipy", "numba", "consensus-dsse")
RUNS = 3


@click.command(context_settings={"show_default": True})
@click.argument("scenario")
@figures_option
def main(scenario: str, figures: str | None) -> None:
    """Print a Markdown table of processor times, s, of the whole network of SCENARIO and of its areas, each once."""
    machine = describe_machine(PACKAGES)
    for name, text in machine.items():
        click.echo(f"{name}: {text}")
    lines = ["| part | CPU s |", "|---|---|"]
    lines += [f"| {part} | {seconds:.3g} |" for part, seconds in _measure(scenario)]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    lines.append(f"| most memory, MiB | {memory:.0f} |")
    click.echo("\n".join(lines))
    if figures:
        write_section(figures, machine, "\n".join(lines))


def _measure(name: str) -> Iterator[tuple[str, float]]:
    read_s, scenario = _time(lambda: dsse.load_scenario(name))
    network = scenario.network
    yield f"scenario of {network.n_nodes:,} nodes read", read_s
    yield "power flow", _time(lambda: solve_power_flow(network))[0]
    plan_s, plan = _time(lambda: build_estimation_plan(network, scenario.meters))
    yield f"plan with {len(plan.meters):,} meters, observability", plan_s
    scan = read_meters(scenario)
    first_s, _ = _time(lambda: process_bad_data_with_plan(plan, scan.values, scan.sigmas))
    yield "estimate and residuals, the first", first_s
    again_s, report = _time(lambda: process_bad_data_with_plan(plan, scan.values, scan.sigmas))
    yield "estimate and residuals, again", again_s
    yield "standard deviations of all quantities", _time(lambda: find_deviations(report.result))[0]
    yield from _measure_areas(scenario, scan.values, scan.sigmas)


def _measure_areas(scenario: Scenario, values: np.ndarray, sigmas: np.ndarray) -> Iterator[tuple[str, float]]:
    """Times of the areas, the mean of all: of what is found while messages are awaited, and of sigmas."""
    division_s, partition = _time(lambda: scenario.partition)
    yield f"division into {len(partition.areas)} areas", division_s
    rows, reduced, found = partition.split_meters(scenario.meters), [], []
    for area in partition.areas:
        side = AreaEstimation(area)
        at = rows[area.name].tolist()
        readings = [Measurement(scenario.meters[k], float(values[k]), float(sigmas[k])) for k in at]
        side.begin(readings, silent=set(), stale=False)
        linear, x = side.model.linear, side.x
        linear.prepare(x)
        states = [x * (1 + 1e-9 * k) for k in range(1, RUNS + 1)]
        reduced.append(min(_time(partial(linear.prepare, state))[0] for state in states))
        found.append(_time(partial(linear.variances, x, {}))[0])
    nodes = [area.network.n_nodes for area in partition.areas]
    yield f"an area of {np.mean(nodes):.0f} nodes (at most {max(nodes)}) at another state", float(np.mean(reduced))
    yield "standard deviations of an area", float(np.mean(found))


def _time(call: Callable[[], Found]) -> tuple[float, Found]:
    begin = time.process_time()
    found = call()
    return time.process_time() - begin, found


if __name__ == "__main__":
    main()
