"""``python -m benchmarks.power_flow``: the power flow by default beside power-grid-model's Newton-Raphson."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from typing import Any

import click
import numpy as np

from benchmarks.estimates.cases import build_network
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine
from benchmarks.methods.physical import describe_lines
from benchmarks.methods.power_grid_model import FREQUENCY_HZ, component_tables
from dsse_core.grid.network import Control, Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow, solve_with_plan
from dsse_core.power_flow.plan import build_power_flow_plan

PACKAGES = ("power-grid-model", "numpy", "scipy", "consensus-dsse")
TOLERANCE, MAX_ITERATIONS = 1e-10, 30
STIFF_SK_VA = 1e40  # of the source, which holds the voltage of its node exactly
DIFFERENCE, FASTER, FEWEST_BUSES = 1e-10, 1.2, 1000  # targets; the speed counts from so many buses on
FEWEST_BUSES_OF_RUNS = 10_000
HEADER = (
    "| buses | method | ours, ms: first, cold, warm | power-grid-model, ms: first, cold, warm "
    "| theirs / ours: first, cold, warm | largest difference, p.u. |"
)


@dataclass(frozen=True)
class Times:
    """Processor time, ms. ``first``: of a process. ``cold``: with model or plan built; ``warm``: with one kept."""

    first: float
    cold: float
    warm: float


@dataclass(frozen=True)
class Comparison:
    """One network. ``difference``: of complex voltages, the largest, p.u."""

    n_bus: int
    method: str
    ours: Times
    theirs: Times
    difference: float

    @property
    def ratios(self) -> tuple[float, float, float]:
        """Their time over ours: first, cold, warm."""
        pairs = zip(asdict(self.theirs).values(), asdict(self.ours).values(), strict=True)
        first, cold, warm = (theirs / ours for theirs, ours in pairs)
        return first, cold, warm

    def as_row(self) -> str:
        """Row of the table under HEADER."""
        times = (", ".join(f"{value:.3g}" for value in asdict(part).values()) for part in (self.ours, self.theirs))
        ratios = ", ".join(f"{ratio:.3g}" for ratio in self.ratios)
        return f"| {self.n_bus} | {self.method} | {' | '.join(times)} | {ratios} | {self.difference:.1e} |"

    def find_missed(self) -> list[str]:
        """Targets that are not reached."""
        missed = []
        if not self.difference <= DIFFERENCE:
            missed.append(f"{self.n_bus} buses: voltages differ by {self.difference:.1e} p.u., more than {DIFFERENCE}")
        if self.n_bus >= FEWEST_BUSES and min(self.ratios[1:]) < FASTER:
            missed.append(f"{self.n_bus} buses: cold or warm less than {FASTER} times as fast")
        return missed


@click.command(context_settings={"show_default": True})
@click.option("--sizes", default="33,1000,10000,100000", help="Buses; 33: ieee33, its sources with given P and Q.")
@click.option(
    "--runs",
    type=click.IntRange(1),
    default=15,
    help="In turn, the least counts; below 10,000 buses ten times as many.",
)
@figures_option
def main(sizes: str, runs: int, figures: str | None) -> None:
    """Solve power flows by default and with power-grid-model's Newton-Raphson, in turn, and print a Markdown table.

    First: the first call of a process that has imported all and holds the network. Cold: plan, or model, and solution.
    Warm: the solution with a plan, or model, that is kept. Exit code 1: voltages differ by more than 1e-10 p.u., or
    from 1000 buses on ours is less than 1.2 times as fast, cold or warm.
    """
    machine = describe_machine(PACKAGES)
    for name, text in machine.items():
        click.echo(f"{name}: {text}")
    lines = [HEADER, f"|{'---|' * (HEADER.count('|') - 1)}"]
    click.echo("\n" + "\n".join(lines))
    missed = []
    for n_bus in map(int, sizes.split(",")):
        compared = compare(n_bus, runs)
        missed += compared.find_missed()
        lines.append(compared.as_row())
        click.echo(lines[-1])
    if figures:
        write_section(figures, machine, "\n".join(lines))
    for what in missed:
        click.echo(f"error: {what}", err=True)
    sys.exit(1 if missed else 0)


def compare(n_bus: int, runs: int) -> Comparison:
    """Both tools on the network of ``n_bus`` buses."""
    network = _build_network(n_bus)
    tables = _tables_of(network)
    model, plan = _build_model(tables), build_power_flow_plan(network)
    limit = plan.find_limit(TOLERANCE)
    ours, theirs = solve_power_flow(network), _solve_model(model)
    least = _time_in_turn(
        runs if n_bus >= FEWEST_BUSES_OF_RUNS else 10 * runs,
        [
            lambda: solve_power_flow(network),
            lambda: solve_with_plan(plan, network.scheduled, limit, MAX_ITERATIONS),
            lambda: _solve_model(_build_model(tables)),
            lambda: _solve_model(model),
        ],
    )
    first = [_time_first(n_bus, name) for name in ("ours", "theirs")]
    difference = _find_difference(network, ours, theirs["node"])
    return Comparison(n_bus, ours.method, Times(first[0], *least[:2]), Times(first[1], *least[2:]), difference)


def _build_network(n_bus: int) -> Network:
    """The network of the estimates' cases; as in the peers' input, only the substation holds its voltage."""
    network = build_network(n_bus)
    given = (g if g.control is Control.SLACK else replace(g, control=Control.POWER) for g in network.generators)
    return replace(network, generators=tuple(given))


def _tables_of(network: Network) -> dict[str, np.ndarray]:
    lines = describe_lines(network)
    tables = component_tables(lines)
    load = -np.delete(network.scheduled, lines.slack_row) * network.base_mva * 1e6
    tables["sym_load"]["p_specified"], tables["sym_load"]["q_specified"] = load.real, load.imag
    tables["source"]["sk"] = STIFF_SK_VA
    return tables


def _build_model(tables: dict[str, np.ndarray]) -> Any:
    import power_grid_model as pgm

    return pgm.PowerGridModel(tables, system_frequency=FREQUENCY_HZ)


def _solve_model(model: Any) -> Any:
    import power_grid_model as pgm

    return model.calculate_power_flow(
        symmetric=True,
        error_tolerance=TOLERANCE,
        max_iterations=MAX_ITERATIONS,
        calculation_method=pgm.CalculationMethod.newton_raphson,
        output_component_types=[pgm.ComponentType.node],
    )


def _find_difference(network: Network, ours: PowerFlowResult, node: np.ndarray) -> float:
    assert network.slack is not None
    root = network.row[network.slack.bus]
    v = node["u_pu"] * np.exp(1j * (node["u_angle"] - node["u_angle"][root] + ours.va[root]))
    return float(abs(v - ours.vm * np.exp(1j * ours.va)).max())


def _time_in_turn(runs: int, calls: Sequence[Callable[[], object]]) -> list[float]:
    """The least processor time of each, ms."""
    least = [np.inf] * len(calls)
    gc.collect()
    for _ in range(runs):
        for k, call in enumerate(calls):
            least[k] = min(least[k], _time_once(call))
    return least


def _time_once(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


def _time_first(n_bus: int, name: str) -> float:
    """The first call of a process of its own, ms."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_time_first_here, (n_bus, name))


def _time_first_here(n_bus: int, name: str) -> float:
    import power_grid_model  # noqa: F401  which is not counted, as little as our imports

    network = _build_network(n_bus)
    network.table.is_possible()
    if name == "ours":
        return _time_once(lambda: solve_power_flow(network))
    tables = _tables_of(network)
    return _time_once(lambda: _solve_model(_build_model(tables)))


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.power_flow")
