"""The compiled walk over a tree and that over a graph of scipy: both put every bus behind the one above it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from dsse_core.grid.radial_order import walk_graph

pytest.importorskip("numba")
from dsse_core.radial.walk import find_order

Walk = Callable[[np.ndarray, np.ndarray, int, int], tuple[np.ndarray, np.ndarray]]


def walk_edges(f: np.ndarray, t: np.ndarray, top: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    return walk_graph(sp.csr_array((np.ones(len(f)), (f, t)), shape=(n, n)), top)


WALKS = pytest.mark.parametrize("walk", [find_order, walk_edges])


def draw_tree(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, int]:
    """A random tree: its branches in random order and direction, and its top."""
    rng = np.random.default_rng(seed)
    name = rng.permutation(n)
    below = np.arange(1, n)
    ends = np.stack([name[below], name[rng.integers(0, below)]])
    turned = np.where(rng.random(n - 1) < 0.5, ends, ends[::-1])[:, rng.permutation(n - 1)]
    return turned[0].astype(np.int64), turned[1].astype(np.int64), int(name[0])


@WALKS
@pytest.mark.parametrize("seed", range(20))
def test_no_bus_precedes_the_one_above_it_and_no_subtree_is_torn_apart(walk: Walk, seed: int) -> None:
    n = 1 + 7 * seed
    f, t, top = draw_tree(n, seed)
    order, upstream = walk(f, t, top, n)
    place = np.argsort(order)
    assert sorted(order.tolist()) == list(range(n))
    assert order[0] == top == upstream[top]
    joined = {frozenset(pair) for pair in zip(f.tolist(), t.tolist(), strict=True)}
    assert {frozenset((row, int(upstream[row]))) for row in range(n) if row != top} == joined
    size = np.ones(n, dtype=int)
    for row in order[:0:-1].tolist():
        size[upstream[row]] += size[row]
    for row in order[1:].tolist():
        above = int(upstream[row])
        assert place[above] < place[row]
        assert place[row] + size[row] <= place[above] + size[above]


@WALKS
def test_a_loop_and_what_is_out_of_reach_end_the_walk(walk: Walk) -> None:
    f, t = np.array([0, 1, 2, 3]), np.array([1, 2, 0, 4])
    order, _ = walk(f, t, 0, 5)
    assert sorted(order.tolist()) == [0, 1, 2]


@WALKS
def test_a_bus_alone_is_a_tree(walk: Walk) -> None:
    order, upstream = walk(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), 0, 1)
    assert order.tolist() == upstream.tolist() == [0]
