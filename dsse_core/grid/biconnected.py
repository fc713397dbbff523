"""The blocks of a network: its loops, and the branches that lie in no loop.

Two branches belong to one block if some loop runs through both; a branch in no loop is a block of its own. Blocks
meet at articulation points and form a tree (the block-cut tree), rooted at the substation here. Areas made of whole
blocks therefore always form a tree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Network


class Block(NamedTuple):
    """A block. ``top``: its bus nearest to the substation; ``buses``: its other buses, of ``n_nodes`` nodes;
    ``branches``: ids of branches.

    Every bus but the substation is in ``buses`` of exactly one block.
    """

    top: int
    buses: tuple[int, ...]
    branches: tuple[str, ...]
    n_nodes: int


@dataclass(frozen=True)
class Incidence:
    """The branches in service at every bus, in their order; buses and branches are rows of the network.

    Those at bus ``b`` stand at the positions ``first[b]`` to ``first[b + 1]`` of ``branch``; their other ends in
    ``there``. Lists, as walks read them number by number.
    """

    first: list[int]
    branch: list[int]
    there: list[int]


def list_incidence(network: Network) -> Incidence:
    """The incidence of all buses of ``network``."""
    table = network.table
    here, there = (np.stack(ends, axis=1).ravel() for ends in ((table.f, table.t), (table.t, table.f)))
    order = np.argsort(here, kind="stable")
    first = np.searchsorted(here[order], np.arange(len(table.bus_id) + 1))
    return Incidence(first.tolist(), np.repeat(table.active, 2)[order].tolist(), there[order].tolist())


def find_blocks(network: Network) -> list[Block]:
    """The biconnected components of the branches in service, every block before the one above it.

    Tarjan, "Depth-first search and linear graph algorithms", SIAM J. Comput. 1 (1972) 146-160, without recursion;
    the time grows linearly with the number of branches.

    Raises:
        InvalidInputError: no slack bus, or buses that no branch in service joins to it.
    """
    if problems := network.find_supply_problems():
        raise InvalidInputError(f"network {network.name!r}", problems)
    assert network.slack is not None  # find_supply_problems
    at, bus = list_incidence(network), network.table.rows.row_of(network.slack.bus)
    # by row of a bus: its number, the smallest number seen from it or below, the branch and the bus before it
    found, low, entry, above = ([-1] * len(network.buses) for _ in range(4))
    ahead, last = at.first[:-1], at.first[1:]
    found[bus] = low[bus] = count = 0
    trail: list[int] = []  # branches of blocks that are not complete yet
    blocks = _Blocks(network)
    while bus >= 0:
        if (k := ahead[bus]) < last[bus]:
            ahead[bus], branch, there = k + 1, at.branch[k], at.there[k]
            if found[there] < 0:
                count += 1
                found[there] = low[there] = count
                entry[there], above[there] = branch, bus
                trail.append(branch)
                bus = there
            elif branch != entry[bus] and found[there] < found[bus]:
                trail.append(branch)
                low[bus] = min(low[bus], found[there])
            continue
        if (top := above[bus]) >= 0:
            if low[bus] < low[top]:
                low[top] = low[bus]
            if low[bus] >= found[top]:
                blocks.add(trail, entry[bus], bus, top)
        bus = top
    return blocks.found


class _Blocks:
    """Blocks as they are found; buses and branches by rows of ``network``."""

    def __init__(self, network: Network) -> None:
        self._table, self._branch_ids = network.table, network.branch_ids
        self._bus_ids: list[int] = network.table.bus_id.tolist()
        self._n_nodes: list[int] = np.bincount(network.table.nodes.item, minlength=len(self._bus_ids)).tolist()
        self.found: list[Block] = []

    def add(self, trail: list[int], entry: int, bus: int, top: int) -> None:
        """Adds the block of all branches on ``trail`` from ``entry`` on, and takes them off ``trail``.

        ``entry`` is the branch from ``top`` to ``bus``.
        """
        branches = [trail.pop()]
        if branches[0] == entry:  # in no loop, as nearly everywhere in a feeder
            ids, branch = self._bus_ids, self._branch_ids[entry]
            self.found.append(Block(ids[top], (ids[bus],), (branch,), self._n_nodes[bus]))
            return
        while branches[-1] != entry:
            branches.append(trail.pop())
        branches.reverse()
        ends = np.stack([self._table.from_bus[branches], self._table.to_bus[branches]], axis=1)
        buses = dict.fromkeys(ends.ravel().tolist())
        del buses[self._bus_ids[top]]
        n_nodes = sum(self._n_nodes[self._table.rows.row_of(bus)] for bus in buses)
        names = tuple(self._branch_ids[k] for k in branches)
        self.found.append(Block(self._bus_ids[top], tuple(buses), names, n_nodes))
