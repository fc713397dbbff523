"""Division of a network into areas: the branches of each, the tree of the areas, and what each area then knows."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import find_no_load
from dsse_core.grid.boundary import boundary_at, boundary_of
from dsse_core.grid.columns import Records, split_by, take_items
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Bus, Control, Generator, Network
from dsse_core.grid.nodes import read_phases, write_phases
from dsse_core.grid.partition import Area, Neighbour, Partition

Supplied = TypeVar("Supplied", Generator, Load)

SAME_VOLTAGE = 1e-9  # p.u. and rad, of an unloaded bus; rounding leaves 1e-13


def build_partition(
    network: Network,
    area_buses: Mapping[str, Sequence[int]],
    local_slack: Mapping[str, tuple[int, float]] | None = None,
) -> Partition:
    """Divides ``network`` into the named areas; ``area_buses`` lists the buses of each, boundary buses in several.

    The local slack of an area is the substation or the first voltage-holding generator in it, else the
    boundary bus towards the substation; ``local_slack`` (area -> bus, vm in p.u.) overrides it.

    Raises:
        InvalidInputError: listing every bus or branch in no area, area in pieces, unknown name, and the
            cycle if a ring passes through more than two areas.
    """
    local_slack = local_slack or {}
    members = _find_members(network, area_buses)
    problems = _find_bus_problems(network, area_buses, members)
    branches, branch_problems = _assign_branches(network, members)
    problems += branch_problems
    problems += _find_slack_problems(network, members, local_slack)
    if problems:
        raise InvalidInputError(f"areas of network {network.name!r}", problems)

    assert network.slack is not None  # checked by _find_bus_problems
    neighbours = _grow_tree(network, members, branches)
    at_slack = {members.names[k] for k in members.find_areas(network.row[network.slack.bus])}
    generators = _split_by_owner(network, members, neighbours, network.generators)
    loads = _split_by_owner(network, members, neighbours, network.loads)
    areas = []
    for name, rows, held in zip(members.names, members.rows, branches, strict=True):
        parent = next((n for n in neighbours[name] if n.is_parent), None)
        part = _cut_out(network, name, rows, held, generators[name], loads[name], parent)
        bus, vm = local_slack.get(name) or _default_slack(part, parent)
        reference = (network.slack.bus, network.slack.va) if name in at_slack else None
        areas.append(Area(name, part, tuple(neighbours[name]), bus, vm, reference))
    return _with_schedule(Partition(network, tuple(areas)))


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
    has_loops = len(table.active) >= len(table.bus_id)
    may_differ = has_loops and bool((table.tap != 1.0).any() or (table.shift != 0.0).any())
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
        areas.append(replace(scheduled, no_load=no_load))
    return Partition(network, tuple(areas))


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


def _assign_branches(network: Network, members: _Members) -> tuple[list[np.ndarray], list[str]]:
    """The branches in service of each area, by rows: those whose two ends it alone lists together; and all problems,
    among them areas in pieces.
    """
    table, names, problems = network.table, members.names, []
    near, far = members.only[table.f], members.only[table.t]
    inside = (near >= 0) & (near == far)
    pairs = [(near[inside], np.flatnonzero(inside))]
    for k in np.flatnonzero(~inside).tolist():  # at boundary buses, or in no area
        there = members.find_areas(int(table.t[k]))
        homes = [area for area in members.find_areas(int(table.f[k])) if area in there]
        pairs.append((np.array(homes, dtype=np.int64), np.full(len(homes), k)))
        branch = table.active[k]
        called, ends = network.branch_ids[branch], f"{table.from_bus[branch]} and {table.to_bus[branch]}"
        if not homes:
            problems.append(
                f"branch {called} is in no area: no area lists both of its buses {ends}; "
                "add one of them to the other's area"
            )
        elif len(homes) > 1:
            problems.append(
                f"areas {', '.join(names[area] for area in homes)} all list both ends of branch {called}; leave bus "
                f"{table.from_bus[branch]} or {table.to_bus[branch]} out of all but one of them"
            )
    area, place = (np.concatenate(part) for part in zip(*pairs, strict=True))
    order = np.argsort(place, kind="stable")
    area, place = area[order], place[order]
    problems += _find_pieces(network, members, area, place)
    return [table.active[place[at]] for at in split_by(area, len(names))], problems


def _find_pieces(network: Network, members: _Members, area: np.ndarray, place: np.ndarray) -> Iterator[str]:
    """A problem for each area that its own branches do not connect, as text.

    Area ``area[k]`` holds the branch at ``place[k]`` among those in service.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    table, n = network.table, len(network.table.bus_id)
    if not members.rows:
        return
    key = np.concatenate([k * n + rows for k, rows in enumerate(members.rows)])  # of each bus of each area, rising
    ends = [np.searchsorted(key, area * n + end[place]) for end in (table.f, table.t)]
    graph = csr_array((np.ones(len(place), dtype=bool), tuple(ends)), shape=(len(key), len(key)))
    pieces = np.split(connected_components(graph, directed=False)[1], np.cumsum([len(rows) for rows in members.rows]))
    for name, rows, piece in zip(members.names, members.rows, pieces, strict=False):
        if len(rows) == 1 and n > 1:
            yield f"area {name} has a single bus and no branch; add the bus to a neighbouring area instead"
        elif len(rows) and (piece != piece[0]).any():
            found: dict[int, list[int]] = {}
            for bus, number in sorted(zip(table.bus_id[rows].tolist(), piece.tolist(), strict=True)):
                found.setdefault(number, []).append(bus)
            text = " | ".join(", ".join(map(str, buses)) for buses in found.values())
            yield f"area {name} is not connected by its own branches: it falls into buses {text}"


