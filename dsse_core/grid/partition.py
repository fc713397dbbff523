"""The division of a network into areas that meet at boundary buses and exchange messages along a tree.

Branches are divided among areas; a boundary bus is seen by every area whose branches meet there. The area nearest to
the substation owns it (its load, its generators, its meters). Neighbours are areas joined by an edge of the tree of
messages (``message_tree.py``). Where areas form a tree, neighbours are the owner of a bus and another area there, and
the owner lies towards the substation. In rings an area may see buses of several owners, and relay variables of buses
where it has no branch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dsse_core.grid.admittance import build_admittance, carry_currents, find_no_load
from dsse_core.grid.boundary import Boundary, Kind, Variable, boundary_at, boundary_of
from dsse_core.grid.columns import Records, split_by, take_items
from dsse_core.grid.measurement import Meter
from dsse_core.grid.network import Network
from dsse_core.printable import listed

MOST_SHOWN = 4  # names of areas in one line


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another area met at boundary bus ``bus``, the first of several; ``is_parent`` if it lies towards the substation.

    ``variables``: names of the variables that the edge carries (``boundary.py``), where these are not those of a
    single balanced bus that the parent owns.
    """

    area: str
    bus: int
    is_parent: bool
    variables: tuple[str, ...] = ()

    def boundary_of(self, area: str) -> Boundary:
        """The variables that the edge between this neighbour and ``area`` carries."""
        return boundary_of(self.variables or boundary_at((self.bus,), area if self.is_parent else self.area).names)


def find_foreign(area: str, boundaries: Iterable[Boundary]) -> tuple[int, ...]:
    """The buses of an area's ``boundaries`` that other areas own.

    From such a bus a power flows into the area, or the area relays one, which two of its boundaries then have.
    """
    powers = Counter(power for boundary in boundaries for power in boundary.powers)
    return tuple(dict.fromkeys(v.bus for v, count in powers.items() if v.area == area or count > 1))


