"""Division of a network into areas: the branches of each, the tree of messages, and what each area then knows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import find_no_load
from dsse_core.grid.boundary import boundary_at
from dsse_core.grid.columns import Records, split_by, take_items
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.message_tree import (
    MOST_CARRIED,
    Carried,
    MessageTree,
    SharedBus,
    choose_tree,
    find_carried,
    walk_areas,
)
from dsse_core.grid.network import Bus, Control, Generator, Network
from dsse_core.grid.nodes import write_phases
from dsse_core.grid.partition import Area, Neighbour, Partition
from dsse_core.printable import listed

Supplied = TypeVar("Supplied", Generator, Load, Shunt)

SAME_VOLTAGE = 1e-9  # p.u. and rad, of an unloaded bus; rounding leaves 1e-13


def build_partition(
    network: Network,
    area_buses: Mapping[str, Sequence[int]],
    local_slack: Mapping[str, tuple[int, float]] | None = None,
    holders: Mapping[str, str] | None = None,
) -> Partition:
    """Divides ``network`` into the named areas; ``area_buses`` lists the buses of each, boundary buses in several.

    A branch belongs to the area that lists both of its buses. Else ``holders`` (branch id -> area) names the area, or
    leaves it empty: then, and without an entry for a closed branch, the owner of its from bus holds the branch. The
    holder sees both buses. An open branch between areas is in no area unless it has an entry.

    The local slack of an area is the substation or the first voltage-holding generator in it, else the
    boundary bus towards the substation; ``local_slack`` (area -> bus, vm in p.u.) overrides it.

    Raises:
        InvalidInputError: listing every bus in no area, branch in several, area in pieces, unknown name, and neighbours
            that would exchange too many variables.
    """
    local_slack = local_slack or {}
    members = _find_members(network, area_buses)
    problems = _find_bus_problems(network, area_buses, members)
    walk = _walk_areas(network, members)
    branches, branch_problems = _assign_branches(network, members, walk, holders or {})
    problems += branch_problems
    problems += _find_slack_problems(network, members, local_slack)
    if problems:
        raise InvalidInputError(f"areas of network {network.name!r}", problems)

    assert network.slack is not None  # checked by _find_bus_problems
    edges = _grow_tree(network, members, branches, walk)
    generators = _split_by_owner(network, members, edges, network.generators)
    loads = _split_by_owner(network, members, edges, network.loads)
    shunts = _split_by_owner(network, members, edges, network.shunts)
    areas = []
    for name, rows, held, at in zip(members.names, members.rows, branches, edges, strict=True):
        parent = next((n for n in at.neighbours if n.is_parent), None)
        items = tuple(generators[name]), tuple(loads[name]), tuple(shunts[name])
        part = _cut_out(network, name, rows, held, items, at.foreign)
        bus, vm = local_slack.get(name) or _default_slack(part, parent)
        reference = (network.slack.bus, network.slack.va) if network.slack.bus in part.row else None
        areas.append(Area(name, part, tuple(at.neighbours), bus, vm, reference))
    ids = network.table.bus_id
    given = {name: tuple(ids[rows].tolist()) for name, rows in zip(members.names, members.rows, strict=True)}
    return _with_schedule(Partition(network, tuple(areas), given))


@dataclass(frozen=True)
class _Members:
    """The buses of the network that the areas list. ``rows``: of each area, in rising order. ``areas_at``: row of a bus
    that several areas list -> their places in ``names``. ``only`` (n_bus,): the place of the only area that lists a
    bus, -1 where none or several do.
    """

    names: tuple[str, ...]
    rows: list[np.ndarray]
    areas_at: dict[int, list[int]]
    only: np.ndarray

    def find_areas(self, row: int) -> Sequence[int]:
        """The places of the areas that list a bus."""
        only = int(self.only[row])
        return self.areas_at.get(row) or ([only] if only >= 0 else [])


def _find_members(network: Network, area_buses: Mapping[str, Sequence[int]]) -> _Members:
    row, n = network.row, len(network.row)
    listed = ([row[bus] for bus in buses if bus in row] for buses in area_buses.values())
    rows = [np.unique(np.array(found, dtype=np.int64)) for found in listed]
    count = np.bincount(np.concatenate([*rows, np.zeros(0, dtype=np.int64)]), minlength=n)
    only = np.full(n, -1)
    areas_at: dict[int, list[int]] = {shared: [] for shared in np.flatnonzero(count > 1).tolist()}
    for k, own in enumerate(rows):
        only[own] = k
        for shared in own[count[own] > 1].tolist():
            areas_at[shared].append(k)
    only[count != 1] = -1
    return _Members(tuple(area_buses), rows, areas_at, only)


def _with_schedule(partition: Partition) -> Partition:
    """The partition with what each area must know of the whole: its way to the hub, the number of areas, its start."""
    network, towards = partition.network, _find_ways(partition, partition.hub)
    assert network.slack is not None  # checked by _find_bus_problems
    vm, va = find_no_load(network, network.slack.bus)
    va, table, first = va + network.slack.va, network.table, network.table.nodes.first
    unloaded = {bus: (float(vm[node]), float(va[node])) for bus, node in zip(network.row, first.tolist(), strict=True)}
    has_taps = bool((table.tap != 1.0).any() or (table.shift != 0.0).any())
    may_differ = has_taps and (len(table.active) >= len(table.bus_id) or not all(a.is_on_tree for a in partition.areas))
    areas = []
    for area in partition.areas:
        scheduled = replace(
            area,
            towards_hub=towards[area.name],
            n_areas=len(partition.areas),
            entry_voltage=unloaded[area.entry_bus],
        )
        if table.nodes.is_balanced:
            given = scheduled.boundary_buses if may_differ and _is_apart(scheduled, unloaded) else ()
            no_load = tuple((bus, *unloaded[bus]) for bus in given)
        else:
            own, nodes = area.network.table, partition.rows_of_nodes[area.name]
            of_nodes = own.bus_id[own.nodes.item].tolist(), vm[nodes].tolist(), va[nodes].tolist()
            no_load = tuple(zip(*of_nodes, strict=True))
        areas.append(replace(scheduled, no_load=no_load) if no_load else scheduled)
    return replace(partition, areas=tuple(areas))


def _is_apart(area: Area, unloaded: Mapping[int, tuple[float, float]]) -> bool:
    """True where an area that knows its entry voltage alone finds other voltages than the ``unloaded`` grid has.

    The voltages differ where taps or shifts do not cancel around a loop, in the area or through it. ``unloaded``: bus
    -> (vm, va), p.u. and rad.
    """
    expected = np.array([unloaded[bus.id] for bus in area.network.buses])
    return bool(abs(np.column_stack(area.find_no_load()) - expected).max() > SAME_VOLTAGE)


def _find_ways(partition: Partition, hub: str) -> dict[str, str | None]:
    """Area -> the neighbour on its way to ``hub``."""
    towards: dict[str, str | None] = {hub: None}
    queue = [hub]
    for name in queue:  # the queue grows
        for neighbour in partition.area(name).neighbours:
            if neighbour.area not in towards:
                towards[neighbour.area] = name
                queue.append(neighbour.area)
    return towards


def _find_slack_problems(
    network: Network, members: _Members, local_slack: Mapping[str, tuple[int, float]]
) -> Iterator[str]:
    for name, (bus, vm) in local_slack.items():
        if name not in members.names:
            yield f"local slack of area {name}, which is not one of the areas {', '.join(members.names)}"
        elif network.row.get(bus, -1) not in members.rows[members.names.index(name)]:
            yield f"area {name}: slack_bus {bus} is not one of its buses"
        if not (math.isfinite(vm) and vm > 0):
            yield f"area {name}: slack_vm is {vm}; it must be a positive voltage in p.u."


def _find_bus_problems(network: Network, area_buses: Mapping[str, Sequence[int]], members: _Members) -> list[str]:
    problems = []
    if not area_buses:
        problems.append("there is no area; name at least one")
    for (name, buses), rows in zip(area_buses.items(), members.rows, strict=True):
        for bus_id, count in Counter(buses).items() if len(rows) < len(buses) else ():
            if bus_id not in network.row:
                problems.append(f"area {name}: bus {bus_id} is not in the network")
            if count > 1:
                problems.append(f"area {name}: bus {bus_id} is listed {count} times; list it once")
        if not buses:
            problems.append(f"area {name} lists no bus; give it some or leave it out")
    for row in np.flatnonzero(members.only < 0).tolist():
        if row not in members.areas_at:
            problems.append(f"bus {network.table.bus_id[row]} is in no area; add it to the buses of one")
    return problems + network.find_supply_problems()


def _walk_areas(network: Network, members: _Members) -> MessageTree:
    """The tree of a walk from the substation over shared buses; over branches between areas where it needs them."""
    table, at_slack = network.table, members.find_areas(network.row[network.slack.bus]) if network.slack else []
    first = at_slack[0] if at_slack else 0
    groups = [areas for _, areas in sorted(members.areas_at.items(), key=lambda item: int(table.bus_id[item[0]]))]
    if not members.names or len((walk := walk_areas(len(members.names), first, groups)).order) == len(members.names):
        return walk if members.names else MessageTree((), ())
    near, far = members.only[table.f], members.only[table.t]
    for k in np.flatnonzero((near != far) | (near < 0)).tolist():
        here, there = (members.find_areas(int(rows[k])) for rows in (table.f, table.t))
        if not {*here} & {*there}:
            groups.append([*here, *there])
    return walk_areas(len(members.names), first, groups)


def _assign_branches(
    network: Network, members: _Members, walk: MessageTree, holders: Mapping[str, str]
) -> tuple[list[np.ndarray], list[str]]:
    """The branches of each area, by rows; and all problems, among them areas in pieces."""
    table, names = network.table, members.names
    wrong = _find_wrong_holders(network, members, holders)
    problems, holders = [*wrong.values()], {b: holder for b, holder in holders.items() if b not in wrong}
    ends = table.end_rows
    near, far = members.only[ends[0]], members.only[ends[1]]
    inside = (near >= 0) & (near == far)
    if holders:
        inside &= ~np.isin(network.branch_ids, list(holders))
    pairs = [(near[inside], np.flatnonzero(inside))]
    for row in np.flatnonzero(~inside).tolist():  # at boundary buses, or between areas
        here, there = (members.find_areas(int(rows[row])) for rows in ends)
        homes, called = [area for area in here if area in there], network.branch_ids[row]
        if holder := holders.get(called):
            homes = [names.index(holder)]
        elif not homes and (table.in_service[row] or called in holders):
            homes = [area for area in walk.order if area in here][:1]
        elif len(homes) > 1 and not table.in_service[row]:
            homes = [area for area in walk.order if area in homes][:1]
        elif len(homes) > 1:
            problems.append(
                f"areas {', '.join(names[area] for area in homes)} all list both ends of branch {called}; leave bus "
                f"{table.from_bus[row]} or {table.to_bus[row]} out of all but one of them"
            )
        pairs.append((np.array(homes, dtype=np.int64), np.full(len(homes), row)))
    holder_of, rows_held = (np.concatenate(part) for part in zip(*pairs, strict=True))
    order = np.argsort(rows_held, kind="stable")
    holder_of, rows_held = holder_of[order], rows_held[order]
    problems += _find_pieces(network, members, holder_of, rows_held)
    return [rows_held[at] for at in split_by(holder_of, len(names))], problems


def _find_wrong_holders(network: Network, members: _Members, holders: Mapping[str, str]) -> dict[str, str]:
    """Branch -> the problem of its entry in ``holders``, for those that have one."""
    found = {}
    for branch, holder in holders.items():
        if branch not in network.branch_by_id:
            found[branch] = f"branch {branch} is to be held by an area, and is not in the network"
        elif holder and holder not in members.names:
            areas = listed(members.names)
            found[branch] = f"branch {branch} is to be held by {holder}, which is not one of the areas {areas}"
        elif holder:
            ends = network.branch(branch).from_bus, network.branch(branch).to_bus
            there = (members.find_areas(network.row[bus]) for bus in ends)
            if members.names.index(holder) not in {area for areas in there for area in areas}:
                found[branch] = (
                    f"area {holder} lists neither bus of branch {branch}, {ends[0]} and {ends[1]}; give it one"
                )
    return found


def _find_pieces(network: Network, members: _Members, area: np.ndarray, row: np.ndarray) -> Iterator[str]:
    """A problem for each area that its own branches, open ones among them, do not connect, as text.

    Area ``area[k]`` holds the branch of ``row[k]``.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    table, n = network.table, len(network.table.bus_id)
    if not members.rows:
        return
    key = np.concatenate([k * n + rows for k, rows in enumerate(members.rows)])  # of each bus of each area, rising
    wanted = [area * n + end[row] for end in table.end_rows]
    at = [np.minimum(np.searchsorted(key, of_end), len(key) - 1) for of_end in wanted]
    within = np.logical_and(*(key[places] == of_end for places, of_end in zip(at, wanted, strict=True)))
    ends = tuple(places[within] for places in at)
    graph = csr_array((np.ones(len(ends[0])), ends), shape=(len(key), len(key)))
    pieces = np.split(connected_components(graph, directed=False)[1], np.cumsum([len(rows) for rows in members.rows]))
    for k, (name, rows, piece) in enumerate(zip(members.names, members.rows, pieces, strict=False)):
        if len(rows) == 1 and n > 1 and not (area == k).any():
            yield f"area {name} has a single bus and no branch; add the bus to a neighbouring area instead"
        elif len(rows) and (piece != piece[0]).any():
            found: dict[int, list[int]] = {}
            for bus, number in sorted(zip(table.bus_id[rows].tolist(), piece.tolist(), strict=True)):
                found.setdefault(number, []).append(bus)
            text = " | ".join(", ".join(map(str, buses)) for buses in found.values())
            yield f"area {name} is not connected by its own branches: it falls into buses {text}"


