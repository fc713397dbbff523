"""Net loads at boundary buses: the grid beyond an area's network as one load per boundary bus.

The load at a boundary bus is loads minus generation of everything beyond it (thesis eqs. 5.1, 5.2, 5.6,
5.7); losses beyond are neglected. It is summed hop by hop along the tree of areas: area i sends neighbour j
the net load of all buses on its side. A boundary bus itself counts on the side of its owner. Shunts and line
charging count as loads at 1 p.u. voltage; the difference at another voltage is neglected.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.boundary import Boundary
from dsse_core.grid.measurement import Measurement, MeasurementKind, Source
from dsse_core.grid.partition import Area, Neighbour, Partition
from dsse_core.linear.boundary_information import BoundaryInformation

UNSURE_OF_LOAD = 0.1  # share of a net load that is added to its standard deviation, as it neglects losses
LEAST_LOAD = 0.01  # p.u., added to the standard deviation of every net load
AS_IT_WAS = 0.05  # p.u. and rad: standard deviation of a voltage from its last value where areas meet at several buses


@dataclass(frozen=True, slots=True)
class NetLoad:
    """Loads minus generation, ``s`` = p + jq in p.u.; ``variance`` of p and of q, as far as they were measured."""

    s: complex
    variance: float = 0.0


def add_loads(loads: Iterable[NetLoad]) -> NetLoad:
    """The sum of loads whose errors are independent."""
    loads = list(loads)
    return NetLoad(sum((load.s for load in loads), complex(0.0)), sum(load.variance for load in loads))


def measured_net_loads(area: Area, measurements: Sequence[Measurement]) -> dict[int, NetLoad]:
    """Bus -> net load, for the area's buses with a source whose P and Q injections are both telemetered."""
    buses = {generator.bus for generator in area.network.generators}
    at_sources = [m for m in measurements if m.meter.bus in buses and m.meter.source is Source.TELEMETERED]
    read = {(m.meter.kind, m.meter.bus): m for m in at_sources}
    loads = {}
    for bus in buses:
        p, q = (read.get((kind, bus)) for kind in (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION))
        if p is not None and q is not None:
            loads[bus] = NetLoad(-complex(p.value, q.value), max(p.sigma, q.sigma) ** 2)
    return loads


def own_net_load(area: Area, measured: Mapping[int, NetLoad] | None = None) -> NetLoad:
    """The net load of the buses that ``area`` owns: ``measured`` (bus -> net load) where that is known, else scheduled.

    Shunts, which no injection meter sees, and the charging of the area's branches are added.
    """
    read = {bus: load for bus, load in (measured or {}).items() if bus in area.scheduled_loads}
    scheduled = (s for bus, s in area.scheduled_loads.items() if bus not in read)
    return add_loads([*read.values(), NetLoad(sum(scheduled, area.shunt_load))])


def load_message_for(neighbour: str, own: NetLoad, received: Mapping[str, NetLoad]) -> NetLoad:
    """Load message to ``neighbour``: the area's own net load plus those of all its other neighbours."""
    return add_loads([own, *(load for name, load in received.items() if name != neighbour)])


def boundary_loads(area: Area, received: Mapping[str, NetLoad], error: complex = 0j) -> dict[int, NetLoad]:
    """Boundary bus -> load beyond it: the sum of the neighbours' load messages there, plus ``error`` (eqs. 5.4, 5.5).

    The error is added once per boundary bus. A bus whose neighbours have not all been received is left out.
    """
    loads = {}
    for bus in area.boundary_buses:
        beyond = [n.area for n in area.neighbours if n.bus == bus]
        if all(name in received for name in beyond):
            loads[bus] = add_loads([NetLoad(complex(error)), *(received[name] for name in beyond)])
    return loads


def stand_in_for(neighbour: Neighbour, boundary: Boundary, load: NetLoad) -> BoundaryInformation:
    """Information about the variables y of the ``boundary``, p.u. and rad, from the net load on its far side."""
    power = -load.s if neighbour.is_parent else load.s
    weight = 1 / (load.variance**0.5 + UNSURE_OF_LOAD * abs(load.s) + LEAST_LOAD)
    R = np.diag(boundary.per_kind(weight, weight, 0.0, 0.0))
    return BoundaryInformation(R, R @ boundary.per_kind(power.real, power.imag, 0.0, 0.0))


def stand_in_as_it_was(boundary: Boundary, y: np.ndarray, all_load: float) -> BoundaryInformation:
    """Information about a ``boundary`` at several buses with a silent neighbour: its variables stay near y, shape (d,).

    A net load has no side in a ring. The neighbour's last information is no better, as the neighbour may have operated
    switches since. ``all_load``: sum of the sizes of net loads on both sides, p.u. The standard deviation of each power
    is ``all_load`` plus the largest power of y, plus LEAST_LOAD: a switch may end that power, generation may make up
    for a load, and a current may go around the ring without any load.
    """
    power = 1 / (all_load + abs(y[: boundary.n_powers]).max() + LEAST_LOAD)
    R = np.diag(boundary.per_kind(power, power, 1 / AS_IT_WAS, 1 / AS_IT_WAS))
    return BoundaryInformation(R, R @ y)


def scheduled_load_messages(partition: Partition) -> dict[str, dict[str, NetLoad]]:
    """Receiving area -> (neighbour -> load message) when every message is the schedule and none is lost."""
    own = {area.name: own_net_load(area) for area in partition.areas}
    received: dict[str, dict[str, NetLoad]] = {area.name: {} for area in partition.areas}
    beside = {area.name: list(dict.fromkeys(n.area for n in area.neighbours)) for area in partition.areas}

    def send(sender: str, receiver: str) -> None:
        beyond = {name: received[sender][name] for name in beside[sender] if name != receiver}
        received[receiver][sender] = load_message_for(receiver, own[sender], beyond)

    links = [("", partition.areas[0].name)]  # from an area to the next, down the tree from the first area
    for above, name in links:
        links += [(name, below) for below in beside[name] if below != above]
    for above, name in reversed(links[1:]):
        send(name, above)
    for above, name in links[1:]:
        send(above, name)
    return received
