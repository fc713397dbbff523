"""The inverse on a tree of blocks: it is that of dense matrices, and declines what is no such tree."""

import numpy as np
import pytest
import scipy.sparse as sp

from dsse_core.matrices.block_tree import find_block_tree


def make_tree(rng, n_block, singular=-1):
    """A symmetric indefinite matrix with blocks of 1 to 5 rows, those of a tree, and the block of each of its rows."""
    size = rng.integers(1, 6, n_block)
    first = np.cumsum(size) - size
    A = np.zeros((size.sum(), size.sum()))
    for i in range(n_block):
        here = slice(first[i], first[i] + size[i])
        A[here, here] = 0.0 if i == singular else np.diag(rng.choice([-3.0, 3.0], size[i]))
        if i + 1 < n_block:
            p = int(rng.integers(i + 1, n_block))
            up = slice(first[p], first[p] + size[p])
            A[here, up] = 0.3 * rng.standard_normal((size[i], size[p]))
            A[up, here] = A[here, up].T
    return A, np.repeat(np.arange(n_block), size)


@pytest.mark.parametrize("seed", range(4))
def test_entries_of_blocks_and_to_their_parents_are_those_of_the_dense_inverse(seed):
    rng = np.random.default_rng(seed)
    A, block = make_tree(rng, int(rng.integers(1, 40)))
    tree = find_block_tree(sp.csc_array(A), block)
    assert tree is not None
    rows, columns = (part.ravel() for part in np.indices(A.shape))
    found, wrong = tree.find_inverse(sp.csc_array(A), rows, columns)
    i, p = block[rows], block[columns]
    near = (i == p) | (tree.parent[i] == p) | (tree.parent[p] == i)
    assert (np.isnan(found) == ~near).all()
    assert not wrong.any()
    np.testing.assert_allclose(found[near], np.linalg.inv(A)[rows, columns][near], rtol=1e-9, atol=1e-12)


def test_rows_of_a_block_may_stand_apart():
    A, block = make_tree(np.random.default_rng(5), 12)
    shuffled = np.random.default_rng(6).permutation(len(block))
    tree = find_block_tree(sp.csc_array(A[np.ix_(shuffled, shuffled)]), block[shuffled])
    assert tree is not None
    diagonal = np.arange(len(block))
    found, _ = tree.find_inverse(sp.csc_array(A[np.ix_(shuffled, shuffled)]), diagonal, diagonal)
    np.testing.assert_allclose(found, np.diag(np.linalg.inv(A))[shuffled], rtol=1e-9)


def test_a_loop_of_blocks_and_two_trees_are_none():
    A, block = np.diag([3.0, 3.0, 3.0]), np.arange(3)
    assert find_block_tree(sp.csc_array(A), block) is None
    A[0, 1] = A[0, 2] = A[1, 2] = 1.0
    assert find_block_tree(sp.csc_array(A + A.T), block) is None


def test_of_a_singular_block_nothing_is_found():
    A, block = make_tree(np.random.default_rng(7), 6, singular=0)
    tree = find_block_tree(sp.csc_array(A), block)
    assert tree is not None
    found, wrong = tree.find_inverse(sp.csc_array(A), np.array([0]), np.array([0]))
    assert np.isnan(found).all()
    assert wrong.all()