@dataclass
class _Edges:
    """The edges of an area in the tree of messages: its ``neighbours``, and the buses of others that it sees or relays.

    ``foreign``: bus -> the set of its phases that the area sees or relays.
    """

    neighbours: list[Neighbour] = field(default_factory=list)
    foreign: dict[int, int] = field(default_factory=dict)


def _grow_tree(network: Network, members: _Members, branches: Sequence[np.ndarray], walk: MessageTree) -> list[_Edges]:
    """The edges of each area; ``walk``: over all areas, from the substation.

    Of the areas that list a bus, that of the shortest way to the substation is the owner.

    Raises:
        InvalidInputError: an edge carries more than MOST_CARRIED variables.
    """
    names, rank = members.names, {area: k for k, area in enumerate(walk.order)}
    shared = []
    for bus, (listing, seeing) in sorted(_find_seen(network, members, branches).items()):
        owner, *others = sorted(listing, key=rank.__getitem__)
        others += sorted(seeing - {*listing}, key=rank.__getitem__)
        shared.append(SharedBus(bus, owner, {k: _phases_of(network, branches[k], bus) for k in others}))
    tree = choose_tree(walk, shared)
    carried = find_carried(tree, shared)
    edges = [(tree.above[area], area) for area in tree.order[1:]]
    if problems := [
        _explain_carried(network, members, branches, edge, carried[edge[1]])
        for edge in edges
        if carried[edge[1]].d > MOST_CARRIED
    ]:
        raise InvalidInputError(f"areas of network {network.name!r}", problems)
    found = [_Edges() for _ in names]
    owners, meets = {at.bus: at.owner for at in shared}, _find_meeting_buses(tree, shared)
    for above, area in edges:
        variables = carried[area].list_names(names)
        if variables == boundary_at((meets[area],), names[area]).names:
            variables = ()
        for one, other in ((above, area), (area, above)):
            found[one].neighbours.append(Neighbour(names[other], meets[area], other == above, variables))
            for bus, phases in carried[area].list_phases().items():
                if owners[bus] != one:
                    found[one].foreign[bus] = found[one].foreign.get(bus, 0) | phases
    return found


