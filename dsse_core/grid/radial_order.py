"""Radial networks: their buses from the root outwards, and the order of elimination that fills nothing in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.network import Network

_INJECTIONS = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)


@dataclass(frozen=True)
class Tree:
    """A radial network by rows, not ids. ``order`` (n_bus,): from the root, a subtree in one piece. ``upstream``
    (n_bus,): the row next on the way to the root; the root's is its own. ``f``, ``t``: ends of the branches in service.
    """

    order: np.ndarray
    upstream: np.ndarray
    f: np.ndarray
    t: np.ndarray


def find_tree(network: Network, root: int) -> Tree | str:
    """The tree of the network below bus ``root``, or, as text, why it is none."""
    table = network.table
    f, t, n = table.f, table.t, len(table.bus_id)
    if len(f) != n - 1:
        return f"the network is not radial: {n} buses, {len(f)} branches in service"
    top = int(table.rows.find(np.array([root]))[0])
    graph = sp.csr_array((np.ones(len(f)), (f, t)), shape=(n, n))
    order, upstream = csgraph.depth_first_order(graph, top, directed=False, return_predecessors=True)
    if len(order) != n:
        return f"the network is not radial: {n - len(order)} buses are out of reach of bus {root}"
    upstream = upstream.astype(np.int64)
    upstream[top] = top
    return Tree(order.astype(np.int64), upstream, f, t)


def order_tableau(tree: Tree, model: MeasurementModel, free: np.ndarray) -> np.ndarray:
    """Rows of the tableau [meters; state variables ``free``] from the leaves to the root, shape (n_meas + n_free,).

    Inside a bus: its injections, what else is metered there and on the branch above it, then its voltage.
    """
    n = len(tree.order)
    place = np.empty(n, dtype=np.int64)
    place[tree.order[::-1]] = np.arange(n)
    injections = np.isin(model.kinds, _INJECTIONS)
    outermost = np.minimum.reduceat(place[model.y.indices], model.y.indptr[:-1]) if len(injections) else injections
    of_meter = np.where(injections, 3 * place[model.bus_row], 3 * outermost + 1)
    return np.argsort(np.concatenate([of_meter, 3 * place[free % n] + 2]), kind="stable")
