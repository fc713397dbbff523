"""The dense factor of an area's rows, where next to nothing but damping determines a variable."""

from __future__ import annotations

import numpy as np
import pytest

from dsse_core.matrices.augmented import raise_damping
from dsse_core.matrices.augmented_dense import DenseFactor


def a_busbar_between_neighbours():
    """H, sigma, damping of a voltage behind 1e-6 p.u. and of the power into three neighbours at no load.

    Nothing is known of the first, of the second one sum; rounding is larger than the damping of it.
    """
    p, q, typical = 469799.0, 671141.0, 819232.0
    H = np.array(
        [
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [p, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [q, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [-p, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0],
            [-q, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0],
            [0.0, 0.0, 0.0, 0.00128, 0.00183, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.011, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.011],
        ]
    )
    sigma = np.array([1.0, typical, typical, typical, typical, 1.0, 1.0, 1.0])
    return H, sigma, 1e-18 * np.minimum((H * H).T @ sigma**-2.0, 1.0)


def test_damping_that_rounding_swallows_leaves_no_variance_beyond_what_it_allows():
    H, sigma, damping = a_busbar_between_neighbours()
    variance = DenseFactor(H, sigma, damping).state_variance()
    assert np.all(variance > 0)
    assert np.all(variance <= 1.001 / damping.min())


def test_damping_is_raised_where_it_is_least():
    np.testing.assert_allclose(raise_damping(np.array([1e-20, 1e-15, 4e-18])), [1e-17, 1e-15, 1e-17])
    with pytest.raises(RuntimeError, match="singular"):
        raise_damping(np.array([1e-5, 1e-4]))
