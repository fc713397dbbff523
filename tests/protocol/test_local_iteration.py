"""The steps of one area before all have been heard: they stay where the start guides them, whatever is heard."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_bus import SimulatedBus, area_files_of

from agents.strategies.information import Information
from agents.strategies.local_iteration import LocalIteration
from dsse_core.area_model import AreaModel
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange import DAMPING
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

SCENARIO = load_scenario("ieee33")


@pytest.fixture
def settled() -> Information:
    """What area2, with area1 as its neighbour, has come to."""
    bus = SimulatedBus(area_files_of(SCENARIO, strategy="information"), make_telemetry(SCENARIO).by_area)
    bus.run_until_settled()
    strategy = bus.protocols["area2"]._strategy
    assert isinstance(strategy, Information)
    return strategy


def test_a_word_that_knows_a_dead_grid_for_sure_does_not_lead_there(settled):
    model, start = settled._model, settled._iteration.x
    assert isinstance(model, AreaModel)
    dead = BoundaryInformation(np.diag([0.0, 0.0, 1e6, 0.0]), np.zeros(4))
    iteration = LocalIteration()
    iteration.begin_at(start)
    for _ in range(100):
        shown = iteration.step_near_start(model, {"area1": dead})
        for x in (shown, iteration.x):
            assert abs(x - start)[: 2 * len(model.area.network.buses)].max() <= DAMPING


def test_a_word_that_fits_is_followed(settled):
    model, start = settled._model, settled._iteration.x
    assert isinstance(model, AreaModel)
    near = BoundaryInformation(np.diag([0.0, 0.0, 1e6, 0.0]), np.array([0.0, 0.0, 0.9e6, 0.0]))
    iteration = LocalIteration()
    iteration.begin_at(start)
    iteration.step_near_start(model, {"area1": near})
    assert iteration.x[model.voltage_columns(model.area.neighbours[0])[0]] == pytest.approx(0.9, abs=0.02)
