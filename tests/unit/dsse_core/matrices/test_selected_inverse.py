"""The selected inverse: the same diagonal as that of the whole inverse, or None."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.matrices import augmented, selected_inverse
from dsse_core.matrices.augmented import AugmentedFactor


def make_matrix(seed: int, n: int = 60, density: float = 0.05) -> sp.csc_array:
    """Unsymmetric, with zeros on its diagonal, so that pivots are chosen elsewhere."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < density)
    A[np.arange(n), rng.permutation(n)] += rng.uniform(1, 2, n)
    A[:5] = np.sign(A[:5])  # so that entries cancel on the way
    return sp.csc_array(A)


def find_inverse_diagonal(A: sp.csc_array, lu: spla.SuperLU) -> np.ndarray | None:
    everywhere = np.arange(A.shape[0])
    return selected_inverse.find_inverse_entries(A, lu, everywhere, everywhere)


@pytest.mark.parametrize("seed", range(20))
def test_it_is_the_diagonal_of_the_inverse(seed: int):
    A = make_matrix(seed)
    expected = np.diag(np.linalg.inv(A.toarray()))
    found = find_inverse_diagonal(A, spla.splu(A))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_factors_that_are_too_full_are_left_to_the_solves(monkeypatch):
    A = make_matrix(1)
    monkeypatch.setattr(selected_inverse, "MOST_PRODUCTS", 100)
    assert find_inverse_diagonal(A, spla.splu(A)) is None


def test_what_has_lost_its_digits_is_left_to_the_solves():
    A = make_matrix(1)
    other = A.copy()
    other.data[0] *= 1 + 1e-6
    assert find_inverse_diagonal(A, spla.splu(A)) is not None
    assert find_inverse_diagonal(other, spla.splu(A)) is None


@pytest.mark.parametrize("seed", range(5))
def test_places_are_closed_in_one_pass_and_a_limit_ends_it(monkeypatch, seed):
    n, rng = 40, np.random.default_rng(seed)
    key = np.unique(np.concatenate([np.arange(n) * (n + 1), rng.integers(0, n * n, 120)]))
    there = np.zeros((n, n), dtype=bool)
    there.ravel()[key] = True
    looked_at = 0
    for k in range(n):
        below, right = there[k + 1 :, k], there[k, k + 1 :]
        looked_at += int(below.sum() * right.sum())
        there[k + 1 :, k + 1 :] |= np.outer(below, right)
    places = selected_inverse.Places.closed(key, n)
    np.testing.assert_array_equal(places.key, np.flatnonzero(there))
    assert len(places.product) == looked_at
    monkeypatch.setattr(selected_inverse, "MOST_PRODUCTS", looked_at - 1)
    assert selected_inverse.Places.closed(key, n) is None


def test_no_round_over_all_products_is_done_twice(monkeypatch):
    passes = []
    of_places = selected_inverse.Places._products
    monkeypatch.setattr(selected_inverse.Places, "_products", lambda p: passes.append(p) or of_places(p))
    A = make_matrix(1)
    find_inverse_diagonal(A, spla.splu(A))
    assert len(passes) == 1


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_variances_are_those_of_the_solves(monkeypatch, damping: float):
    rng = np.random.default_rng(3)
    H = sp.csr_array(rng.normal(size=(50, 30)) * (rng.random((50, 30)) < 0.15) + np.eye(50, 30))
    sigma = rng.uniform(1e-4, 1e-1, 50)
    sigma[:3] = 0.0
    by_solves = AugmentedFactor(H, sigma, damping)
    expected = by_solves.state_variance(), by_solves.residual_variance()
    monkeypatch.setattr(augmented, "FEWEST_SELECTED", 0)
    monkeypatch.setattr(augmented, "BLOCK", 0)  # no solves
    selected = AugmentedFactor(H, sigma, damping)
    np.testing.assert_allclose(selected.state_variance(), expected[0], rtol=1e-9)
    np.testing.assert_allclose(selected.residual_variance(), expected[1], rtol=1e-9, atol=1e-20)
