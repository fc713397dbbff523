"""Fast decoupled estimation, by which transmission systems save time, and what becomes of it where R is as large as X.

The two forms of the literature (Garcia, Monticelli and Abreu 1979; Monticelli and Garcia 1990): active powers move
angles, then reactive powers and voltmeters magnitudes, with matrices that are factorised once, at the flat start.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

ACTIVE = (MeasurementKind.P_INJECTION, MeasurementKind.P_FLOW)
MOST = 200


def scale_resistances(network: Network, factor: float) -> Network:
    branches = [replace(branch, r=factor * branch.r) for branch in network.branches]
    return Network(network.name, network.base_mva, network.buses, branches, network.generators)


def iterate_decoupled(network: Network, readings: list[Measurement], at_flat: Network) -> tuple[int, np.ndarray]:
    """Iterations to steps below 1e-6 and the state; MOST if they swing, fewer if they leave for nowhere.

    ``at_flat``: the network of the constant matrices.
    """

    def model_of(grid: Network) -> MeasurementModel:
        return build_measurement_model(grid, build_admittance(grid), [reading.meter for reading in readings])

    assert network.slack is not None
    n, model = len(network.buses), model_of(network)
    z, sigma = np.array([(reading.value, reading.sigma) for reading in readings]).T
    x = np.r_[np.zeros(n), np.ones(n)]
    whole = model_of(at_flat).jacobian(x).toarray()
    active = np.array([reading.meter.kind in ACTIVE for reading in readings])
    angles = np.delete(np.arange(n), network.row[network.slack.bus])
    halves = [
        (rows, columns, whole[np.ix_(rows, columns)] / sigma[rows, None])
        for rows, columns in ((np.flatnonzero(active), angles), (np.flatnonzero(~active), np.arange(n, 2 * n)))
    ]
    for k in range(1, MOST):
        steps = []
        for rows, columns, H in halves:
            residual = (z - model.predict(x))[rows] / sigma[rows]
            steps.append(np.linalg.solve(H.T @ H, H.T @ residual))
            x[columns] += steps[-1]
        size = max(abs(step).max() for step in steps)
        if size < 1e-6 or not size < 1e3:
            return k, x
    return MOST, x


@pytest.mark.parametrize(
    ("factor", "kept", "without"),
    [(0.1, 6, 7), (1.0, None, 80)],  # iterations with resistances in the matrices, and without; None: diverges
)
def test_fast_decoupled_estimation_fails_at_the_resistances_of_a_feeder(factor: float, kept: int | None, without: int):
    scenario = load_scenario("ieee33")
    network = scale_resistances(scenario.network, factor)
    flow, readings = solve_power_flow(network), make_telemetry(scenario).union
    exact = flow.read_all([reading.meter for reading in readings])
    readings = [replace(r, value=float(value)) for r, value in zip(readings, exact, strict=True)]
    assert estimate_state(network, readings).iterations == 4
    count, x = iterate_decoupled(network, readings, network)
    assert count == kept if kept else abs(x).max() > 1e3
    count, x = iterate_decoupled(network, readings, scale_resistances(network, 0.0))
    assert count == without
    np.testing.assert_allclose(x[len(flow.vm) :], flow.vm, rtol=0, atol=1e-5)


def test_the_ratio_of_the_feeder_is_that_of_the_page():
    branches = [branch for branch in load_scenario("ieee33").network.branches if branch.in_service]
    assert np.median([branch.r / branch.x for branch in branches]) == pytest.approx(1.27, abs=0.01)
