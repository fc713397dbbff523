"""Since when a run stays close to the centralised estimate."""

from __future__ import annotations

import numpy as np
import pytest

from coordinator.lab.evaluation.convergence import find_time_below, gap_history
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.simulator.simulate import Simulation

NAN = float("nan")


def gaps(**areas: list[tuple[float, float, float]]) -> dict[str, np.ndarray]:
    return {name: np.array(rows).reshape(-1, 3) for name, rows in areas.items()}


def test_the_last_area_decides():
    found = gaps(a=[(1.0, 0.0, 0.0)], b=[(1.0, 1.0, 0.0), (2.0, 0.5, 0.0), (3.0, 0.0, 0.0)])
    assert find_time_below(found, 0.1) == 3.0
    assert find_time_below(found, 0.5) == 2.0


def test_a_gap_that_comes_back_does_not_count_as_closed():
    assert find_time_below(gaps(a=[(1.0, 0.0, 0.0), (2.0, 1.0, 0.0), (3.0, 0.0, 0.0)]), 0.1) == 3.0


def test_a_gap_that_stays_is_never_closed():
    assert find_time_below(gaps(a=[(1.0, 0.0, 0.0), (2.0, 1.0, 0.0)]), 0.1) is None


def test_angles_count_in_radians():
    found = gaps(a=[(1.0, 0.0, np.degrees(0.09)), (2.0, 0.0, np.degrees(0.04))])
    assert find_time_below(found, 0.1) == 1.0
    assert find_time_below(found, 0.05) == 2.0


def test_angles_that_do_not_count_from_the_substation_are_not_close():
    assert find_time_below(gaps(a=[(1.0, 0.0, NAN), (2.0, 0.0, 0.0)]), 0.1) == 2.0
    assert find_time_below(gaps(a=[(1.0, 0.0, NAN)]), 0.1) is None


def test_an_area_that_never_published_is_not_close():
    assert find_time_below(gaps(a=[(1.0, 0.0, 0.0)], b=[]), 0.1) is None


def test_a_run_ends_with_the_gap_that_its_verdict_states():
    simulation = Simulation(choose_scenario("ieee33", strategy="angle-offset"))
    outcome = simulation.evaluate(simulation.run())
    series = gap_history(outcome)
    assert list(series) == ["area1", "area2", "area3"]
    last = np.array([rows[-1] for rows in series.values()])
    assert last[:, 1] == pytest.approx([area.gap_vm_pu for area in outcome.area_results])
    assert last[:, 2] == pytest.approx([area.gap_va_deg for area in outcome.area_results])