def _find_seen(
    network: Network, members: _Members, branches: Sequence[np.ndarray]
) -> dict[int, tuple[Sequence[int], set[int]]]:
    """Bus that several areas see -> the places of those that list it, and of those that hold a branch there."""
    table = network.table
    seeing = {row: {*areas} for row, areas in members.areas_at.items()}
    for area, held in enumerate(branches):
        ends, listed_rows = table.end_rows[:, held], {*members.rows[area].tolist()}
        for row in sorted({*ends.ravel().tolist()} - listed_rows):
            seeing.setdefault(row, set(members.find_areas(row))).add(area)
    return {int(table.bus_id[row]): (members.find_areas(row), areas) for row, areas in seeing.items()}


def _find_meeting_buses(tree: MessageTree, shared: Sequence[SharedBus]) -> dict[int, int]:
    """Area -> the first bus at which it meets the area above it."""
    meets: dict[int, int] = {}
    for at in shared:
        there = set(at.areas)
        for area in at.areas:
            if tree.above[area] in there:
                meets.setdefault(area, at.bus)
    return meets


def _explain_carried(
    network: Network, members: _Members, branches: Sequence[np.ndarray], edge: tuple[int, int], carried: Carried
) -> str:
    """The problem of an edge between two areas with too many variables, and the branches that cause it."""
    causes = []
    for bus, powers in carried.powers.items():
        for area in powers:
            held = [network.branch_ids[k] for k in branches[area] if bus in _ends_of(network, k)]
            causes.append(f"{listed(held)} of {members.names[area]} at bus {bus}")
    one, other = (members.names[area] for area in edge)
    return (
        f"{one} and {other} would exchange {carried.d} variables, of at most {MOST_CARRIED}, as rings pass between "
        f"them over the branches {'; '.join(causes)}; open some of these branches, or move cuts so that a ring "
        "lies within one area"
    )


