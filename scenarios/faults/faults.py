"""The faults of a scenario: of each directed link and of the telemetry, and the events of processes in time."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from dsse_core.errors import InvalidInputError
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.partition import Partition
from dsse_core.limits import LONGEST_S
from dsse_core.link_faults import LinkFaults
from dsse_core.printable import listed
from scenarios.files.fault_tables import (
    MOMENTARY,
    BurstTable,
    EventTable,
    FaultsTable,
    LieTable,
    LinkTable,
    LoadFaultTable,
)

Link = tuple[str, str]
"""(sending area, receiving area)."""
LinkChanges = Mapping[str, float]
"""``loss``, ``delay_s``, ``jitter_s`` and ``duplicate`` that every link is to have instead of the scenario's."""
ROUTERS = ("router", "router2")
PROCESSES = ("plant", *ROUTERS)
ALL_AREAS = "all"  # in place of the name of an area; no area has this name
EventKind = Literal["kill", "restart", "pause", "cut", "silent", "switch"]


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """At ``at_s`` after the start of the run (all areas on the bus) ``kind`` happens to ``names``, for ``for_s``.

    ``names``: an area, ``plant``, ``router`` or ``router2``; two areas for a cut; a switch. ``for_s``: 0 for what
    happens in a moment; of a switch the delay of the status that is read. ``to``: status of the switch from then on;
    ``status``: the one that is read instead, empty without one.
    """

    at_s: float
    kind: EventKind
    names: tuple[str, ...]
    for_s: float = 0.0
    to: str = ""
    status: str = ""

    @property
    def over_s(self) -> float:
        return self.at_s + self.for_s


@dataclass(frozen=True, slots=True)
class TelemetryFaults:
    """Faults of the telemetry, drawn for each scan and area by itself.

    ``missing``: share of the area's readings that the scan lacks. ``late``: probability that the scan reaches the area
    late, by a uniform part of ``late_s``.
    """

    missing: float = 0.0
    late: float = 0.0
    late_s: float = 1.0


@dataclass(frozen=True, slots=True, repr=False)
class Faults:
    """``links`` has every directed link between neighbours; ``events`` are in the order of their time.

    ``clock_error_s``: area -> by how much its clock is ahead.
    """

    links: dict[Link, LinkFaults]
    telemetry: TelemetryFaults = TelemetryFaults()
    clock_error_s: Mapping[str, float] = field(default_factory=dict)
    events: tuple[FaultEvent, ...] = ()

    def __repr__(self) -> str:
        return f"<Faults: {len(self.links)} links, {len(self.events)} events, {self.telemetry}>"

    @property
    def over_s(self) -> float:
        """End of the last event, s since the start of the run; there is no verdict before it."""
        return max((event.over_s for event in self.events), default=0.0)


def find_links(partition: Partition) -> tuple[Link, ...]:
    """Every directed link between neighbours."""
    return tuple((n.area, area.name) for area in partition.areas for n in area.neighbours)


def build_faults(table: FaultsTable, partition: Partition) -> Faults:
    """The faults of a table that ``find_name_problems`` and ``find_link_problems`` find no fault with."""
    own = {(link.from_, link.to): link for link in table.link}
    returned = {(link.to, link.from_): link.lie for link in table.link if link.lie.both_ways}
    cuts: dict[frozenset[str], list[tuple[float, float]]] = {}
    for event in table.events:
        if event.cut is not None:
            cuts.setdefault(frozenset(event.cut), []).append((event.at_s, event.at_s + (event.for_s or 0.0)))
    links = {
        link: _build_link(
            table, own.get(link), returned.get(link), sorted(cuts.get(frozenset(link), [])), _find_mva(partition, link)
        )
        for link in find_links(partition)
    }
    events = [
        FaultEvent(e.at_s, e.kind, e.names, e.over_s - e.at_s, e.to or "", e.status or "")  # type: ignore[arg-type]
        for e in table.events
    ]
    return Faults(
        links,
        TelemetryFaults(**table.telemetry.model_dump()),
        dict(table.clock_error_s),
        tuple(sorted(events, key=lambda event: event.at_s)),
    )


