"""The blocks of a network: its loops, and the branches that lie in none.

Two branches belong to one block if some loop runs through both; a branch in no loop is a block of its own. Blocks
meet at articulation points and form a tree (the block-cut tree), rooted at the substation here. Areas made of whole
blocks therefore always form a tree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Branch, Network


@dataclass(frozen=True, slots=True)
class Block:
    """``top``: its bus nearest to the substation; ``buses``: its other buses; each bus is below one block only."""

    top: int
    buses: tuple[int, ...]
    branches: tuple[Branch, ...]


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
    root = network.slack.bus
    found, low = {root: 0}, {root: 0}  # bus -> its number; the smallest number seen from it or below
    trail: list[Branch] = []  # branches of blocks that are not complete yet
    blocks: list[Block] = []
    stack: list[tuple[int, Branch | None, Iterator[Branch]]] = [(root, None, iter(network.branches_at[root]))]
    while stack:
        bus, entry, ahead = stack[-1]
        for branch in ahead:
            there = branch.other_end(bus)
            if there not in found:
                found[there] = low[there] = len(found)
                trail.append(branch)
                stack.append((there, branch, iter(network.branches_at[there])))
                break
            if branch is not entry and found[there] < found[bus]:
                trail.append(branch)
                low[bus] = min(low[bus], found[there])
        else:
            stack.pop()
            if entry is not None:
                top = entry.other_end(bus)
                low[top] = min(low[top], low[bus])
                if low[bus] >= found[top]:
                    blocks.append(_pop_block(trail, entry, top))
    return blocks


def _pop_block(trail: list[Branch], entry: Branch, top: int) -> Block:
    """Everything on ``trail`` from ``entry`` on."""
    branches = [trail.pop()]
    if branches[0] is entry:  # in no loop, as nearly everywhere in a feeder
        return Block(top, (entry.other_end(top),), (entry,))
    while branches[-1] is not entry:
        branches.append(trail.pop())
    branches.reverse()
    buses = dict.fromkeys(bus for branch in branches for bus in (branch.from_bus, branch.to_bus) if bus != top)
    return Block(top, tuple(buses), tuple(branches))
