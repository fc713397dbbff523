"""What the tree takes for determined is determined: round-off is no information."""

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.observability import check_observable
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.generate.feeder import generate_feeder

pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")

Kind = MeasurementKind
SIGMA = 1e-3


def draw_meters(network: Network, rng: np.random.Generator) -> list[Meter]:
    """Some of all meters, few of voltages."""
    share = rng.uniform(0.1, 0.6)
    ends = [(end, b.id) for b in network.active_branches for end in (b.from_bus, b.to_bus)]
    every = [
        *(Meter(kind, bus.id) for bus in network.buses for kind in (Kind.P_INJECTION, Kind.Q_INJECTION)),
        *(Meter(kind, end, branch) for end, branch in ends for kind in (Kind.P_FLOW, Kind.Q_FLOW)),
    ]
    voltages = [Meter(Kind.VM, bus.id) for bus in network.buses]
    return [*(m for m in every if rng.random() > share), *(m for m in voltages if rng.random() < share / 2)]


@pytest.mark.random_cases(few=1, long=6, many=6)
def test_whatever_is_measured_the_tree_finds_what_the_sparse_back_end_finds(random_seed: int):
    rng = np.random.default_rng(random_seed)
    served = 0
    for _ in range(80):
        network = generate_feeder(int(rng.choice([3, 5, 9, 17])), rng)[0]
        meters = draw_meters(network, rng)
        try:
            plan = build_estimation_plan(network, meters, backend="radial")
        except (NotObservableError, InvalidInputError):
            continue  # not determined, or not from the leaves upwards: the sparse back end says which
        check_observable(network, meters)
        values = solve_power_flow(network).read_all(meters) + SIGMA * rng.standard_normal(len(meters))
        sparse = build_estimation_plan(network, meters, backend="sparse")
        try:
            expected = estimate_with_plan(sparse, values, np.full(len(meters), SIGMA))
        except EstimationDivergedError:
            continue
        found = estimate_with_plan(plan, values, np.full(len(meters), SIGMA))
        np.testing.assert_allclose(found.vm, expected.vm, rtol=0, atol=1e-7)
        served += 1
    assert served > 5
