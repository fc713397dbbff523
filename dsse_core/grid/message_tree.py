"""The tree along which areas send messages, and the variables that each of its edges carries.

Areas that share buses may form rings; messages need a tree. Any tree over the areas serves, as an edge carries the
variables that areas on both of its sides use: the running intersection of a junction tree (Lauritzen and Spiegelhalter,
J. Royal Statistical Society B 50 (1988) 157). The voltage of a bus is used by all areas there, the power from it into
an area by that area and by the owner of the bus. So both are carried along the way from the area to the owner. An area
on this way that is not at the bus relays them.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from dsse_core.grid.boundary import add_voltages
from dsse_core.grid.nodes import name_node, write_phases

MOST_WORK = 60_000  # areas of all trees that are compared
MOST_CARRIED = 64  # variables of an edge: 2,144 numbers in a message


@dataclass(frozen=True)
class SharedBus:
    """A bus of several areas. ``owner``: the place of its owner among the areas. ``others``: place of each other area
    -> the set of its phases there (``read_phases``).
    """

    bus: int
    owner: int
    others: Mapping[int, int]

    @cached_property
    def areas(self) -> tuple[int, ...]:
        """The places of all areas there."""
        return (self.owner, *self.others)


@dataclass(frozen=True)
class MessageTree:
    """A tree of areas, by their places. ``above``: the next area on the way to the first one, and there -1.

    ``order``: areas, each after the one above it.
    """

    above: tuple[int, ...]
    order: tuple[int, ...]

    @cached_property
    def depth(self) -> tuple[int, ...]:
        """The number of edges between each area and the first one."""
        depth = [0] * len(self.above)
        for area in self.order[1:]:
            depth[area] = depth[self.above[area]] + 1
        return tuple(depth)

    def path(self, one: int, other: int) -> Iterator[int]:
        """The lower area of each edge on the way between two areas."""
        while one != other:
            if self.depth[one] < self.depth[other]:
                one, other = other, one
            yield one
            one = self.above[one]

    @cached_property
    def length(self) -> int:
        """The largest number of edges between two areas."""
        reach, length = [0] * len(self.above), 0
        for area in reversed(self.order[1:]):
            above = self.above[area]
            length = max(length, reach[above] + reach[area] + 1)
            reach[above] = max(reach[above], reach[area] + 1)
        return length

    def swap(self, without: int, ends: tuple[int, int]) -> MessageTree:
        """The tree with an edge between the areas ``ends`` in place of the one above area ``without``."""
        edges = (ends if area == without else (area, self.above[area]) for area in self.order[1:])
        return _join_edges(len(self.above), edges, self.order[0])


def _join_edges(n_areas: int, edges: Iterable[tuple[int, int]], first: int) -> MessageTree:
    """The tree of ``edges``, seen from the ``first`` area."""
    beside: list[list[int]] = [[] for _ in range(n_areas)]
    for one, other in edges:
        beside[one].append(other)
        beside[other].append(one)
    above, order = [-1] * n_areas, [first]
    for area in order:  # the order grows
        for other in beside[area]:
            if other != above[area]:
                above[other] = area
                order.append(other)
    return MessageTree(tuple(above), tuple(order))


@dataclass(frozen=True)
class Carried:
    """The variables of an edge: bus -> place of each area into which a power flows -> the set of its phases there."""

    powers: dict[int, dict[int, int]]

    @property
    def d(self) -> int:
        """The number of variables."""
        n_powers = sum(phases.bit_count() for into in self.powers.values() for phases in into.values())
        return 2 * (n_powers + sum(phases.bit_count() for phases in self.list_phases().values()))

    def list_phases(self) -> dict[int, int]:
        """Bus -> the set of phases whose voltages are carried."""
        return {bus: functools.reduce(int.__or__, into.values()) for bus, into in self.powers.items()}

    def list_names(self, areas: Sequence[str]) -> tuple[str, ...]:
        """The names of the variables, see ``boundary.py``; ``areas``: the names of all areas."""
        powers = (
            f"s@{name_node(bus, write_phases(into[area]))}>{areas[area]}"
            for bus, into in sorted(self.powers.items())
            for area in sorted(into)
        )
        return add_voltages(tuple(powers))


def find_carried(tree: MessageTree, shared: Sequence[SharedBus]) -> dict[int, Carried]:
    """Lower area of each edge -> its variables."""
    carried = {area: Carried({}) for area in tree.order[1:]}
    for at in shared:
        for area, phases in at.others.items():
            for edge in tree.path(area, at.owner):
                carried[edge].powers.setdefault(at.bus, {})[area] = phases
    return carried


def walk_areas(n_areas: int, first: int, groups: Sequence[Sequence[int]]) -> MessageTree:
    """The tree of the shortest ways from the ``first`` area over ``groups`` of areas that meet."""
    groups_of: list[list[Sequence[int]]] = [[] for _ in range(n_areas)]
    for group in groups:
        for area in group:
            groups_of[area].append(group)
    above, order, is_done = [-1] * n_areas, [first], set[int]()
    queue = deque(order)
    while queue:
        area = queue.popleft()
        for group in groups_of[area]:
            if id(group) in is_done:
                continue  # all its areas have been reached
            is_done.add(id(group))
            for other in group:
                if above[other] < 0 and other != first:
                    above[other] = area
                    order.append(other)
                    queue.append(other)
    return MessageTree(tuple(above), tuple(order))


def choose_tree(tree: MessageTree, shared: Sequence[SharedBus]) -> MessageTree:
    """The tree of least sum d^2 that is found; of equal ones that of the shortest way across.

    Where areas form no ring, ``tree`` is the best one. Else edges between areas that meet are swapped one by one, as
    long as the sum falls: in ``tree``, and in the walks from each area of a ring.
    """
    if sum(len(at.others) for at in shared) < len(tree.order):
        return tree
    core, groups = _find_core(shared), [at.areas for at in shared]
    pairs = {(min(a, b), max(a, b)): None for at in core for a in at for b in at if a != b}
    best, least, left = tree, _weigh(tree, shared), MOST_WORK
    for start in (None, *sorted({area for at in core for area in at})):
        if left <= 0:
            break
        begun = tree
        if start is not None:
            walk = walk_areas(len(tree.above), start, groups)
            begun = _join_edges(len(tree.above), [(k, walk.above[k]) for k in walk.order[1:]], tree.order[0])
        found, weight, left = _improve(begun, shared, list(pairs), left)
        if weight < least:
            best, least = found, weight
    return best


def _improve(
    tree: MessageTree, shared: Sequence[SharedBus], pairs: Sequence[tuple[int, int]], left: int
) -> tuple[MessageTree, tuple[int, int], int]:
    """A tree that no swap improves, its weight, and the work that is left."""
    least, is_better = _weigh(tree, shared), True
    while is_better and left > 0:
        is_better = False
        for ends in pairs:
            for edge in tree.path(*ends):
                if left <= 0 or {edge, tree.above[edge]} == {*ends}:
                    break
                other, left = tree.swap(edge, ends), left - len(tree.order)
                if (weight := _weigh(other, shared)) < least:
                    tree, least, is_better = other, weight, True
                    break
    return tree, least, left


def _weigh(tree: MessageTree, shared: Sequence[SharedBus]) -> tuple[int, int]:
    return sum(carried.d**2 for carried in find_carried(tree, shared).values()), tree.length


def _find_core(shared: Sequence[SharedBus]) -> list[list[int]]:
    """The areas at each bus that are in rings, or between rings, of areas and buses."""
    groups = [set(at.areas) for at in shared]
    at_area: dict[int, set[int]] = {}
    for k, group in enumerate(groups):
        for area in group:
            at_area.setdefault(area, set()).add(k)
    ends = [area for area, of in at_area.items() if len(of) == 1]
    while ends:
        area = ends.pop()
        for k in at_area.pop(area, set()):
            groups[k].discard(area)
            if len(groups[k]) == 1:
                (last,) = groups[k]
                groups[k].clear()
                at_area[last].discard(k)
                if len(at_area[last]) == 1:
                    ends.append(last)
                elif not at_area[last]:
                    del at_area[last]
    return [sorted(group) for group in groups if group]
