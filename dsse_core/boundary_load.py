"""Net loads at boundary buses: what an area's network leaves out, as one complex load per boundary bus.

The load at a boundary bus is loads minus generation of everything beyond it (thesis eqs. 5.1, 5.2, 5.6,
5.7); losses beyond are neglected. It is summed hop by hop along the tree of areas: area i tells neighbour j
the net load of all buses on its side. A boundary bus itself counts on the side of its owner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dsse_core.measurement import Measurement, MeasurementKind, Source
from dsse_core.partition import Area, Partition


def own_net_load(area: Area, measured_injection: Mapping[int, complex] | None = None) -> complex:
    """Loads minus generation of the buses that ``area`` owns, p.u.

    ``measured_injection`` (bus -> p + jq) replaces the schedule of the buses that it names; the strategies
    pass the telemetered injections of substation and generators.
    """
    measured_injection = measured_injection or {}
    not_owned = area.parent.bus if area.parent else None
    return -sum(
        (
            measured_injection.get(bus.id, area.network.scheduled_injection(bus.id))
            for bus in area.network.buses
            if bus.id != not_owned
        ),
        complex(0.0),
    )


def load_message_for(neighbour: str, own: complex, heard: Mapping[str, complex]) -> complex:
    """What an area tells ``neighbour``: its own net load and that of all its other neighbours, p.u."""
    return own + sum((load for name, load in heard.items() if name != neighbour), complex(0.0))


def boundary_loads(area: Area, heard: Mapping[str, complex], error: complex = 0j) -> dict[int, complex]:
    """Boundary bus -> load beyond it, p.u.: what the neighbours there say, plus ``error`` (eqs. 5.4, 5.5).

    The error is added once per boundary bus. Neighbours that have not been heard are left out.
    """
    loads = {n.bus: complex(error) for n in area.neighbours if n.area in heard}
    for n in area.neighbours:
        if n.area in heard:
            loads[n.bus] += heard[n.area]
    return loads


def scheduled_load_messages(partition: Partition) -> dict[str, dict[str, complex]]:
    """Receiving area -> (neighbour -> load message, p.u.) when every message is the schedule and none is lost."""
    own = {area.name: own_net_load(area) for area in partition.areas}
    heard: dict[str, dict[str, complex]] = {area.name: {} for area in partition.areas}

    def tell(sender: str, receiver: str) -> complex:
        if sender not in heard[receiver]:
            beyond = {n.area: tell(n.area, sender) for n in partition.area(sender).neighbours if n.area != receiver}
            heard[receiver][sender] = load_message_for(receiver, own[sender], beyond)
        return heard[receiver][sender]

    for area in partition.areas:
        for n in area.neighbours:
            tell(n.area, area.name)
    return heard


def measured_injections(area: Area, measurements: Sequence[Measurement]) -> dict[int, complex]:
    """Bus -> telemetered p + jq, p.u., of the area's buses with a source whose P and Q are both measured."""
    sources = {generator.bus for generator in area.network.generators}
    read = {(m.meter.kind, m.meter.bus): m.value for m in measurements if m.meter.source is Source.TELEMETERED}
    p, q = MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION
    return {bus: complex(read[p, bus], read[q, bus]) for bus in sources if (p, bus) in read and (q, bus) in read}
