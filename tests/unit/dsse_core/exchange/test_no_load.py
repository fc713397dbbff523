"""Areas decide at no load as the centre does for the whole grid: what is observable, and which meters are critical."""

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import NotObservableError
from dsse_core.exchange.feeder_bad_data import build_no_load_model
from dsse_core.linear.boundary_information import BoundaryInformation
from dsse_core.observability import find_indispensable_rows
from tests.support.grids import MeterShares, make_grid
from tests.support.rings import make_ring_feeder

SCARCE = (  # one meter in thirty to spare; a few more; branches metered and most buses not
    MeterShares(flow=0.0, voltage=0.0),
    MeterShares(flow=0.1, voltage=0.05),
    MeterShares(flow=1.0, voltage=0.05, injection=0.3, boundary_injection=0.3),
)


def decide_centrally(feeder):
    """Unobservable buses, and indispensable meters."""
    meters = [m.meter for m in feeder.measurements]
    try:
        rows = find_indispensable_rows(feeder.network, meters)
    except NotObservableError as error:
        return set(error.buses), set()
    return set(), {meters[k].id for k in np.flatnonzero(rows)}


def decide_by_areas(feeder):
    """The same, found by the areas, and added up."""
    telemetry, partition = feeder.telemetry(), feeder.partition
    sides = {
        area.name: build_no_load_model(area, telemetry[area.name], area.reference[0] if area.reference else None)
        for area in partition.areas
    }

    def tell(sender: str, receiver: str) -> BoundaryInformation:
        neighbours = {n.area: n for n in partition.area(sender).neighbours}
        received = {name: tell(name, sender) for name in neighbours if name != receiver}
        return sides[sender].information_for(neighbours[receiver], received)

    unobservable, indispensable = set(), set()
    for area in partition.areas:
        nodes, meters = sides[area.name].examine({n.area: tell(n.area, area.name) for n in area.neighbours})
        unobservable |= {area.network.buses[node].id for node in nodes} - set(area.not_owned)
        indispensable |= meters
    return unobservable, set() if unobservable else indispensable


def without_some(feeder, share, seed):
    kept = np.random.default_rng(seed).random(len(feeder.measurements)) >= share
    return replace(feeder, measurements=tuple(m for m, k in zip(feeder.measurements, kept, strict=True) if k))


# buses, areas, share of chains, decades, loops, share of transformers, impedance of a short branch
NO_METER_BETWEEN = 1238, 9, 7, 0.6, 2.0, 2, 0.0, 1e-4  # an area without meters says nothing about the power behind it
ONE_COMBINATION = 1588, 19, 5, 0.3, 1.0, 2, 0.0, 1e-4  # of p and q is known, and the other is not
ONE_OF_SHORT_BRANCHES = 1528, 12, 7, 0.9, 1.0, 3, 0.0, 1e-6


@pytest.mark.parametrize(
    ("grid", "shares"),
    [
        (NO_METER_BETWEEN, MeterShares(voltage=0.0, angle=0.1, flow=0.3, current=0.2, boundary_injection=0.5)),
        (ONE_COMBINATION, MeterShares(voltage=0.3, flow=0.3, current=0.5, injection=0.7)),
        (ONE_OF_SHORT_BRANCHES, MeterShares(angle=0.1, flow=0.3, current=0.2, boundary_injection=0.5)),
    ],
)
def test_areas_pass_on_what_is_known_beside_what_is_not(grid, shares):
    feeder = make_grid(*grid, True, shares)
    assert decide_by_areas(feeder) == decide_centrally(feeder)


@pytest.mark.long
@pytest.mark.parametrize("shares", SCARCE)
@pytest.mark.parametrize("short", [None, 1e-4, 1e-6])
@pytest.mark.parametrize("seed", range(4))
def test_areas_find_what_the_centre_finds(seed, short, shares):
    grid = make_grid(seed, 30, 1 + seed, 0.6, 1.0, seed % 3, 0.15, short, True, shares)
    assert decide_by_areas(grid) == decide_centrally(grid)
    gap = without_some(grid, 0.1, seed)
    assert decide_by_areas(gap) == decide_centrally(gap)


@pytest.mark.parametrize("seed", range(6))
def test_areas_that_meet_at_several_buses_find_it_too(seed):
    feeder = make_ring_feeder(seed, 3, 1 + seed % 3)
    for share in (0.0, 0.2):
        some = without_some(feeder, share, seed)
        assert decide_by_areas(some) == decide_centrally(some)
