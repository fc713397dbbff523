"""The buses of a tree from its root outwards, compiled: for a small tree a graph of scipy would take longest."""

from __future__ import annotations

import numpy as np

from dsse_core.code_cache import compiled


@compiled
def find_order(f, t, top, n):
    """Rows reached from ``top``, in depth-first order, and ``upstream`` (n,), -1 where a row is not reached.

    Otherwise as ``radial_order.walk_graph``.
    """
    order, upstream = np.empty(n, dtype=np.int64), np.full(n, -1)
    count = _walk(f, t, top, order, upstream)
    return order[:count], upstream


@compiled
def _walk(f, t, top, order, upstream):
    """Fills ``order`` with the rows that are reached, and ``upstream`` (n_bus,); returns the number of these rows.

    Rows that are not reached keep -1. A row that has been found already is passed over, so that loops end.
    """
    n = len(upstream)
    first = np.zeros(n + 2, dtype=np.int64)  # of the neighbours of a row, as soon as they are counted and placed
    for k in range(len(f)):
        first[f[k] + 2] += 1
        first[t[k] + 2] += 1
    for i in range(2, n + 2):
        first[i] += first[i - 1]
    neighbour = np.empty(2 * len(f), dtype=np.int64)
    for k in range(len(f)):
        neighbour[first[f[k] + 1]] = t[k]
        first[f[k] + 1] += 1
        neighbour[first[t[k] + 1]] = f[k]
        first[t[k] + 1] += 1
    waiting, n_waiting, count = np.empty(n, dtype=np.int64), 1, 0
    waiting[0], upstream[top] = top, top
    while n_waiting > 0:
        n_waiting -= 1
        row = waiting[n_waiting]
        order[count] = row
        count += 1
        for k in range(first[row + 1] - 1, first[row] - 1, -1):
            if upstream[neighbour[k]] < 0:
                upstream[neighbour[k]] = row
                waiting[n_waiting] = neighbour[k]
                n_waiting += 1
    return count
