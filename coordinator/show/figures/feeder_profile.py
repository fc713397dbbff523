"""Axis of a voltage profile: distances from the substation."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from dsse_core.grid.network import Network


def find_distances(network: Network) -> tuple[np.ndarray, str]:
    """The smallest sum of |r + jx| from the substation to each bus, (n_bus,), inf where no branch leads; its label.

    The unit is ohm where the network has one voltage level, else p.u.
    """
    table = network.table
    assert network.slack is not None
    levels = np.unique(table.base_kv)
    ohm = float(levels[0]) ** 2 / network.base_mva if len(levels) == 1 else None
    size, n = abs(table.series[table.active]) * (ohm or 1.0), len(table.bus_id)
    nearest: dict[tuple[int, int], float] = {}
    for f, t, z in zip(table.f.tolist(), table.t.tolist(), size.tolist(), strict=True):
        pair = (min(f, t), max(f, t))
        nearest[pair] = min(z, nearest.get(pair, np.inf))  # of parallel branches
    ends = np.array(list(nearest), dtype=np.int32).reshape(-1, 2)  # int32, as the oldest supported scipy needs
    graph = coo_array((list(nearest.values()), (ends[:, 0], ends[:, 1])), shape=(n, n)).tocsr()
    found = dijkstra(graph, directed=False, indices=network.row[network.slack.bus])
    unit = "Ω" if ohm else f"p.u. on {network.base_mva:g} MVA"
    return np.asarray(found), f"distance from the substation, sum of |r + jx| ({unit})"
