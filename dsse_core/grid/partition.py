"""The division of a network into areas that meet at boundary buses and form a tree.

Branches are divided among areas; a boundary bus is seen by every area whose branches meet there. Seen
from the substation, the first area at a boundary bus owns it (its load, its generators, its meters); the
others are children of the owner there. Neighbours are owner and child: the edges of the tree.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from dsse_core.grid.measurement import Meter
from dsse_core.grid.network import Network
from dsse_core.printable import listed

MOST_SHOWN = 4  # names of areas in one line


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another area met at boundary bus ``bus``; ``is_parent`` if it lies towards the substation."""

    area: str
    bus: int
    is_parent: bool


@dataclass(frozen=True, repr=False)
class Area:
    """What one area knows of the grid: its own part of the network and its neighbours' names.

    ``network`` holds the area's buses and branches; load, shunt and generators of a boundary bus stand only
    in the network of its owner. ``slack_bus`` is where the local power flow holds the voltage; ``slack_vm``
    its set-point in p.u., None when it is the voltage that the parent publishes for that bus. ``reference``:
    bus and angle (rad) of the substation, in every area that sees it.
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

    def __repr__(self) -> str:
        buses, branches = len(self.network.buses), len(self.network.branches)
        return f"<Area {self.name!r}: {buses} buses, {branches} branches, {len(self.neighbours)} neighbours>"

    @property
    def is_reference(self) -> bool:
        """Whether the area holds the substation, and with it the angle reference of the grid."""
        return self.network.slack is not None

    @property
    def parent(self) -> Neighbour | None:
        return next((n for n in self.neighbours if n.is_parent), None)

    @property
    def entry_bus(self) -> int:
        """Where a walk from the substation enters the area: the parent's bus, or the substation itself."""
        return self.parent.bus if self.parent else self.reference[0] if self.reference else self.slack_bus

    @property
    def boundary_buses(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys(n.bus for n in self.neighbours))

    @cached_property
    def scheduled_loads(self) -> dict[int, complex]:
        """Bus that the area owns -> its loads minus generation by the schedule, p.u.; shunts do not count."""
        not_owned = self.parent.bus if self.parent else None
        return {bus.id: -self.network.scheduled_injection(bus.id) for bus in self.network.buses if bus.id != not_owned}

    @cached_property
    def shunt_load(self) -> complex:
        """What bus shunts and line charging consume at 1 p.u.; a bus that is not owned is bare in ``network``."""
        shunts = sum((complex(bus.g_shunt, -bus.b_shunt) for bus in self.network.buses), complex(0.0))
        return shunts + sum(complex(branch.g, -branch.b) for branch in self.network.active_branches)


@dataclass(frozen=True, repr=False)
class Partition:
    """The areas of a network, a tree rooted at the area of the substation."""

    network: Network
    areas: tuple[Area, ...]

    def __repr__(self) -> str:
        names = listed([area.name for area in self.areas], MOST_SHOWN)
        buses, areas = len(self.network.buses), len(self.areas)
        return f"<Partition of {self.network.name!r}: {buses} buses in {areas} areas: {names}>"

    def area(self, name: str) -> Area:
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, Area]:
        return {area.name: area for area in self.areas}

    @cached_property
    def _area_of_branch(self) -> dict[str, str]:
        return {branch.id: area.name for area in self.areas for branch in area.network.branches}

    @cached_property
    def owner_of_bus(self) -> dict[int, str]:
        """Bus id -> the area that owns it: its only area, or the one towards the substation."""
        not_owned = {area.name: area.parent.bus for area in self.areas if area.parent}
        return {
            bus.id: area.name for area in self.areas for bus in area.network.buses if bus.id != not_owned.get(area.name)
        }

    def area_of_meter(self, meter: Meter) -> str:
        """The one area that a meter belongs to: that of its branch, or the owner of its bus."""
        return self._area_of_branch[meter.branch] if meter.branch else self.owner_of_bus[meter.bus]

    def meters_by_area(self, meters: Iterable[Meter]) -> dict[str, list[Meter]]:
        """Area -> its meters among ``meters``, in their order; every area is there."""
        found: dict[str, list[Meter]] = {area.name: [] for area in self.areas}
        of_branch, of_bus = self._area_of_branch, self.owner_of_bus
        for meter in meters:
            found[of_branch[meter.branch] if meter.branch else of_bus[meter.bus]].append(meter)
        return found

    @cached_property
    def boundaries(self) -> dict[int, tuple[str, ...]]:
        """Boundary bus -> the areas that see it, its owner first."""
        seen: dict[int, list[str]] = {}
        for area in self.areas:
            for bus in area.network.buses:
                seen.setdefault(bus.id, []).append(area.name)
        return {
            bus: tuple(sorted(names, key=lambda name: name != self.owner_of_bus[bus]))
            for bus, names in seen.items()
            if len(names) > 1
        }

    @property
    def hub(self) -> str:
        """The middle area of the longest path: from it all others are reached soonest."""
        return self.longest_path[len(self.longest_path) // 2]

    @cached_property
    def longest_path(self) -> tuple[str, ...]:
        """The areas on the longest path of the tree: a message from its one end to its other passes them all."""
        return self._farthest_from(self._farthest_from(self.areas[0].name)[-1])

    def _farthest_from(self, start: str) -> tuple[str, ...]:
        """The longest path that starts at area ``start``."""
        before: dict[str, str | None] = {start: None}
        queue = [start]
        for name in queue:  # which grows: breadth first, the last is the farthest
            for neighbour in self.area(name).neighbours:
                if neighbour.area not in before:
                    before[neighbour.area] = name
                    queue.append(neighbour.area)
        path = [queue[-1]]
        while (previous := before[path[-1]]) is not None:
            path.append(previous)
        return tuple(reversed(path))
