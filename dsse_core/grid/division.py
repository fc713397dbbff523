"""Dividing a network into areas: who gets which branch, what is no tree, and what each area then knows."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import walk_unloaded
from dsse_core.grid.network import Branch, Control, Network
from dsse_core.grid.partition import Area, Neighbour, Partition


def build_partition(
    network: Network,
    area_buses: Mapping[str, Sequence[int]],
    local_slack: Mapping[str, tuple[int, float]] | None = None,
) -> Partition:
    """Divide ``network`` into the named areas; ``area_buses`` lists the buses of each, boundary buses in several.

    The local slack of an area is the substation or the first voltage-holding generator in it, else the
    boundary bus towards the substation; ``local_slack`` (area -> bus, vm in p.u.) overrides it.

    Raises:
        InvalidInputError: listing every bus or branch in no area, area in pieces, unknown name, and the
            cycle if areas form a loop.
    """
    local_slack = local_slack or {}
    problems = _find_bus_problems(network, area_buses)
    members = {name: {bus for bus in buses if bus in network.row} for name, buses in area_buses.items()}
    meeting: dict[int, list[str]] = {}
    for name, buses in members.items():
        for bus in buses:
            meeting.setdefault(bus, []).append(name)
    branches, branch_problems = _assign_branches(network, members, meeting)
    problems += branch_problems
    problems += _find_slack_problems(members, local_slack)
    if problems:
        raise InvalidInputError(f"areas of network {network.name!r}", problems)

    boundaries = {bus: names for bus, names in meeting.items() if len(names) > 1}
    neighbours = _grow_tree(network, members, boundaries)
    areas = []
    for name in area_buses:
        parent = next((n for n in neighbours[name] if n.is_parent), None)
        part = _cut_out(network, name, members[name], branches[name], parent.bus if parent else None)
        bus, vm = local_slack.get(name) or _default_slack(part, parent)
        assert network.slack is not None  # checked by _find_bus_problems
        reference = (network.slack.bus, network.slack.va) if network.slack.bus in members[name] else None
        areas.append(Area(name, part, tuple(neighbours[name]), bus, vm, reference))
    return _with_schedule(Partition(network, tuple(areas)))


def _with_schedule(partition: Partition) -> Partition:
    """Every area with what it has to know of the whole: the way to the hub, how many areas there are, its start."""
    network, towards = partition.network, _find_ways(partition, partition.hub)
    assert network.slack is not None  # checked by _find_bus_problems
    vm, va = walk_unloaded(network, network.slack.bus)
    areas = []
    for area in partition.areas:
        row = network.row[area.entry_bus]
        entry = float(vm[row]), float(va[row]) + network.slack.va
        areas.append(replace(area, towards_hub=towards[area.name], n_areas=len(partition.areas), entry_voltage=entry))
    return Partition(network, tuple(areas))


def _find_ways(partition: Partition, hub: str) -> dict[str, str | None]:
    """Area -> the neighbour on its way to ``hub``."""
    towards: dict[str, str | None] = {hub: None}
    queue = [hub]
    for name in queue:  # which grows
        for neighbour in partition.area(name).neighbours:
            if neighbour.area not in towards:
                towards[neighbour.area] = name
                queue.append(neighbour.area)
    return towards


def _find_slack_problems(
    members: Mapping[str, set[int]], local_slack: Mapping[str, tuple[int, float]]
) -> Iterator[str]:
    for name, (bus, vm) in local_slack.items():
        if name not in members:
            yield f"local slack of area {name}, which is not one of the areas {', '.join(members)}"
        elif bus not in members[name]:
            yield f"area {name}: slack_bus {bus} is not one of its buses"
        if not (math.isfinite(vm) and vm > 0):
            yield f"area {name}: slack_vm is {vm}; it must be a positive voltage in p.u."


def _find_bus_problems(network: Network, area_buses: Mapping[str, Sequence[int]]) -> list[str]:
    problems = []
    if not area_buses:
        problems.append("there is no area; name at least one")
    covered: set[int] = set()
    for name, buses in area_buses.items():
        covered.update(buses)
        for bus_id, count in Counter(buses).items():
            if bus_id not in network.row:
                problems.append(f"area {name}: bus {bus_id} is not in the network")
            if count > 1:
                problems.append(f"area {name}: bus {bus_id} is listed {count} times; list it once")
        if not buses:
            problems.append(f"area {name} lists no bus; give it some or leave it out")
    for bus in network.buses:
        if bus.id not in covered:
            problems.append(f"bus {bus.id} is in no area; add it to the buses of one")
    return problems + network.find_supply_problems()


def _assign_branches(
    network: Network, members: Mapping[str, set[int]], meeting: Mapping[int, Sequence[str]]
) -> tuple[dict[str, list[Branch]], list[str]]:
    """Give each branch in service to the one area that holds both its ends; find areas in pieces.

    ``meeting``: bus -> the areas that list it.
    """
    inside: dict[str, list[Branch]] = {name: [] for name in members}
    problems = []
    for branch in network.active_branches:
        homes = [name for name in meeting.get(branch.from_bus, ()) if branch.to_bus in members[name]]
        for name in homes:
            inside[name].append(branch)
        if not homes:
            problems.append(
                f"branch {branch.id} is in no area: no area lists both of its buses "
                f"{branch.from_bus} and {branch.to_bus}; add one of them to the other's area"
            )
        elif len(homes) > 1:
            problems.append(
                f"areas {', '.join(homes)} form a loop: all of them list both ends of branch {branch.id}; "
                "two areas may share one bus only"
            )
    for name, buses in members.items():
        if not buses:
            continue
        pieces = _connected_pieces(buses, inside[name])
        if len(pieces) > 1:
            text = " | ".join(", ".join(map(str, sorted(piece))) for piece in pieces)
            problems.append(f"area {name} is not connected by its own branches: it falls into buses {text}")
        elif len(buses) == 1:
            problems.append(f"area {name} has a single bus and no branch; add the bus to a neighbouring area instead")
    return inside, problems


def _connected_pieces(buses: set[int], branches: Sequence[Branch]) -> list[set[int]]:
    """The sets of ``buses`` that ``branches``, which end among them, join."""
    piece_of = {bus: {bus} for bus in sorted(buses)}
    for branch in branches:
        b, a = sorted((piece_of[branch.from_bus], piece_of[branch.to_bus]), key=len)
        if a is not b:
            a |= b
            for bus in b:
                piece_of[bus] = a
    return list({id(piece): piece for piece in piece_of.values()}.values())


def _grow_tree(
    network: Network, members: Mapping[str, set[int]], boundaries: Mapping[int, list[str]]
) -> dict[str, list[Neighbour]]:
    """Walk from the substation over areas and boundary buses; a second way to the same place is a loop."""
    assert network.slack is not None  # checked by _find_bus_problems
    neighbours: dict[str, list[Neighbour]] = {name: [] for name in members}
    root = next(name for name, buses in members.items() if network.slack.bus in buses)
    entered_by: dict[str, tuple[int, str] | None] = {root: None}  # area -> (boundary bus, its owner)
    queue = deque([root])
    while queue:
        name = queue.popleft()
        here = entered_by[name]
        for bus in sorted(members[name] & boundaries.keys()):
            if here is not None and bus == here[0]:
                continue  # all areas there have been entered together with this one
            for other in boundaries[bus]:
                if other == name:
                    continue
                if other in entered_by:
                    raise _loop_error(network, entered_by, name, other, bus)
                entered_by[other] = (bus, name)
                neighbours[name].append(Neighbour(other, bus, is_parent=False))
                neighbours[other].append(Neighbour(name, bus, is_parent=True))
                queue.append(other)
    return neighbours


def _loop_error(
    network: Network, entered_by: Mapping[str, tuple[int, str] | None], one: str, other: str, bus: int
) -> InvalidInputError:
    """Name the cycle that closes where areas ``one`` and ``other`` meet again at ``bus``."""

    def path(name: str) -> list[str]:
        names = [name]
        while (entry := entered_by[names[-1]]) is not None:
            names.append(entry[1])
        return names

    ours, theirs = path(one), path(other)
    while len(ours) > 1 and len(theirs) > 1 and ours[-2] == theirs[-2]:
        ours.pop()
        theirs.pop()
    cycle = [*reversed(ours), *theirs[:-1]]
    if len(ours) > 1 and len(theirs) > 1 and entered_by[ours[-2]] == entered_by[theirs[-2]]:
        cycle.remove(ours[-1])  # both branch off at one bus: the loop does not run through its owner
    text = " - ".join([*cycle, cycle[0]])
    return InvalidInputError(
        f"areas of network {network.name!r}",
        [f"areas form a loop: {text}, closed at bus {bus}; move the cut so that the areas form a tree"],
    )


def _cut_out(
    network: Network, name: str, buses: set[int], branches: Sequence[Branch], not_owned: int | None
) -> Network:
    """The part of the network that area ``name`` knows; the bus it does not own is left bare."""
    own = [network.bus(bus) for bus in sorted(buses, key=network.row.__getitem__)]
    return Network(
        name=name,
        base_mva=network.base_mva,
        buses=tuple(
            replace(bus, p_load=0.0, q_load=0.0, g_shunt=0.0, b_shunt=0.0) if bus.id == not_owned else bus
            for bus in own
        ),
        branches=tuple(branches),
        generators=tuple(g for g in network.generators if g.bus in buses and g.bus != not_owned),
    )


def _default_slack(part: Network, parent: Neighbour | None) -> tuple[int, float | None]:
    if part.slack is not None:
        return part.slack.bus, part.slack.vm
    for generator in part.generators:
        if generator.control is Control.VOLTAGE:
            return generator.bus, generator.vm
    assert parent is not None  # an area without the substation has been entered from another
    return parent.bus, None