@dataclass(frozen=True, repr=False)
class Area:
    """The knowledge that one area has of the grid: its own part of the network and its neighbours' names.

    ``network`` holds the area's buses and branches, and the buses that it relays; load, shunt and generators of a
    boundary bus stand only in the network of its owner. Other areas have there only the phases of their branches, and
    those that they relay. ``slack_bus`` is where the local power
    flow holds the voltage; ``slack_vm`` its set-point in p.u., None when it is the voltage that the parent publishes
    for that bus. ``reference``: bus and angle (rad) of the substation, in every area that sees it: its nodes have given
    angles. ``towards_hub``: the neighbour on the way to the hub, None in the hub. ``n_areas``: number of areas of the
    grid. ``entry_voltage``: (vm, va), p.u. and rad, of ``entry_bus`` in the unloaded grid, of its first node.
    ``no_load``: (bus, vm, va) of the boundary buses in the unloaded grid, where taps or shifts do not cancel around a
    loop: the area alone would find other voltages. Of an area with phases all nodes, in their order; none where it is
    the whole grid.
    """

    name: str
    network: Network
    neighbours: tuple[Neighbour, ...]
    slack_bus: int
    slack_vm: float | None
    reference: tuple[int, float] | None = None
    towards_hub: str | None = None
    n_areas: int = 1
    entry_voltage: tuple[float, float] = (1.0, 0.0)
    no_load: tuple[tuple[int, float, float], ...] = ()

    def __repr__(self) -> str:
        buses, branches = len(self.network.buses), len(self.network.branches)
        return f"<Area {self.name!r}: {buses} buses, {branches} branches, {len(self.neighbours)} neighbours>"

    def operated(self, closed: Mapping[str, bool]) -> Area:
        """The same area with switches as in ``closed``: switch -> True where it is closed; others stay.

        No variable of a boundary depends on a status, and no neighbour needs to know one.
        """
        network = self.network.operated(closed)
        return self if network is self.network else replace(self, network=network)

    @property
    def is_reference(self) -> bool:
        """True where the area holds the substation, and with it the angle reference of the grid."""
        return self.network.slack is not None

    @property
    def is_at_reference(self) -> bool:
        """True where the area owns the bus of the angle reference, or has a branch there: it does not only relay it."""
        if self.reference is None:
            return False
        table, bus = self.network.table, self.reference[0]
        row = self.network.row[bus]
        return bus not in self.not_owned or bool((table.f == row).any() or (table.t == row).any())

    @property
    def parent(self) -> Neighbour | None:
        return next((n for n in self.neighbours if n.is_parent), None)

    @cached_property
    def entry_bus(self) -> int:
        """The bus where a walk from the substation enters the area: the first boundary bus, the parent's before others,
        with a branch in service; or the substation itself; without both the local slack bus.
        """
        if self.parent is None:
            return self.reference[0] if self.reference else self.slack_bus
        table = self.network.table
        joined = {*table.bus_id[table.f].tolist(), *table.bus_id[table.t].tolist()}
        met = self.parent.bus, *self.boundaries[self.parent.area].buses, *self.boundary_buses
        return next((bus for bus in met if bus in joined), self.parent.bus)

    @cached_property
    def boundaries(self) -> dict[str, Boundary]:
        """Neighbour -> the variables that the edge to it carries."""
        return {n.area: n.boundary_of(self.name) for n in self.neighbours}

    def find_no_load(self) -> tuple[np.ndarray, np.ndarray]:
        """The area's voltages (vm, va) in the unloaded grid, (n_nodes,), p.u. and rad."""
        if self.no_load and not self.network.table.nodes.is_balanced:
            _, vm, va = np.array(self.no_load).reshape(-1, 3).T
            return vm, va
        held = {bus: vm for bus, vm, _ in self.no_load} | {self.entry_bus: self.entry_voltage[0]}
        angles = {bus: va for bus, _, va in self.no_load} | {self.entry_bus: self.entry_voltage[1]}
        return find_no_load(self.network, self.entry_bus, held, angles)

    @cached_property
    def not_owned(self) -> tuple[int, ...]:
        """The area's buses that other areas own."""
        return find_foreign(self.name, self.boundaries.values())

    @cached_property
    def relayed(self) -> frozenset[int]:
        """The buses where the area has no branch, and whose variables it relays."""
        powers = {power for boundary in self.boundaries.values() for power in boundary.powers}
        return frozenset(self.not_owned) - {power.bus for power in powers if power.area == self.name}

    @cached_property
    def is_on_tree(self) -> bool:
        """True where the area meets each neighbour at a single balanced bus, which the one towards the substation owns,
        as all areas do that form a tree.
        """
        met = ((self.boundaries[n.area], n) for n in self.neighbours)
        return all(
            boundary.is_single and (boundary.variables[0].area == self.name) == n.is_parent for boundary, n in met
        )

    @cached_property
    def n_unknown(self) -> int:
        """The number of unknown magnitudes and angles of the nodes that the area owns, and of its estimated taps."""
        network, slack = self.network, self.network.slack
        not_owned = sum(len(network.nodes_at(bus)) for bus in self.not_owned)
        of_slack = len(network.nodes_at(slack.bus)) if slack else 0
        return 2 * (network.n_nodes - not_owned) - of_slack + len(network.estimated_taps)

    @cached_property
    def first_tap(self) -> int:
        """The place in the state of the first estimated tap, see ``join_state``."""
        return 2 * self.network.n_nodes + len(self.powers_into_children)

    @cached_property
    def size(self) -> int:
        """The number of variables of the state, see ``join_state``."""
        return self.first_tap + len(self.network.estimated_taps)

    def join_state(self, vm: np.ndarray, va: np.ndarray, powers: Sequence[float] | None = None) -> np.ndarray:
        """x = [va; vm; powers into children, 0 by default; estimated taps, as the network has them]."""
        of_powers = np.zeros(len(self.powers_into_children)) if powers is None else powers
        return np.concatenate([va, vm, of_powers, self.network.taps])

    @cached_property
    def powers_into_children(self) -> tuple[Variable, ...]:
        """The powers from boundary buses into the branches of other areas, each once."""
        powers = (v for boundary in self.boundaries.values() for v in boundary.powers)
        return tuple(dict.fromkeys(power for power in powers if power.area != self.name))

    @property
    def boundary_buses(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys(bus for n in self.neighbours for bus in self.boundaries[n.area].buses))

    @cached_property
    def scheduled_loads(self) -> dict[int, complex]:
        """Node that the area owns -> its loads minus generation by the schedule, p.u.; shunts do not count."""
        injected = self.network.find_scheduled(self._idle_voltages).tolist()
        return {node: -s for node, s in enumerate(injected) if self.network.node_buses[node] not in self.not_owned}

    @cached_property
    def shunt_loads(self) -> np.ndarray:
        """The power that bus shunts and line charging consume in the unloaded grid, (n_nodes,), complex, p.u."""
        v = self._idle_voltages
        with_shunts, without = (build_admittance(self.network, with_shunts=is_whole).ybus for is_whole in (True, False))
        drawn: np.ndarray = v * ((with_shunts - without) @ v).conj()
        return drawn

    @cached_property
    def boundary_nodes(self) -> dict[str, np.ndarray]:
        """Neighbour -> the nodes at the phases of their boundary, in its order."""
        return {
            name: np.array([self.network.node(v.bus, v.phase) for v in boundary.variables if v.kind is Kind.VM])
            for name, boundary in self.boundaries.items()
        }

    @cached_property
    def carried_loads(self) -> dict[str, np.ndarray]:
        """Neighbour -> the powers (k, n_nodes) that loads of 1 at each node draw at the phases of their boundary.

        Loads draw their currents in the unloaded grid; these flow through banks, and voltages are held at the boundary.
        """
        return {name: self._carry_loads(name) for name in self.boundaries}

    def _carry_loads(self, neighbour: str) -> np.ndarray:
        v, nodes = self._idle_voltages, self.boundary_nodes[neighbour]
        buses = self.boundaries[neighbour].buses
        held = np.unique(np.concatenate([self.network.nodes_at(bus) for bus in buses]))
        currents = carry_currents(self.network, held)[np.searchsorted(held, nodes)]
        carried: np.ndarray = v[nodes, None] * currents.conj() / v
        return carried

    @cached_property
    def _idle_voltages(self) -> np.ndarray:
        """The voltages of the unloaded grid, complex, p.u., (n_nodes,)."""
        vm, va = self.find_no_load()
        v: np.ndarray = vm * np.exp(1j * va)
        return v

    @cached_property
    def shunt_load(self) -> complex:
        """The power that bus shunts and line charging consume at 1 p.u., complex, p.u.; a bus that the area does not
        own has no shunt in ``network``.
        """
        shunts = sum((complex(bus.g_shunt, -bus.b_shunt) for bus in self.network.buses), complex(0.0))
        return shunts + sum(complex(branch.g, -branch.b) for branch in self.network.active_branches)


