"""Redundancies found from random readings, beside the exact residual variances of the same rows."""

import numpy as np
import pytest

from dsse_core.exchange.feeder_bad_data import NO_LOAD_REDUNDANCY, build_no_load_model
from dsse_core.linear import make_no_load
from dsse_core.linear.no_load import DRAWS
from dsse_core.matrices.augmented import AugmentedFactor
from dsse_core.observability import find_indispensable
from tests.support.feeders import make_feeder
from tests.support.grids import MeterShares, make_grid

LEAST, MOST = 0.2, 3.0  # of a mean square of 32 normal numbers: outside with a probability of 3e-7
ROUND_OFF = 1e-13  # of a residual of readings of size 1; found: 2e-15
SCARCE = (  # one meter in thirty to spare; a few more; branches metered and most buses not
    MeterShares(flow=0.0, voltage=0.0),
    MeterShares(flow=0.1, voltage=0.05),
    MeterShares(flow=1.0, voltage=0.05, injection=0.3, boundary_injection=0.3),
)


@pytest.mark.slow
@pytest.mark.parametrize("shares", SCARCE)
@pytest.mark.parametrize("seed", range(4))
def test_a_sampled_redundancy_is_the_exact_one_to_a_factor_and_of_what_cannot_be_spared_the_square_of_round_off(
    seed, shares
):
    """With all that the other area knows. What cannot be spared is decided for the whole grid, by other code."""
    grid = make_grid(seed, 30, 2, 0.6, 1.0, seed % 3, 0.15, None, True, shares)
    telemetry, reference = grid.telemetry(), grid.network.slack.bus
    needed = find_indispensable(grid.network, [m.meter for m in grid.measurements], reference)
    sides = {
        area.name: build_no_load_model(area, telemetry[area.name], area.reference[0] if area.reference else None)
        for area in grid.partition.areas
    }
    for name, other in (tuple(sides), tuple(sides)[::-1]):
        side = sides[name]
        (to_us,) = sides[other].model.area.neighbours
        received = {other: sides[other].information_for(to_us, {})}
        model = side.model
        linear = make_no_load(model)
        sampled = linear.sample(side.x, received, np.random.default_rng(seed))[1]
        H, _, sigma = linear.stack(side.x, received)
        omega = linear.factor(H, sigma, model.free).residual_variance()[: len(model.z)]  # of virtual rows, too
        exact = omega / model.sigma**2
        is_needed = np.array([meter in needed for meter in side.ids])
        assert (sampled[is_needed] < ROUND_OFF**2).all()
        ratio = sampled[~is_needed] / exact[~is_needed]
        assert ((ratio > LEAST) & (ratio < MOST)).all()


def test_no_more_is_drawn_than_shows_that_every_meter_can_be_spared(monkeypatch):
    feeder = make_feeder(1, n_bus=40, n_area=1, decades=1.0, dense=1.0)
    (area,) = feeder.partition.areas
    side = build_no_load_model(area, feeder.telemetry()[area.name], area.reference[0])
    solved: list[int] = []
    solve = AugmentedFactor.solve
    monkeypatch.setattr(AugmentedFactor, "solve", lambda *given: solved.append(given[1].shape[1]) or solve(*given))
    unobservable, indispensable = side.examine({})
    assert (unobservable, indispensable) == ((), frozenset())
    assert sum(solved) < DRAWS


@pytest.mark.parametrize("seed", range(4))
def test_what_cannot_be_spared_does_not_depend_on_when_drawing_ends(seed):
    grid = make_grid(seed, 30, 1, 0.6, 1.0, seed % 3, 0.15, None, True, SCARCE[0])
    (area,) = grid.partition.areas
    side = build_no_load_model(area, grid.telemetry()[area.name], area.reference[0])
    _, indispensable = side.examine({})
    _, redundancy = side.linear.sample(side.x, {}, np.random.default_rng(0))
    assert indispensable
    assert indispensable == {side.ids[k] for k in np.flatnonzero(redundancy < NO_LOAD_REDUNDANCY)}
