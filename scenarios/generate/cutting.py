"""Cuts of a network into areas: into a number of areas of about equal size, or at named switches.

Cuts lie at articulation points only: an area is made of whole blocks (``biconnected``), so that loops stay inside an
area and the areas form a tree. Areas are called area1, area2, ... in the order in which a walk from the substation, bus
after bus, meets them.

The size of an area is the number of nodes below its blocks, which in a balanced network are buses: those that it owns,
the substation not counted.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import Suggestions
from dsse_core.grid.biconnected import Block, find_blocks, list_incidence
from dsse_core.grid.network import Network

MAX_NAMED = 8  # branches of a loop that a message lists


def cut_into(network: Network, count: int) -> dict[str, list[int]]:
    """``count`` areas of about equal size: name -> buses in network order, boundary buses in several.

    The largest area has at most twice the smallest size that the largest of ``count`` areas can have and, in a radial
    network, at most twice the mean size; finding the smallest itself is bin packing where many laterals leave one bus.
    The time grows like n log(n)^2 with the number of branches.

    Raises:
        InvalidInputError: the network has fewer blocks than ``count``, no substation or unreached buses.
    """
    blocks = find_blocks(network)
    if count == len(network.buses) == 1:
        return {"area1": [network.buses[0].id]}
    if not 1 <= count <= len(blocks):
        problem = f"{count} areas are asked for; give a count of at least 1"
        if count > len(blocks):
            problem = (
                f"{count} areas are asked for, but cut at its articulation points network {network.name!r} falls "
                f"into {len(blocks)} pieces at most (loops stay whole); give a count of at most {len(blocks)}"
            )
        raise InvalidInputError(f"areas of network {network.name!r}", [problem])
    return _name_areas(network, _balance(blocks, count))


def open_branches(network: Network, ties: Sequence[str]) -> Network:
    """``network`` with the branches ``ties`` out of service.

    Raises:
        InvalidInputError: listing every id that is unknown.
    """
    if unknown := [branch for branch in ties if branch not in network.branch_by_id]:
        problems = [f"ties: there is no branch {branch}" for branch in unknown]
        raise InvalidInputError(f"areas of network {network.name!r}", problems)
    if not ties:
        return network
    opened = set(ties)
    return replace(
        network, branches=tuple(replace(b, in_service=False) if b.id in opened else b for b in network.branches)
    )


def cut_at(network: Network, switches: Sequence[str]) -> dict[str, list[int]]:
    """Areas cut at the branches ``switches``: name -> buses in network order, boundary buses in several.

    A switch belongs to the area away from the substation; the boundary bus is its end nearer to the substation.

    Raises:
        InvalidInputError: listing every branch that is unknown, out of service, given twice or in a loop; or
            switches that leave one area only; or no substation or unreached buses.
    """
    blocks = find_blocks(network)
    if problems := _find_switch_problems(network, blocks, switches):
        raise InvalidInputError(f"areas of network {network.name!r}", problems)
    opened = set(switches)
    area_above: dict[int, list[Block]] = {}  # bus -> the area that reaches down to it
    areas: list[list[Block]] = [[]]
    for block in reversed(blocks):
        area = area_above.get(block.top, areas[0])
        if block.branches[0] in opened:
            area = []
            areas.append(area)
        area.append(block)
        area_above |= dict.fromkeys(block.buses, area)
    areas = [area[::-1] for area in areas if area]
    if len(areas) == 1:
        problem = (
            f"branch {switches[0]} is the only branch at the substation, so that a cut there leaves one area; "
            "name a branch farther out, or give count = 1"
        )
        raise InvalidInputError(f"areas of network {network.name!r}", [problem])
    return _name_areas(network, areas)


def _find_switch_problems(network: Network, blocks: Sequence[Block], switches: Sequence[str]) -> list[str]:
    block_of = {branch: block for block in blocks for branch in block.branches}
    known, suggestions = set(network.branch_ids), Suggestions(block_of)
    problems = []
    for name, count in Counter(switches).items():
        if count > 1:
            problems.append(f"branch {name} is named {count} times; name it once")
        if name not in known:
            problems.append(f"there is no branch {name!r}{suggestions.find(name)}")
        elif name not in block_of:
            problems.append(f"branch {name} is out of service, so that it joins nothing; leave it out")
        elif len(loop := block_of[name].branches) > 1:
            others = [branch for branch in loop if branch != name]
            more = f" and {len(others) - MAX_NAMED} more" if len(others) > MAX_NAMED else ""
            problems.append(
                f"branch {name} lies in a loop with {', '.join(others[:MAX_NAMED])}{more}, so that the areas at its "
                "two ends would meet elsewhere too; name a branch in no loop"
            )
    return problems


@dataclass(frozen=True, slots=True)
class _Hanging:
    """Blocks by the bus where they hang. ``below``: (block, a list of the blocks under each of its buses with any).

    Along a trunk, nearly everywhere in a feeder, a single block hangs under a block: its number stands in place of the
    lists.
    """

    sizes: list[int]
    below: list[tuple[int, int | list[list[int]]]]  # in the order of the blocks
    at_top: list[list[int]]  # those that hang below no block
    joined: bytes  # those that have been joined to the block above beforehand


@dataclass(slots=True)
class _Packing:
    """Blocks in bundles: blocks that hang at one bus, with all that is joined to them below.

    ``leader``: block -> the block that stands for its bundle, where that is another. ``joined``: of a leader, true
    where its bundle is joined to the block above, false where it is an area. ``weight``: of a leader, that of its
    bundle.
    """

    weight: list[int]
    leader: dict[int, int]
    joined: bytearray

    @property
    def n_area(self) -> int:
        return len(self.weight) - len(self.leader) - self.joined.count(1)


def _balance(blocks: Sequence[Block], count: int) -> list[list[Block]]:
    """Exactly ``count`` areas of ``blocks``, which are connected, each before the one above it."""
    hanging = _find_hanging(blocks)
    high = -(-sum(hanging.sizes) // count)
    low = high - 1 if max(hanging.sizes) < high else 0  # so many areas of that size do not hold all
    hanging = _merge_small(hanging, low)
    while _pack(hanging, high).n_area > count:
        low, high = high, 2 * high
    hanging = _merge_small(hanging, low)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _pack(hanging, middle).n_area <= count else (middle, high)
    areas = _read_off(blocks, _pack(hanging, high))
    largest = [(-sum(block.n_nodes for block in area), i) for i, area in enumerate(areas)]
    heapq.heapify(largest)
    while len(areas) < count:
        _, i = heapq.heappop(largest)
        if len(areas[i]) == 1:
            continue  # a single block is not cut, however large
        first, second = _balance(areas[i], 2)
        areas[i] = first
        areas.append(second)
        for k in (i, len(areas) - 1):
            heapq.heappush(largest, (-sum(block.n_nodes for block in areas[k]), k))
    return areas


def _find_hanging(blocks: Sequence[Block]) -> _Hanging:
    at: dict[int, list[int]] = {}  # bus -> the blocks that hang there
    below: list[tuple[int, int | list[list[int]]]] = []
    for i, block in enumerate(blocks):
        if groups := [at.pop(bus) for bus in block.buses if bus in at]:
            is_single = len(groups) == len(groups[0]) == 1
            below.append((i, groups[0][0] if is_single else groups))
        at.setdefault(block.top, []).append(i)
    return _Hanging([block.n_nodes for block in blocks], below, list(at.values()), bytes(len(blocks)))


def _merge_small(hanging: _Hanging, bound: int) -> _Hanging:
    """``hanging`` with each block and all below it as one, where together they are not above ``bound``.

    Any larger bound joins the same blocks.
    """
    sizes, joined, below = hanging.sizes.copy(), bytearray(hanging.joined), []
    whole = hanging.sizes.copy()
    for i, groups in hanging.below:
        hung = [groups] if isinstance(groups, int) else [k for group in groups for k in group]
        whole[i] += sum(whole[k] for k in hung)
        if whole[i] <= bound:
            sizes[i] = whole[i]
            for k in hung:
                joined[k] = True
        else:
            below.append((i, groups))
    return _Hanging(sizes, below, hanging.at_top, bytes(joined))


def _pack(hanging: _Hanging, bound: int) -> _Packing:
    """The areas that one walk towards the substation finds, few, none larger than ``bound`` but single blocks.

    Kundu and Misra's greedy rule for trees ("A linear tree partitioning algorithm", SIAM J. Comput. 6 (1977) 151-154):
    the parts that do not fit are cut off, the heaviest first. Blocks that hang at one bus need not stay with the block
    above: they are bundled, and the lightest bundle may be joined. Any two bundles at a bus exceed ``bound``. By their
    exchange argument it follows that twice the smallest possible bound needs no more areas.
    """
    weight, leader = hanging.sizes.copy(), dict[int, int]()
    joined = bytearray(hanging.joined)
    for i, groups in hanging.below:
        if isinstance(groups, int):
            if (heavier := weight[i] + weight[groups]) <= bound:
                weight[i] = heavier
                joined[groups] = True
            continue
        lightest = [group[0] if len(group) == 1 else _bundle(group, bound, weight, leader) for group in groups]
        for k in sorted(lightest, key=weight.__getitem__) if len(lightest) > 1 else lightest:
            if weight[i] + weight[k] > bound:
                break
            weight[i] += weight[k]
            joined[k] = True
    for group in hanging.at_top:
        _bundle(group, bound, weight, leader)
    return _Packing(weight, leader, joined)


def _bundle(group: Sequence[int], bound: int, weight: list[int], leader: dict[int, int]) -> int:
    """Put the blocks of ``group`` into bundles: none heavier than ``bound`` but single blocks, any two heavier.

    Returns the leader of the lightest bundle; ``weight`` and ``leader`` are changed.
    """
    leaders: list[int] = []
    lightest: list[tuple[int, int]] = []  # weight, and where in leaders
    for _, i in sorted(((weight[i], i) for i in group), reverse=True):
        if lightest and lightest[0][0] + weight[i] <= bound:
            first = leaders[lightest[0][1]]
            leader[i] = first
            weight[first] += weight[i]
            heapq.heapreplace(lightest, (weight[first], lightest[0][1]))
        else:
            heapq.heappush(lightest, (weight[i], len(leaders)))
            leaders.append(i)
    return leaders[lightest[0][1]]


def _read_off(blocks: Sequence[Block], packing: _Packing) -> list[list[Block]]:
    """The areas of ``packing``, each in the order of ``blocks``."""
    area_above: dict[int, list[Block]] = {}  # bus -> the area that reaches down to it
    areas: dict[int, list[Block]] = {}  # by leader
    for i in range(len(blocks) - 1, -1, -1):
        block, first = blocks[i], packing.leader.get(i, i)
        area = area_above[block.top] if packing.joined[first] else areas.setdefault(first, [])
        area.append(block)
        for bus in block.buses:
            area_above[bus] = area
    return [area[::-1] for area in areas.values()]


def _name_areas(network: Network, areas: Sequence[Sequence[Block]]) -> dict[str, list[int]]:
    """Area name -> its buses in network order. ``areas``: the blocks of each, every block before the one above it."""
    assert network.slack is not None  # find_blocks
    at_top: dict[int, dict[str, int]] = {}  # the bus where a walk enters areas -> their branches -> area
    for i, area in enumerate(areas):
        top = area[-1].top
        entries = (branch for block in area if block.top == top for branch in block.branches)
        at_top.setdefault(top, {}).update(dict.fromkeys(entries, i))
    order: dict[int, None] = {}
    at, ids, row = list_incidence(network), network.branch_ids, network.row
    starts = {row[top]: area_of for top, area_of in at_top.items()}
    walk = [row[network.slack.bus]]
    seen = bytearray(len(row))
    seen[walk[0]] = True
    for bus in walk:  # the list grows: breadth first
        first, last = at.first[bus], at.first[bus + 1]
        if bus in starts:
            area_of = starts[bus]
            order |= dict.fromkeys(area_of[ids[k]] for k in at.branch[first:last] if ids[k] in area_of)
        for there in at.there[first:last]:
            if not seen[there]:
                seen[there] = True
                walk.append(there)
    buses_of = ({areas[i][-1].top}.union(*(block.buses for block in areas[i])) for i in order)
    return {f"area{k}": sorted(buses, key=row.__getitem__) for k, buses in enumerate(buses_of, 1)}