def _grow_tree(network: Network, members: _Members, branches: Sequence[np.ndarray]) -> dict[str, list[Neighbour]]:
    """The neighbours of each area, by a walk from the substation over areas and boundary buses.

    An area and its parent may meet at several boundary buses. Any other second way to an area is a ring through more
    areas.

    Raises:
        InvalidInputError: the areas form such a ring.
    """
    assert network.slack is not None  # checked by _find_bus_problems
    ids, names = network.table.bus_id, members.names
    meeting = {int(ids[row]): [names[area] for area in areas] for row, areas in members.areas_at.items()}
    shared: dict[str, list[int]] = {name: [] for name in names}
    for bus in sorted(meeting):
        for name in meeting[bus]:
            shared[name].append(bus)
    met: dict[str, list[int]] = {name: [] for name in names}  # buses at which an area and its parent meet
    order: dict[str, list[str]] = {name: [] for name in names}  # the neighbours of an area
    root = names[members.find_areas(network.row[network.slack.bus])[0]]
    entered_by: dict[str, tuple[int, str] | None] = {root: None}  # area -> (boundary bus, its owner)
    queue = deque([root])
    while queue:
        name = queue.popleft()
        for bus in shared[name]:
            if bus in met[name]:
                continue  # the parent has been at all areas there
            for other in meeting[bus]:
                if other == name:
                    continue
                if other not in entered_by:
                    entered_by[other] = (bus, name)
                    order[name].append(other)
                    order[other].append(name)
                    queue.append(other)
                elif (entry := entered_by[other]) is None or entry[1] != name:
                    raise _loop_error(network, entered_by, name, other, bus)
                met[other].append(bus)
    parents = {name: entry[1] for name, entry in entered_by.items() if entry}
    names_of: dict[str, tuple[str, ...]] = {}  # child -> the variables that it shares with its parent
    for child, held in zip(names, branches, strict=True):
        phases = [_phases_of(network, held, bus) for bus in met[child]]
        if len(phases) > 1 or any(phases):
            places = [f"{bus}.{text}" if text else bus for bus, text in zip(met[child], phases, strict=True)]
            names_of[child] = boundary_at(places, child).names

    def meet(name: str, other: str) -> Neighbour:
        """``other`` as the neighbour of area ``name``."""
        is_parent = parents.get(name) == other
        child = name if is_parent else other
        return Neighbour(other, met[child][0], is_parent, names_of.get(child, ()))

    return {name: [meet(name, other) for other in others] for name, others in order.items()}


def _phases_of(network: Network, branches: np.ndarray, bus: int) -> str:
    """The phases that ``branches``, by rows, have at ``bus``."""
    if network.table.nodes.is_balanced:
        return ""
    ends = [(network.branches[row], network.table.primitives[row]) for row in branches.tolist()]
    texts = [primitive.from_phases for branch, primitive in ends if branch.from_bus == bus]
    texts += [primitive.to_phases for branch, primitive in ends if branch.to_bus == bus]
    return write_phases(int(np.bitwise_or.reduce(read_phases(texts))))


def _buses_at(parent: Neighbour | None) -> tuple[int, ...]:
    """The boundary buses that ``parent`` owns."""
    return () if parent is None else boundary_of(parent.variables).buses or (parent.bus,)


def _loop_error(
    network: Network, entered_by: Mapping[str, tuple[int, str] | None], one: str, other: str, bus: int
) -> InvalidInputError:
    """The error that names the cycle that closes where areas ``one`` and ``other`` meet again at ``bus``."""

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
        [
            f"areas form a loop: {text}, closed at bus {bus}; a ring may pass through an area and its parent only: "
            "move the cut so that the areas form a tree"
        ],
    )


def _split_by_owner(
    network: Network, members: _Members, neighbours: Mapping[str, Sequence[Neighbour]], items: Sequence[Supplied]
) -> dict[str, list[Supplied]]:
    """Area -> those of ``items``, generators or loads, at the buses that it owns."""
    found: dict[str, list[Supplied]] = {name: [] for name in members.names}
    not_owned = {name: {bus for n in of if n.is_parent for bus in _buses_at(n)} for name, of in neighbours.items()}
    for item in items:
        for area in members.find_areas(network.row[item.bus]):
            if item.bus not in not_owned[name := members.names[area]]:
                found[name].append(item)
    return found


def _cut_out(
    network: Network,
    name: str,
    rows: np.ndarray,
    branches: np.ndarray,
    generators: Sequence[Generator],
    loads: Sequence[Load],
    parent: Neighbour | None,
) -> Network:
    """The part of the network that area ``name`` knows, its buses and branches by rows; a bus not owned is bare."""
    buses = take_items(network.buses, rows)
    for bus in _buses_at(parent):
        place = int(np.searchsorted(rows, network.row[bus]))
        buses = _bare(buses, place, _phases_of(network, branches, bus))
    held = take_items(network.branches, branches)
    ids = network.table.bus_id[rows]
    owned = np.setdiff1d(ids, _buses_at(parent))
    gauge = None if network.table.nodes.is_balanced else network.gauge.within(ids, owned)
    return Network(name, network.base_mva, buses, held, tuple(generators), tuple(loads), gauge)


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
