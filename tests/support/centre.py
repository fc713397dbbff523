"""The centre's estimate of a network with phases beside that of its areas: its way, and what it finds of meters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import numpy as np

from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.decision import Verdict
from dsse_core.estimation.estimator import WholeGrid
from dsse_core.exchange.feeder_bad_data import count_freedom, find_objective
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from tests.support.phases import Rounds, run_rounds

GAP = 1e-9  # p.u. and rad
SIGMA = 1e-6  # relative


@contextmanager
def traced_centre() -> Iterator[tuple[list[str], list[np.ndarray]]]:
    """The verdicts that the centre carries out meanwhile, and x after each."""
    verdicts, states, original = list[str](), list[np.ndarray](), WholeGrid.carry_out

    def carry_out(self: WholeGrid, verdict: Verdict) -> None:
        original(self, verdict)
        verdicts.append(str(verdict))
        states.append(self.x)

    with mock.patch.object(WholeGrid, "carry_out", carry_out):
        yield verdicts, states


def trace_centre(
    network: Network, readings: Sequence[Measurement]
) -> tuple[BadDataReport, list[str], list[np.ndarray]]:
    """The centre's report, its verdicts, and x after each."""
    with traced_centre() as (verdicts, states):
        return process_bad_data(network, readings), verdicts, states


def assert_is_the_centres(
    rounds: Rounds, partition: Partition, report: BadDataReport, sigma: float = SIGMA, least: float = 1e-12
) -> None:
    """Voltages, J, degrees of freedom, removed and critical meters are the centre's, and so are sigmas.

    Sigmas at their last linearisation, to ``sigma``, relative, or to ``least``, p.u. and rad.
    """
    x, n, result = np.r_[report.result.va, report.result.vm], partition.network.n_nodes, report.result
    before = x.copy()
    for name, rows in partition.rows_of_nodes.items():
        columns, side = np.r_[rows, n + rows], rounds.estimations[name]
        assert abs(rounds.states[-1][name] - x[columns]).max() < GAP
        before[columns] = side.linearized_at[: 2 * len(rows)]
    sigma_vm, sigma_va = replace(result, va=before[:n], vm=before[n:]).state_sigma()
    critical: set[str] = set()
    for name, rows in partition.rows_of_nodes.items():
        own_vm, own_va, of_area = rounds.estimations[name].find_sigmas()
        np.testing.assert_allclose(own_vm, sigma_vm[rows], rtol=sigma, atol=least)
        np.testing.assert_allclose(own_va, sigma_va[rows], rtol=sigma, atol=least)
        critical |= {*of_area}
    models = [(side.model, side.x) for side in rounds.estimations.values()]
    np.testing.assert_allclose(sum(find_objective(*of) for of in models), report.objective, rtol=1e-6, atol=1e-9)
    assert sum(count_freedom(model) for model, _ in models) == report.degrees_of_freedom
    assert rounds.memory.removed == tuple(removed.measurement.meter.id for removed in report.removed)
    assert critical == {*report.critical}


def assert_goes_the_centres_way(
    partition: Partition, readings: Sequence[Measurement], sigma: float = SIGMA, least: float = 1e-12
) -> list[float]:
    """The centre decides the same, and its end is theirs; returns the largest difference of x after each verdict."""
    report, verdicts, states = trace_centre(partition.network, readings)
    rounds = run_rounds(partition, readings)
    before = ["", *rounds.verdicts]
    kept = [
        k for k in range(len(rounds.verdicts)) if not before[k].startswith("evaluate")
    ]  # then the centre has a new plan
    assert [rounds.verdicts[k].split()[0] for k in kept] == [verdict.split()[0] for verdict in verdicts]
    assert_is_the_centres(rounds, partition, report, sigma, least)
    n, rows = partition.network.n_nodes, partition.rows_of_nodes
    gaps = [
        float(max(abs(of_areas[k] - x[np.r_[at, n + at]]).max() for k, at in rows.items()))
        for of_areas, x in zip([rounds.states[k] for k in kept], states, strict=True)
    ]
    assert max(gaps) < 1e-7
    return gaps