@dataclass(frozen=True, repr=False)
class Partition:
    """The areas of a network, and the tree of their messages, rooted at the area of the substation."""

    network: Network
    areas: tuple[Area, ...]
    listed: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Area -> the buses that divided the network; an area sees others, too, by branches that it holds, or relays them.
    """

    def __repr__(self) -> str:
        names = listed([area.name for area in self.areas], MOST_SHOWN)
        buses, areas = len(self.network.buses), len(self.areas)
        return f"<Partition of {self.network.name!r}: {buses} buses in {areas} areas: {names}>"

    def area(self, name: str) -> Area:
        return self._by_name[name]

    def operated(self, closed: Mapping[str, bool]) -> Partition:
        """The same division with switches as in ``closed``, see ``Area.operated``."""
        network = self.network.operated(closed)
        if network is self.network:
            return self
        return replace(self, network=network.supplied(), areas=tuple(area.operated(closed) for area in self.areas))

    @cached_property
    def _by_name(self) -> dict[str, Area]:
        return {area.name: area for area in self.areas}

    @cached_property
    def rows_of_buses(self) -> dict[str, np.ndarray]:
        """Area -> the rows in the whole network of the buses that it sees, in the area's order."""
        find = self.network.table.rows.find
        return {area.name: find(area.network.table.bus_id) for area in self.areas}

    @cached_property
    def rows_of_nodes(self) -> dict[str, np.ndarray]:
        """Area -> the rows in the whole network of the nodes that it sees, in the area's order."""
        nodes, of_buses = self.network.table.nodes, self.rows_of_buses
        own = {area.name: area.network.table.nodes for area in self.areas}
        return {name: nodes.find(of_buses[name][of_area.item], of_area.phase) for name, of_area in own.items()}

    @cached_property
    def rows_of_branches(self) -> dict[str, np.ndarray]:
        """Area -> the places of its branches among all branches of the network, in the area's order."""
        row = {branch: k for k, branch in enumerate(self.network.branch_ids)}
        return {
            area.name: np.array([row[branch] for branch in area.network.branch_ids], dtype=np.int64)
            for area in self.areas
        }

    @cached_property
    def rows_of_ports(self) -> dict[str, np.ndarray]:
        """Area -> the rows in the whole network of the ports of its branches in service, in the area's order."""
        table, found = self.network.table, {}
        for area in self.areas:
            own = area.network.table
            at_from = table.active_row[self.rows_of_branches[area.name][own.active]]
            ends = np.concatenate([at_from, len(table.active) + at_from])
            found[area.name] = table.ports.find(ends[own.ports.item], own.ports.phase)
        return found

    @cached_property
    def owner(self) -> np.ndarray:
        """The place in ``areas`` of each bus's owner, shape (n_bus,); -1 for a bus in no area."""
        owner = np.full(len(self.network.table.bus_id), -1)
        for k, area in enumerate(self.areas):
            is_owned = ~np.isin(area.network.table.bus_id, area.not_owned)
            owner[self.rows_of_buses[area.name][is_owned]] = k
        return owner

    @cached_property
    def holder(self) -> np.ndarray:
        """The place in ``areas`` of the holder of each branch, (n_all_branches,); -1 of an open one in no area."""
        holder = np.full(len(self.network.table.in_service), -1)
        for k, area in enumerate(self.areas):
            holder[self.rows_of_branches[area.name]] = k
        return holder

    @cached_property
    def owner_of_bus(self) -> dict[int, str]:
        """Bus id -> the area that owns it: its only area, or that nearest to the substation."""
        names = [area.name for area in self.areas]
        return {
            bus: names[k]
            for bus, k in zip(self.network.table.bus_id.tolist(), self.owner.tolist(), strict=True)
            if k >= 0
        }

    def area_of_meter(self, meter: Meter) -> str:
        """The one area that a meter belongs to: that of its branch, or the owner of its bus."""
        return self._area_of_branch[meter.branch] if meter.branch else self.owner_of_bus[meter.bus]

    @cached_property
    def _area_of_branch(self) -> dict[str, str]:
        return {branch: area.name for area in self.areas for branch in area.network.branch_ids}

    def split_meters(self, meters: Sequence[Meter]) -> dict[str, np.ndarray]:
        """Area -> the positions of its meters in ``meters``, which fit the network; every area is there."""
        names = [area.name for area in self.areas]
        if isinstance(meters, Records):
            branch = meters.columns["branch"]
            at_bus = self.owner[self.network.table.rows.find(meters.columns["bus"])]
            number = np.where(branch >= 0, np.append(self.holder, -1)[np.maximum(branch, -1)], at_bus)
        else:
            place = {name: k for k, name in enumerate(names)}
            number = np.array([place[self.area_of_meter(meter)] for meter in meters], dtype=np.int64)
        return dict(zip(names, split_by(number, len(names)), strict=True))

    def meters_by_area(self, meters: Sequence[Meter]) -> dict[str, Sequence[Meter]]:
        """Area -> its meters among ``meters``, in their order; every area is there."""
        return {name: take_items(meters, rows) for name, rows in self.split_meters(meters).items()}

    @cached_property
    def boundaries(self) -> dict[int, tuple[str, ...]]:
        """Boundary bus -> the areas that see it, its owner first."""
        seen = np.concatenate([*self.rows_of_buses.values(), np.zeros(0, dtype=np.int64)])
        is_shared = np.bincount(seen, minlength=len(self.owner)) > 1
        found: dict[int, list[str]] = {}
        for name, rows in self.rows_of_buses.items():
            for row in rows[is_shared[rows]].tolist():
                found.setdefault(row, []).append(name)
        ids, names = self.network.table.bus_id, [area.name for area in self.areas]
        owners = {row: names[self.owner[row]] for row in found}
        return {
            int(ids[row]): (owners[row], *(name for name in seeing if name != owners[row]))
            for row, seeing in found.items()
        }

    @property
    def hub(self) -> str:
        """The middle area of the longest path, from which messages reach all other areas soonest."""
        return self.longest_path[len(self.longest_path) // 2]

    @cached_property
    def longest_path(self) -> tuple[str, ...]:
        """The areas on the longest path of the tree, in the order in which a message passes them."""
        return self._farthest_from(self._farthest_from(self.areas[0].name)[-1])

    def _farthest_from(self, start: str) -> tuple[str, ...]:
        """The areas on the longest path that starts at area ``start``."""
        before: dict[str, str | None] = {start: None}
        queue = [start]
        for name in queue:  # the queue grows: breadth first, the last area is the farthest
            for neighbour in self.area(name).neighbours:
                if neighbour.area not in before:
                    before[neighbour.area] = name
                    queue.append(neighbour.area)
        path = [queue[-1]]
        while (previous := before[path[-1]]) is not None:
            path.append(previous)
        return tuple(reversed(path))