def _find_mva(partition: Partition, link: Link) -> float:
    """The size of 1 p.u. of power in every phase of the boundary of a link, at the bus with most of them, MVA."""
    phases = partition.area(link[0]).boundaries[link[1]].phases.values()
    return partition.network.node_mva * max(len(list_phases(text)) for text in phases)


def _build_link(
    table: FaultsTable,
    own: LinkTable | None,
    returned: LieTable | None,
    cuts: Sequence[tuple[float, float]],
    mva: float,
) -> LinkFaults:
    """``own``: the keys that the link has for itself instead of those of every link. ``returned``: the lie of the
    other direction, which this one takes back. ``mva``: the power that is 1 p.u. in each phase.
    """

    def value_of(key: str) -> Any:
        value = getattr(own, key, None)
        return getattr(table, key) if value is None else value

    burst = value_of("burst") or BurstTable(enter=0.0, leave=1.0)
    load, lie = (own.load, own.lie) if own else (LoadFaultTable(), LieTable())
    if returned is not None:
        lie = _invert(returned)
    return LinkFaults(
        loss=value_of("loss"),
        burst_enter=burst.enter,
        burst_leave=burst.leave,
        burst_loss=burst.loss,
        delay_s=value_of("delay_ms") / 1000,
        jitter_s=value_of("jitter_ms") / 1000,
        duplicate=value_of("duplicate"),
        corrupt=value_of("corrupt"),
        load_p=load.p_mw / mva,
        load_q=load.q_mvar / mva,
        load_scale=load.scale,
        load_frozen=load.frozen,
        lie_p=lie.p_mw / mva,
        lie_q=lie.q_mvar / mva,
        lie_vm=lie.vm_pu,
        lie_va=math.radians(lie.va_deg),
        lie_scale=lie.scale,
        lie_objective=lie.objective,
        lie_areas=lie.areas or 0,
        lie_worst=lie.worst or "",
        lie_verdict=lie.verdict or "",
        until_s=table.until_s,
        cuts=tuple(cuts),
    )


def _find_lie_problems(links: Sequence[LinkTable]) -> Iterable[str]:
    """Lies that the other direction takes back while it has a lie of its own."""
    liars = {(link.from_, link.to): i for i, link in enumerate(links, 1) if link.lie != LieTable()}
    for i, link in enumerate(links, 1):
        if link.lie.both_ways and (back := liars.get((link.to, link.from_))):
            yield (
                f"faults.link[{i}].lie.both_ways: faults.link[{back}] gives the other direction a lie of its own; "
                "remove one of the two"
            )


def _invert(lie: LieTable) -> LieTable:
    """The lie that takes ``lie`` back: it turns a value computed from ``lie`` into one that agrees with the truth."""
    offsets = {key: -getattr(lie, key) / lie.scale for key in ("p_mw", "q_mvar", "vm_pu", "va_deg")}
    return LieTable(**offsets, scale=1 / lie.scale)


def change_links(faults: Faults, changes: LinkChanges) -> Faults:
    """``faults`` with some of every link's numbers replaced.

    Raises:
        InvalidInputError: every number that is impossible.
    """
    problems = []
    for key, value in changes.items():
        most = 1.0 if key in ("loss", "duplicate") else LONGEST_S
        if not 0 <= value <= most:
            problems.append(f"{key} is {value:g}; it must be 0 to {most:g}")
    if problems:
        raise InvalidInputError("faults of all links", problems)
    links = {link: replace(old, **changes) for link, old in faults.links.items()}  # type: ignore[arg-type]
    return replace(faults, links=links)


