"""Compiled elimination: the solutions and entries of the inverse are those of dense matrices, with any pivots."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

pytest.importorskip("numba")
compiled_factor = pytest.importorskip("dsse_core.matrices.compiled_factor", exc_type=ImportError)
pytestmark = pytest.mark.slow  # it compiles


def make_matrix(seed: int, n: int = 60, density: float = 0.05) -> sp.csc_array:
    """Symmetric, with zeros on its diagonal that have their places, so that pivots are chosen elsewhere."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < density)
    A[np.arange(n), rng.permutation(n)] += rng.uniform(1, 2, n)
    A[:5] = np.sign(A[:5])  # so that entries cancel on the way
    A += A.T
    A[np.arange(0, n, 2), np.arange(0, n, 2)] = 0.0
    rows, columns = np.nonzero((A != 0) | np.eye(n, dtype=bool))
    return sp.csc_array((A[rows, columns], (rows, columns)), shape=(n, n))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("pivot", [0.1, 1.0])
def test_solutions_and_the_diagonal_of_the_inverse_are_those_of_dense_matrices(seed: int, pivot: float) -> None:
    A = make_matrix(seed)
    factor, n = compiled_factor.factor_compiled(A, pivot), A.shape[0]
    b = np.random.default_rng(seed).normal(size=(n, 3))
    inverse = np.linalg.inv(A.toarray())
    atol = 1e-9 * abs(inverse).max()
    np.testing.assert_allclose(factor.solve(b), inverse @ b, rtol=1e-9, atol=atol)
    np.testing.assert_allclose(factor.solve(b[:, 0]), inverse @ b[:, 0], rtol=1e-9, atol=atol)
    diagonal, wrong = factor.find_inverse(A, np.arange(n), np.arange(n))
    assert wrong.sum() < n / 4
    np.testing.assert_allclose(diagonal[~wrong], np.diag(inverse)[~wrong], rtol=1e-9, atol=atol)


@pytest.mark.parametrize("seed", range(20))
def test_another_matrix_of_the_pattern_is_eliminated_by_the_same_pivots_or_by_better_ones(seed: int) -> None:
    A, rng = make_matrix(seed), np.random.default_rng(seed)
    known = compiled_factor.factor_compiled(A, 0.1).elimination
    near, far = A.copy(), A.copy()
    near.data *= rng.uniform(0.999, 1.001, len(A.data))
    far.data = np.where(A.data != 0, rng.normal(size=len(A.data)) * 10.0 ** rng.uniform(-6, 0, len(A.data)), 0.0)
    b = rng.normal(size=A.shape[0])
    for matrix in (near, far):
        factor = compiled_factor.factor_compiled(matrix, 0.1, known)
        x = factor.solve(b)
        np.testing.assert_allclose(matrix @ x, b, rtol=0, atol=1e-9 * max(1.0, abs(x).max()))
    assert compiled_factor.factor_compiled(near, 0.1, known).elimination is known
    assert compiled_factor.factor_compiled(far, 0.1, known).elimination is not known


def test_a_singular_matrix_is_an_error() -> None:
    A = make_matrix(1)
    A.data[A.indptr[7] : A.indptr[8]] = 0.0
    with pytest.raises(RuntimeError, match="singular"):
        compiled_factor.factor_compiled(A, 0.1)
    known = compiled_factor.factor_compiled(make_matrix(1), 0.1).elimination
    with pytest.raises(RuntimeError, match="singular"):
        compiled_factor.factor_compiled(A, 0.1, known)


def test_entries_of_another_matrix_than_the_factors_are_reported_as_wrong() -> None:
    A = make_matrix(1)
    other = A.copy()
    other.data[np.flatnonzero(other.data)[0]] *= 1 + 1e-6
    everywhere = np.arange(A.shape[0])
    assert compiled_factor.factor_compiled(A, 0.1).find_inverse(other, everywhere, everywhere)[1].any()
