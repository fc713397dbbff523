"""``python -m benchmarks.pieces``: a step of an area by reflections in pieces, beside one by the sparse tableau."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import time
from collections.abc import Iterator, Mapping, Sequence
from unittest.mock import patch

import click
import numpy as np

import consensus_dsse as dsse
from benchmarks.measuring.figures import figures_option, list_facts, write_section
from benchmarks.measuring.machine import describe_machine
from dsse_core.linear import pieces
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import BoundaryInformation
from dsse_core.linear.dense import DenseRows
from dsse_core.linear.interface import LinearArea, Received
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

COUNTS = {"one area": 1, "3 areas": 3}
SIZES = (10, 20, 30, 60)  # nodes of a piece
RUNS = 15
PACKAGES = ("numpy", "scipy", "consensus-dsse")


def compare_steps(scenario: Scenario, sizes: Sequence[int], runs: int) -> Iterator[tuple[int, Mapping[str, float]]]:
    """Each size of pieces, the ratio of processor time of a step of all areas to that by the tableau, that time, and
    the difference from a step in one dense piece, p.u. and rad. Of each area counts the least time of ``runs`` states,
    both methods in turn.
    """
    areas = list(_find_areas(scenario))
    for size in sizes:
        with patch.object(pieces, "PIECE", size):
            found = [_compare(*area, runs) for area in areas]
        in_pieces_s, tableau_s, apart = zip(*found, strict=True)
        yield size, {"ratio": sum(in_pieces_s) / sum(tableau_s), "ms": 1e3 * sum(in_pieces_s), "apart": max(apart)}


def _find_areas(scenario: Scenario) -> Iterator[tuple[AreaModel, np.ndarray, Received]]:
    """Each area at the power flow, with what its neighbours send there."""
    partition, telemetry, states = scenario.partition, make_telemetry(scenario), {}
    assert telemetry.truth is not None  # readings of a network
    for area in partition.areas:
        reference, at = area.reference[0] if area.reference else None, partition.rows_of_nodes[area.name]
        model = build_area_model(area, telemetry.by_area[area.name], reference, backend="pieces")
        states[area.name] = model, area.join_state(telemetry.truth.vm[at], telemetry.truth.va[at])
    received: dict[str, dict[str, BoundaryInformation]] = {name: {} for name in states}
    for _ in states:  # a message passes one area each time
        told: dict[str, dict[str, BoundaryInformation]] = {name: {} for name in states}
        for name, (model, x) in states.items():
            for n in model.area.neighbours:
                told[n.area][name] = model.linear.information(x, n, received[name])
        received = told
    for name, (model, x) in states.items():
        yield model, x, received[name]


def _compare(model: AreaModel, x: np.ndarray, received: Received, runs: int) -> tuple[float, float, float]:
    """Least seconds of a step in pieces and by the tableau, and the difference from a step in one dense piece."""
    in_pieces, tableau = (make(model, SparseRows(model), "") for make in (ReducedSolver, TableauSolver))
    dense = ReducedSolver(model, DenseRows(model), "")
    apart = float(abs(in_pieces.step(x, received) - dense.step(x, received)).max())
    tableau.step(x, received)  # which finds what all states share
    states = [x * (1 + 1e-9 * k) for k in range(1, runs + 1)]
    found = [[_time_step(solver, state, received) for solver in (in_pieces, tableau)] for state in states]
    in_pieces_s, tableau_s = (min(of_solver) for of_solver in zip(*found, strict=True))
    return in_pieces_s, tableau_s, apart


def _time_step(solver: LinearArea, x: np.ndarray, received: Received) -> float:
    begin = time.process_time()
    solver.prepare(x)
    solver.step(x, received)
    return time.process_time() - begin


@click.command(context_settings={"show_default": True})
@click.option("--scenario", default="ieee123", help="A shipped scenario or a file; it is cut anew.")
@click.option("--runs", type=click.IntRange(1), default=RUNS, help="Timed steps of each area.")
@figures_option
def main(scenario: str, runs: int, figures: str | None) -> None:
    """Compare a step in pieces of 10 to 60 nodes with one by the sparse tableau: one area, and three."""
    machine, facts = describe_machine(PACKAGES), {}
    for name, text in machine.items():
        click.echo(f"{name}: {text}")
    for called, count in COUNTS.items():
        try:
            cut = dsse.load_scenario(scenario, changes={"areas": {"count": count}})
        except dsse.InvalidInputError as error:
            raise click.ClickException(str(error)) from None
        for size, found in compare_steps(cut, SIZES, runs):
            facts[f"{called}, pieces of {size} nodes"] = found
    click.echo("\n" + list_facts(facts))
    if figures:
        write_section(figures, machine, list_facts(facts))


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.pieces")
