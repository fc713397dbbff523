"""Where to cut a network into areas: into a number of areas of about equal size, or at named switches.

Cuts lie at articulation points only: an area is made of whole blocks (``dsse_core.blocks``), so that loops stay inside
an area and the areas form a tree. Areas are called area1, area2, ... in the order in which a walk from the
substation, bus after bus, meets them.

The size of an area is the number of buses below its blocks: those that it owns, the substation not counted.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from dsse_core.blocks import Block, find_blocks
from dsse_core.errors import InvalidInputError
from dsse_core.network import Network
from scenarios.strict_toml import suggest

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
    if not 1 <= count <= len(blocks):
        problem = f"{count} areas are asked for; give a count of at least 1"
        if count > len(blocks):
            problem = (
                f"{count} areas are asked for, but cut at its articulation points network {network.name!r} falls "
                f"into {len(blocks)} pieces at most (loops stay whole); give a count of at most {len(blocks)}"
            )
        raise InvalidInputError(f"areas of network {network.name!r}", [problem])
    return _name_areas(network, _balance(blocks, count))


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
        if block.branches[0].id in opened:
            area = []
            areas.append(area)
        area.append(block)
        area_above |= dict.fromkeys(block.buses, area)
    areas = [area for area in areas if area]
    if len(areas) == 1:
        problem = (
            f"branch {switches[0]} is the only branch at the substation, so that a cut there leaves one area; "
            "name a branch farther out, or give count = 1"
        )
        raise InvalidInputError(f"areas of network {network.name!r}", [problem])
    return _name_areas(network, areas)


def _find_switch_problems(network: Network, blocks: Sequence[Block], switches: Sequence[str]) -> list[str]:
    block_of = {branch.id: block for block in blocks for branch in block.branches}
    problems = []
    for name, count in Counter(switches).items():
        if count > 1:
            problems.append(f"branch {name} is named {count} times; name it once")
        if name not in network.branch_by_id:
            problems.append(f"there is no branch {name!r}{suggest(name, block_of)}")
        elif name not in block_of:
            problems.append(f"branch {name} is out of service, so that it joins nothing; leave it out")
        elif len(loop := block_of[name].branches) > 1:
            others = [branch.id for branch in loop if branch.id != name]
            more = f" and {len(others) - MAX_NAMED} more" if len(others) > MAX_NAMED else ""
            problems.append(
                f"branch {name} lies in a loop with {', '.join(others[:MAX_NAMED])}{more}, so that the areas at its "
                "two ends would meet elsewhere too; name a branch in no loop"
            )
    return problems


@dataclass(slots=True)
class _Bundle:
    """Blocks that hang at one bus, with all that is joined to them below; ``joined`` to the block above, or closed."""

    weight: int
    blocks: list[int]
    joined: bool = False


def _balance(blocks: Sequence[Block], count: int) -> list[list[Block]]:
    """Exactly ``count`` areas of ``blocks``, which are connected, each before the one above it."""

    def fits(bound: int) -> bool:
        return sum(not bundle.joined for bundle in _pack(blocks, bound)) <= count

    low, high = 0, -(-sum(len(block.buses) for block in blocks) // count)
    while not fits(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    areas = _read_off(blocks, _pack(blocks, high))
    largest = [(-sum(len(block.buses) for block in area), i) for i, area in enumerate(areas)]
    heapq.heapify(largest)
    while len(areas) < count:
        _, i = heapq.heappop(largest)
        if len(areas[i]) == 1:
            continue  # one block, be it large, is not cut
        first, second = _balance(areas[i], 2)
        areas[i] = first
        areas.append(second)
        for k in (i, len(areas) - 1):
            heapq.heappush(largest, (-sum(len(block.buses) for block in areas[k]), k))
    return areas


def _pack(blocks: Sequence[Block], bound: int) -> list[_Bundle]:
    """As few areas as found in one walk towards the substation, none larger than ``bound`` but single blocks.

    Kundu and Misra's greedy rule for trees ("A linear tree partitioning algorithm", SIAM J. Comput. 6 (1977)
    151-154): whatever does not fit is cut off, the heaviest first. Blocks that hang at one bus need not stay with the
    block above: they are bundled, the lightest bundle may be joined. Any two bundles at a bus exceed ``bound``, and
    from this follows by their exchange argument that twice the smallest possible bound needs no more areas.
    """
    bundles: list[_Bundle] = []
    hanging: dict[int, list[tuple[int, int]]] = {}  # bus -> (weight with what is joined below, block) of each there
    for i, block in enumerate(blocks):
        lightest = []
        for bus in block.buses:
            if bus in hanging:
                bundled = _bundle(hanging.pop(bus), bound)
                bundles += bundled
                lightest.append(min(bundled, key=_weight) if len(bundled) > 1 else bundled[0])
        weight = len(block.buses)
        for bundle in sorted(lightest, key=_weight) if len(lightest) > 1 else lightest:
            if weight + bundle.weight > bound:
                break
            weight += bundle.weight
            bundle.joined = True
        hanging.setdefault(block.top, []).append((weight, i))
    for at_top in hanging.values():
        bundles += _bundle(at_top, bound)
    return bundles


def _bundle(items: list[tuple[int, int]], bound: int) -> list[_Bundle]:
    """Bundles of (weight, block), none heavier than ``bound`` but single items, any two together heavier."""
    if len(items) == 1:  # nearly everywhere
        return [_Bundle(items[0][0], [items[0][1]])]
    bundles: list[_Bundle] = []
    lightest: list[tuple[int, int]] = []
    for weight, block in sorted(items, reverse=True):
        if lightest and lightest[0][0] + weight <= bound:
            bundle = bundles[lightest[0][1]]
            bundle.weight += weight
            bundle.blocks.append(block)
            heapq.heapreplace(lightest, (bundle.weight, lightest[0][1]))
        else:
            heapq.heappush(lightest, (weight, len(bundles)))
            bundles.append(_Bundle(weight, [block]))
    return bundles


def _weight(bundle: _Bundle) -> int:
    return bundle.weight


def _read_off(blocks: Sequence[Block], bundles: Sequence[_Bundle]) -> list[list[Block]]:
    """The areas that bundles stand for, each in the order of ``blocks``."""
    bundle_of = {i: bundle for bundle in bundles for i in bundle.blocks}
    area_above: dict[int, list[Block]] = {}  # bus -> the area that reaches down to it
    areas: dict[int, list[Block]] = {}
    for i in range(len(blocks) - 1, -1, -1):
        block, bundle = blocks[i], bundle_of[i]
        area = area_above[block.top] if bundle.joined else areas.setdefault(id(bundle), [])
        area.append(block)
        for bus in block.buses:
            area_above[bus] = area
    return [area[::-1] for area in areas.values()]


def _name_areas(network: Network, areas: Sequence[Sequence[Block]]) -> dict[str, list[int]]:
    assert network.slack is not None  # find_blocks
    area_of = {branch.id: i for i, area in enumerate(areas) for block in area for branch in block.branches}
    members: dict[int, set[int]] = {}  # in the order of the walk
    seen, queue = {network.slack.bus}, deque([network.slack.bus])
    while queue:
        bus = queue.popleft()
        for branch in network.branches_at[bus]:
            members.setdefault(area_of[branch.id], set()).update((branch.from_bus, branch.to_bus))
            if (there := branch.other_end(bus)) not in seen:
                seen.add(there)
                queue.append(there)
    return {f"area{k}": sorted(buses, key=network.row.__getitem__) for k, buses in enumerate(members.values(), 1)}