def _ends_of(network: Network, branch: int) -> tuple[int, int]:
    """The buses of a branch, by its row."""
    return int(network.table.from_bus[branch]), int(network.table.to_bus[branch])


def _phases_of(network: Network, branches: np.ndarray, bus: int) -> int:
    """The set of phases that ``branches``, by rows, have at ``bus``."""
    table = network.table
    is_there = table.end_rows[:, branches] == network.row[bus]
    return int(np.bitwise_or.reduce(table.branch_phases[:, branches][is_there]))


def _split_by_owner(
    network: Network, members: _Members, edges: Sequence[_Edges], items: Sequence[Supplied]
) -> dict[str, list[Supplied]]:
    """Area -> those of ``items``, such as loads, at the buses that it owns."""
    found: dict[str, list[Supplied]] = {name: [] for name in members.names}
    for item in items:
        for area in members.find_areas(network.row[item.bus]):
            if item.bus not in edges[area].foreign:
                found[members.names[area]].append(item)
    return found


def _cut_out(
    network: Network,
    name: str,
    rows: np.ndarray,
    branches: np.ndarray,
    items: tuple[tuple[Generator, ...], tuple[Load, ...], tuple[Shunt, ...]],
    foreign: Mapping[int, int],
) -> Network:
    """The part of the network that area ``name`` knows, its buses and branches by rows, and its own ``items``;
    ``foreign`` buses are bare.
    """
    ids = network.table.bus_id
    rows = np.union1d(rows, np.array([network.row[bus] for bus in foreign], dtype=np.int64))
    buses = take_items(network.buses, rows)
    for bus, phases in foreign.items():
        buses = _bare(buses, int(np.searchsorted(rows, network.row[bus])), write_phases(phases))
    held = take_items(network.branches, branches)
    is_balanced, there = network.table.nodes.is_balanced, ids[rows]
    gauge = None if is_balanced else network.gauge.within(there, np.setdiff1d(there, list(foreign)))
    generators, loads, shunts = items
    return Network(name, network.base_mva, buses, held, generators, loads, gauge, shunts)


def _bare(buses: Sequence[Bus], place: int, phases: str) -> Sequence[Bus]:
    """``buses``, the one at ``place`` with ``phases`` only and without load and shunt."""
    bare: dict[str, Any] = {"p_load": 0.0, "q_load": 0.0, "g_shunt": 0.0, "b_shunt": 0.0, "phases": phases}
    if isinstance(buses, Records):
        for key in buses.columns.keys() & bare.keys():
            buses.columns[key][place] = bare[key]
        return buses
    return (*buses[:place], replace(buses[place], **bare), *buses[place + 1 :])


def _default_slack(part: Network, parent: Neighbour | None) -> tuple[int, float | None]:
    if part.slack is not None:
        return part.slack.bus, part.slack.vm
    for generator in part.generators:
        if generator.control is Control.VOLTAGE:
            return generator.bus, generator.vm
    assert parent is not None  # an area without the substation has been entered from another
    return parent.bus, None
