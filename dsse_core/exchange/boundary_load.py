"""Net loads at boundary buses: the grid beyond an area's network as loads there.

The load at a boundary bus is loads minus generation of everything beyond it (thesis eqs. 5.1, 5.2, 5.6,
5.7); losses beyond are neglected. It is summed hop by hop along the tree of areas: area i sends neighbour j
the net load of all buses on its side. A boundary bus itself counts on the side of its owner. Shunts and line
charging count as loads at 1 p.u. voltage, with phases at the voltages of the unloaded grid; the difference at other
voltages is neglected.

A balanced load has one place, wherever it stands, as power reaches each boundary undivided. With phases a load stands
at its node, and an area carries all loads to each boundary as currents (``Area.carried_loads``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.boundary import Boundary
from dsse_core.grid.measurement import Measurement, MeasurementKind, Source
from dsse_core.grid.partition import Area, Partition
from dsse_core.linear.boundary_information import BoundaryInformation

UNSURE_OF_LOAD = 0.1  # share of a net load that is added to its standard deviation, as it neglects losses
LEAST_LOAD = 0.01  # p.u., added to the standard deviation of the power of a stand-in
AS_IT_WAS = 0.05  # p.u. and rad: standard deviation of a voltage beside a silent neighbour from its last value


@dataclass(frozen=True, slots=True)
class NetLoad:
    """Loads minus generation, ``s`` = p + jq in p.u.; ``variance`` of p and of q, as far as they were measured."""

    s: complex
    variance: float = 0.0


Loads = tuple[NetLoad, ...]
"""The net load of a balanced area or side, alone; with phases of each node, or of each phase of a boundary."""


def add_loads(loads: Iterable[NetLoad]) -> NetLoad:
    """The sum of loads whose errors are independent."""
    loads = list(loads)
    return NetLoad(sum((load.s for load in loads), complex(0.0)), sum(load.variance for load in loads))


def measured_net_loads(area: Area, measurements: Sequence[Measurement]) -> dict[int, NetLoad]:
    """Node -> net load, for the nodes of buses with a source whose P and Q injections are both telemetered.

    The total of a bus with phases is that of each of them, in p.u. of a third of the power.
    """
    network = area.network
    buses = {generator.bus for generator in network.generators}
    at_sources = [m for m in measurements if m.meter.bus in buses and m.meter.source is Source.TELEMETERED]
    read = {(m.meter.kind, m.meter.bus, m.meter.phases): m for m in at_sources}
    loads = {}
    for node in (node for bus in buses for node in network.nodes_at(bus).tolist()):
        bus, phase = network.nodes[node]
        p, q = (
            read.get((kind, bus, phase), read.get((kind, bus, "")))
            for kind in (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
        )
        if p is not None and q is not None:
            loads[node] = NetLoad(-complex(p.value, q.value), max(p.sigma, q.sigma) ** 2)
    return loads


def own_net_loads(area: Area, measured: Mapping[int, NetLoad] | None = None) -> Loads:
    """The net loads that ``area`` owns: ``measured`` (node -> net load) where that is known, else scheduled.

    Shunts, which no injection meter sees, and the charging of the area's branches are added.
    """
    scheduled = area.scheduled_loads
    read = {node: load for node, load in (measured or {}).items() if node in scheduled}
    if area.network.table.nodes.is_balanced:
        of_schedule = (s for node, s in scheduled.items() if node not in read)
        return (add_loads([*read.values(), NetLoad(sum(of_schedule, area.shunt_load))]),)
    here = (read.get(node, NetLoad(scheduled.get(node, 0j))) for node in range(area.network.n_nodes))
    return tuple(add_loads([load, NetLoad(s)]) for load, s in zip(here, area.shunt_loads.tolist(), strict=True))


def load_message_for(area: Area, neighbour: str, own: Loads, received: Mapping[str, Loads]) -> Loads:
    """Load message of ``area`` to ``neighbour``: its own net loads and those of its other neighbours."""
    others = {name: loads for name, loads in received.items() if name != neighbour}
    if area.network.table.nodes.is_balanced:
        return (add_loads([*own, *(load for loads in others.values() for load in loads)]),)
    s, variance = (np.array([getattr(load, what) for load in own]) for what in ("s", "variance"))
    for name, loads in others.items():
        np.add.at(s, area.boundary_nodes[name], [load.s for load in loads])
        np.add.at(variance, area.boundary_nodes[name], [load.variance for load in loads])
    carried = area.carried_loads[neighbour]
    return tuple(map(NetLoad, (carried @ s).tolist(), (abs(carried) ** 2 @ variance).tolist()))


def boundary_loads(area: Area, received: Mapping[str, Loads], error: complex = 0j) -> dict[int, NetLoad]:
    """Boundary bus of a balanced area -> load beyond it: the sum of the neighbours' load messages there, plus ``error``
    (eqs. 5.4, 5.5).

    The error is added once per boundary bus. A bus whose neighbours have not all been received is left out.
    """
    loads = {}
    for bus in area.boundary_buses:
        beyond = [n.area for n in area.neighbours if n.bus == bus]
        if all(name in received for name in beyond):
            loads[bus] = add_loads([NetLoad(complex(error)), *(load for name in beyond for load in received[name])])
    return loads


def powers_from(area: str, boundary: Boundary, loads: Loads) -> np.ndarray:
    """The powers of a ``boundary`` of one flow, where the net loads beyond it are ``loads``, p.u., as y has them."""
    s = np.array([load.s for load in loads]) * (-1.0 if boundary.powers[0].area == area else 1.0)
    return s.view(float)


def stand_in_for(boundary: Boundary, y: np.ndarray, all_load: float) -> BoundaryInformation:
    """Information about the ``boundary`` with a silent neighbour: its variables stay near y, shape (d,).

    The neighbour's last information would be too sure: its loads change, and it may operate switches. ``all_load``: sum
    of the sizes of net loads on both sides, p.u. The standard deviation of each power is ``all_load`` plus the largest
    power of y, plus LEAST_LOAD: a switch may end that power, generation may make up for a load, and a current may go
    around a ring without any load.
    """
    power = 1 / (all_load + abs(y[: boundary.n_powers]).max() + LEAST_LOAD)
    R = np.diag(boundary.per_kind(power, power, 1 / AS_IT_WAS, 1 / AS_IT_WAS))
    return BoundaryInformation(R, R @ y)


def scheduled_load_messages(partition: Partition) -> dict[str, dict[str, Loads]]:
    """Receiving area -> (neighbour -> load message) when every message is the schedule and none is lost."""
    own = {area.name: own_net_loads(area) for area in partition.areas}
    received: dict[str, dict[str, Loads]] = {area.name: {} for area in partition.areas}
    beside = {area.name: list(dict.fromkeys(n.area for n in area.neighbours)) for area in partition.areas}

    def send(sender: str, receiver: str) -> None:
        beyond = {name: received[sender][name] for name in beside[sender] if name != receiver}
        received[receiver][sender] = load_message_for(partition.area(sender), receiver, own[sender], beyond)

    links = [("", partition.areas[0].name)]  # from an area to the next, down the tree from the first area
    for above, name in links:
        links += [(name, below) for below in beside[name] if below != above]
    for above, name in reversed(links[1:]):
        send(name, above)
    for above, name in links[1:]:
        send(above, name)
    return received