def find_name_problems(table: FaultsTable, areas: Collection[str] | None, routers: int) -> Iterable[str]:
    """Names that are no area or process; nothing where ``areas`` is None. ``routers``: number of routers."""
    if areas is None:
        return
    known = listed(areas)
    for name in table.load_error:
        if name not in (*areas, ALL_AREAS):
            yield f"faults.load_error.{name}: there is no area {name!r}; areas: {known}; {ALL_AREAS!r} means each"
    for name in table.clock_error_s:
        if name not in areas:
            yield f"faults.clock_error_s.{name}: there is no area {name!r}; areas: {known}"
    for i, link in enumerate(table.link, 1):
        for key, name in (("from", link.from_), ("to", link.to)):
            if name not in areas:
                yield f"faults.link[{i}].{key}: there is no area {name!r}; areas: {known}"
    for i, event in enumerate(table.events, 1):
        if event.kind == "switch":
            continue
        processes = () if event.kind == "cut" else PROCESSES[: 1 + routers]
        for name in event.names:
            if name not in areas and name not in processes:
                allowed = listed([*areas, *processes])
                why = ' with transport.kind = "neighbours"' if not routers and name in ROUTERS else ""
                why = " with transport.routers = 1" if routers == 1 and name in ROUTERS else why
                yield f"faults.events[{i}].{event.kind}: there is no {name!r}{why}; allowed: {allowed}"


def find_link_problems(table: FaultsTable, partition: Partition) -> Iterable[str]:
    """Links and cuts between areas that are no neighbours, links that are given twice, lies of both directions, and
    branches that are no switches.
    """
    links = find_links(partition)
    areas = {area.name for area in partition.areas}
    pairs = listed([f"{a} to {b}" for a, b in links]) or "none"
    given: set[tuple[str, str]] = set()
    for i, link in enumerate(((link.from_, link.to) for link in table.link), 1):
        if set(link) <= areas and link not in links:
            yield f"faults.link[{i}]: {link[0]} and {link[1]} are not neighbours; links: {pairs}"
        if link in given:
            yield f"faults.link[{i}]: the link from {link[0]} to {link[1]} is given twice; keep one"
        given.add(link)
    yield from _find_lie_problems(table.link)
    for i, event in enumerate(table.events, 1):
        if event.kind == "cut" and set(event.names) <= areas and event.names not in links:
            yield f"faults.events[{i}].cut: {' and '.join(event.names)} are not neighbours; links: {pairs}"
        if event.switch is not None and event.switch not in partition.network.switches:
            known = listed(sorted(partition.network.switches)) or "none"
            yield (
                f"faults.events[{i}].switch: there is no switch {event.switch!r}; switches: {known}; a branch becomes "
                "one by `switch = true` in the network file"
            )


def find_time_problems(events: Sequence[EventTable], timeout_s: float) -> Iterable[str]:
    """Events that the time limit of the run would cut off."""
    for i, event in enumerate(events, 1):
        if event.over_s >= timeout_s:
            yield (
                f"faults.events[{i}]: is over {event.over_s:g} s after the start, but run.timeout_s is "
                f"{timeout_s:g}; raise timeout_s or let it happen earlier"
            )


def find_order_problems(events: Sequence[EventTable]) -> Iterable[str]:
    """Events that meet a process that is dead, frozen or silent by then, and cuts of links that are cut already."""
    killed: dict[str, int] = {}
    lasting: dict[frozenset[str], int] = {}
    for i, event in sorted(enumerate(events, 1), key=lambda item: item[1].at_s):
        whom = frozenset(event.names)
        j = lasting.get(whom)
        if j is not None and event.at_s < events[j - 1].over_s:
            yield (
                f"faults.events[{i}].{event.kind}: falls into faults.events[{j}], {_describe(events[j - 1])} until "
                f"{events[j - 1].over_s:g} s; let it happen earlier or later"
            )
        meets_living = event.kind in ("kill", "pause", "silent")
        dead = [name for name in event.names if name in killed] if meets_living else []
        for name in dead:
            yield (
                f"faults.events[{i}].{event.kind}: {name} is dead by then, killed by faults.events[{killed[name]}]; "
                "restart it before, or remove one of the two"
            )
        if event.kind in MOMENTARY:
            killed.pop(event.names[0], None)
        else:
            lasting[whom] = i
        if event.kind == "kill":
            killed[event.names[0]] = i


def _describe(event: EventTable) -> str:
    return f"{event.kind} {' and '.join(event.names)}"
