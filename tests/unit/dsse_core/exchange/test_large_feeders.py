"""Areas of a feeder of many nodes, whose houses have split-phase secondaries behind centre-tapped transformers."""

from __future__ import annotations

import numpy as np
import pytest

from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.division import build_partition
from dsse_core.results.deviations.choose import find_deviations
from scenarios.generate.cutting import cut_into
from tests.support.centre import assert_goes_the_centres_way
from tests.support.ieee_feeders.placing import place_meters
from tests.support.levels import further
from tests.support.random_phases import make_large_feeder


@pytest.mark.parametrize("n_lateral", [6, *further(80)])
def test_areas_of_laterals_with_centre_tapped_transformers_go_the_centres_way(n_lateral: int) -> None:
    """18 nodes for each lateral, some 120 an area."""
    network = make_large_feeder(np.random.default_rng(1), n_lateral)
    partition = build_partition(network, cut_into(network, max(3, n_lateral // 7)))
    assert_goes_the_centres_way(partition, place_meters(network, 1, None, is_rich=False))


@pytest.mark.long
def test_standard_deviations_of_a_large_feeder_are_those_of_solutions_one_by_one() -> None:
    network = make_large_feeder(np.random.default_rng(1), 80)
    result = process_bad_data(network, place_meters(network, 1, None, is_rich=False)).result
    found, n = find_deviations(result), network.n_nodes
    rows = np.random.default_rng(2).choice(2 * n, 40, replace=False)
    expected = np.sqrt(np.diag(result.state_covariance(rows.tolist())))
    np.testing.assert_allclose(np.concatenate([found.va, found.vm])[rows], expected, rtol=1e-6, atol=1e-12)
