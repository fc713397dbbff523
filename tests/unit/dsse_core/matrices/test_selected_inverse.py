"""The selected inverse: the same diagonal as that of the whole inverse, or None."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.matrices import augmented, selected_inverse
from dsse_core.matrices.augmented import AugmentedFactor
from dsse_core.matrices.selected_inverse import find_inverse_diagonal


def make_matrix(seed: int, n: int = 60, density: float = 0.05) -> sp.csc_array:
    """Unsymmetric, with zeros on its diagonal, so that pivots are chosen elsewhere."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < density)
    A[np.arange(n), rng.permutation(n)] += rng.uniform(1, 2, n)
    A[:5] = np.sign(A[:5])  # so that entries cancel on the way
    return sp.csc_array(A)


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
