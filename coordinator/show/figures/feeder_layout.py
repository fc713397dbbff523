"""Layout of a feeder's one-line diagram: the trunk in the middle, its laterals above and below.

Columns count branches from the substation. The longest path outwards from a bus continues in its row. Every other
branch turns off into the nearest row that is free from there outwards, so that no two lines cross. Branches that close
loops are ignored. The time grows linearly with the number of buses, since a lateral is never longer than the path that
continues. A section without supply hangs at a branch that would feed it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.columns import read_given
from dsse_core.grid.network import Network


@dataclass(frozen=True)
class Layout:
    """``place`` (n_bus, 2): column and row of each bus, in network order; ``upstream``: bus -> the next bus inwards."""

    place: np.ndarray
    upstream: dict[int, int]


def lay_out(network: Network) -> Layout:
    """Layout of a network, all of whose buses the substation reaches by closed or open branches."""
    assert network.slack is not None
    root = network.slack.bus
    upstream = _walk(network, root)
    order = list(upstream)
    height = dict.fromkeys(order, 1)
    for bus in reversed(order[1:]):
        height[upstream[bus]] = max(height[upstream[bus]], height[bus] + 1)
    children: dict[int, list[int]] = {bus: [] for bus in order}
    for bus in order[1:]:
        children[upstream[bus]].append(bus)
    for row in children.values():
        row.sort(key=height.__getitem__, reverse=True)
    trunk = [root]
    while children[trunk[-1]]:
        trunk.append(children[trunk[-1]][0])
    offset = _stack(order, children, set(trunk))
    place = np.zeros((len(order), 2))
    for bus in order[1:]:
        column, row = place[network.row[upstream[bus]]]
        sign = -1 if row < 0 else 1  # mirrored above the trunk
        place[network.row[bus]] = column + 1, row + sign * offset[bus]
    return Layout(place, upstream)


def find_places(network: Network) -> np.ndarray | None:
    """The coordinates of all buses, (n_bus, 2), in network order; None unless each bus has its own."""
    given = read_given(network.buses, "x"), read_given(network.buses, "y")
    places = np.array([[math.nan if v is None else v for v in column] for column in given], dtype=float).T
    return places if len(places) == len(network.buses) and np.isfinite(places).all() else None


def _walk(network: Network, root: int) -> dict[int, int]:
    """Bus -> the bus before it on a shortest way to ``root``, its own for ``root``; nearer buses come first.

    Where no closed branch leads on, an open one does.
    """
    upstream = {root: root}
    queue = deque([root])
    while queue or (queue := _cross_open(network, upstream)):
        here = queue.popleft()
        for branch in network.branches_at[here]:
            if (there := branch.other_end(here)) not in upstream:
                upstream[there] = here
                queue.append(there)
    return upstream


def _cross_open(network: Network, upstream: dict[int, int]) -> deque[int]:
    """The bus beyond the first open branch that leads away from ``upstream``, into which it is put; empty without."""
    for branch in network.branches if len(upstream) < len(network.buses) else ():
        for here, there in ((branch.from_bus, branch.to_bus), (branch.to_bus, branch.from_bus)):
            if here in upstream and there not in upstream:
                upstream[there] = here
                return deque([there])
    return deque()


def _stack(order: list[int], children: dict[int, list[int]], trunk: set[int]) -> dict[int, int]:
    """Bus -> its rows from the bus before it; negative for a lateral that turns off upwards from the trunk."""
    offset = dict.fromkeys(order, 0)
    used: dict[int, list[list[int]]] = {}  # bus -> on each side the rows in use at its column (last), and farther out
    for bus in reversed(order):
        sides: list[list[int]] = [[], []] if bus in trunk else [[]]
        if children[bus]:
            sides = used.pop(children[bus][0])
        for side in sides:
            side.append(0)
        for child in children[bus][1:]:
            (rows,) = used.pop(child)
            free = [1 + max(side[-1 - len(rows) :]) for side in sides]
            nearest = free.index(min(free))
            side = sides[nearest]
            side[-1] = free[nearest]
            for k, row in enumerate(rows, -1 - len(rows)):
                side[k] = free[nearest] + row
            offset[child] = free[nearest] * (-1) ** nearest
        used[bus] = sides
    return offset
