"""Reader of area files, TOML or JSON, with all checks. Agents need it; writing the files does not."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

from agents.area_files.tables import area_table
from agents.protocol.configuration import Configuration, SplitStamp, keys_of, plain_keys
from dsse_core.endpoints import find_problems_in
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.files.strict_table import load_strict
from dsse_core.files.wording import describe_unknown
from dsse_core.grid.boundary import Boundary, boundary_of, find_wrong_name
from dsse_core.grid.gauge import Gauge
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.measurement import Meter, find_meter_problems
from dsse_core.grid.network import Branch, Bus, Generator, Network
from dsse_core.grid.nodes import PHASE_ANGLE, list_phases
from dsse_core.grid.partition import Area, Neighbour, find_foreign
from dsse_core.grid.physical_ranges import find_range_problems
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import KindRule, ReadingRules

T = TypeVar("T")
SAME_ANGLE = 1e-9  # rad


def load_area_file(path: Path, strategies: Collection[str] | None = None) -> Configuration:
    """Read and check an area file; ``strategies``: names of which the file must give one, None for any name.

    Raises:
        InvalidInputError: naming the file and every unknown, missing or impossible key.
    """
    t = load_strict(path, area_table(of_columns=path.suffix == ".json"))
    problems = list(_find_problems(t))
    if strategies is not None and t.strategy not in strategies:
        problems.append(f"strategy: {describe_unknown('strategy', t.strategy, sorted(strategies))}")
    meters = _items_of(Meter, t.meter)
    try:
        network = _network_of(t)
        problems += _find_phase_problems(t, network)
        problems += find_meter_problems(network, meters)
    except InvalidInputError as error:
        problems += [f"network: {problem}" for problem in error.problems]
    if problems:
        raise InvalidInputError(t.called(path), problems)
    return Configuration(
        **{key: getattr(t, key) for key, _ in plain_keys()},
        area=_area_of(t, network),
        meters=meters,
        generation=t.load_messages.generation,
        load_error=complex(t.load_messages.p_error, t.load_messages.q_error),
        links={n.area: LinkFaults(**vars(n.faults)) for n in t.neighbour},
        penalty=t.admm.penalty,
        limits=StateLimits(**vars(t.quality)),
        readings=_rules_of(t.telemetry),
        split=SplitStamp(**vars(t.split)) if t.split else None,
    )


def _rules_of(t: Any) -> ReadingRules:
    return ReadingRules(
        ticks=t.ticks,
        leader=t.leader,
        gateways={name: meters if meters == "all" else tuple(meters) for name, meters in t.gateways.items()},
        kinds={row.kind: KindRule(**{key: v for key, v in vars(row).items() if key != "kind"}) for row in t.kind},
    )


def _area_of(t: Any, network: Network) -> Area:
    return Area(
        name=t.area,
        network=network,
        neighbours=tuple(map(_neighbour_of, t.neighbour)),
        slack_bus=t.local_slack.bus,
        slack_vm=t.local_slack.vm,
        reference=(t.reference.bus, t.reference.va) if t.reference else None,
        towards_hub=t.exchange.towards_hub,
        n_areas=t.exchange.areas,
        entry_voltage=(t.exchange.entry_vm, t.exchange.entry_va),
        no_load=tuple((int(str(place).partition(".")[0]), vm, va) for place, vm, va in t.exchange.no_load),
    )


def _network_of(t: Any) -> Network:
    """The area's network.

    Raises:
        InvalidInputError: its parts contradict each other, or numbers that no grid has, all of them.
    """
    network = Network(
        name=t.area,
        base_mva=t.network.base_mva,
        buses=_items_of(Bus, t.network.bus),
        branches=_items_of(Branch, t.network.branch),
        generators=_items_of(Generator, t.network.generator),
        loads=_items_of(Load, t.network.load),
        shunts=_items_of(Shunt, t.network.shunt),
        gauge_of_whole=Gauge(**vars(t.network.gauge)) if t.network.gauge else None,
    )
    if problems := list(find_range_problems(network)):
        raise InvalidInputError(f"network {network.name!r}", problems)
    return network


def _items_of(cls: type[T], table: Any) -> tuple[T, ...]:
    """The dataclasses of a list of tables, or of a table of lists."""
    if isinstance(table, list):
        return tuple(cls(**vars(row)) for row in table)
    columns = [getattr(table, key) for key, _ in keys_of(cls)]
    defaults = [default for _, default in keys_of(cls)]
    given = [repeat(default) if c is None else c for c, default in zip(columns, defaults, strict=True)]
    return tuple(map(cls, *given))  # as long as the shortest, and without a default they must be given


def _find_problems(t: Any) -> Iterator[str]:
    """Problems of keys that contradict the network or each other, of telemetry, and of endpoints, missing ones too."""
    buses = set(_values_of(t.network.bus, "id"))
    names = [n.area for n in t.neighbour]
    for i, n in enumerate(t.neighbour):
        if n.bus not in buses:
            yield f"neighbour[{i + 1}].bus: bus {n.bus} is not in the network"
        if wrong := n.variables and _find_wrong_variables(n, buses):
            yield f"neighbour[{i + 1}].variables: {wrong}"
        if n.area == t.area:
            yield f"neighbour[{i + 1}].area: {n.area} is the area itself"
        if n.area in names[:i]:
            yield f"neighbour[{i + 1}].area: {n.area} is given twice; keep one"
    for key, bus in (("local_slack", t.local_slack.bus), ("reference", t.reference and t.reference.bus)):
        if bus is not None and bus not in buses:
            yield f"{key}.bus: bus {bus} is not in the network"
    controls = zip(_values_of(t.network.generator, "control"), _values_of(t.network.generator, "bus"), strict=False)
    substations = [bus for control, bus in controls if control == "slack"]
    foreign = find_foreign(t.area, _boundaries_of(t).values())  # where another area may have the substation
    if t.reference and t.reference.bus in buses and t.reference.bus not in (*substations, *foreign):
        yield (
            f"reference.bus: bus {t.reference.bus} is not the substation, from which all angles count; "
            "leave [reference] out"
        )
    if t.exchange.towards_hub not in (None, *names):
        yield f"exchange.towards_hub: {t.exchange.towards_hub} is no neighbour"
    if t.exchange.areas <= len(names):
        yield f"exchange.areas: is {t.exchange.areas}; this area and its neighbours alone are {len(names) + 1}"
    if sum(n.is_parent for n in t.neighbour) != (0 if substations else 1):
        yield "neighbour: exactly one must be the parent, or none where the network holds the substation"
    yield from _find_telemetry_problems(t)
    yield from find_problems_in("endpoints", t.endpoints, listens=True)  # of a simulated run they have port 0
    yield from find_problems_in("listen", t.listen, listens=True)
    if not (t.endpoints or t.listen):
        yield "endpoints: is empty; name a router, or give listen, where neighbours link with this area"


def _find_wrong_variables(neighbour: Any, buses: Collection[int]) -> str:
    """Problem of the variables that the edge to ``neighbour`` carries; empty if there is none."""
    if wrong := find_wrong_name(neighbour.variables):
        return f"has {wrong}; write them as the split has"
    there = boundary_of(neighbour.variables).buses
    if missing := sorted({*there} - {*buses}):
        return f"bus {missing[0]} is not in the network"
    return "" if neighbour.bus in there else f"lacks bus {neighbour.bus}, where these areas meet"


def _boundaries_of(t: Any) -> dict[int, Boundary]:
    """Place of each neighbour -> what its edge carries, where the names of the variables are right."""
    is_right = (not (n.variables and find_wrong_name(n.variables)) for n in t.neighbour)
    pairs = zip(t.neighbour, is_right, strict=True)
    return {i: _neighbour_of(n).boundary_of(t.area) for i, (n, is_named) in enumerate(pairs) if is_named}


def _neighbour_of(n: Any) -> Neighbour:
    return Neighbour(n.area, n.bus, n.is_parent, n.variables)


def _find_phase_problems(t: Any, network: Network) -> Iterator[str]:
    """Problems of boundaries and of the unloaded grid that lack phases of the network, or have others than it."""
    yield from _find_boundary_problems(t, network)
    no_load, nodes = [str(place) for place, _, _ in t.exchange.no_load], network.node_names
    if network.table.nodes.is_balanced:
        yield from (f"exchange.no_load: bus {place} is not in the network" for place in sorted({*no_load} - {*nodes}))
        return
    if no_load != nodes:
        wrong = next((place for place in no_load if place not in nodes), None)
        found = f"{wrong} is no node of the network" if wrong else f"{len(no_load)} voltages in another order"
        yield f"exchange.no_load: {found}; give {', '.join(nodes)}, in this order"
    elif t.reference and t.reference.bus in network.row:
        for node in network.nodes_at(t.reference.bus).tolist():
            expected = t.reference.va + PHASE_ANGLE[network.table.nodes.phase[node]]
            if abs(math.remainder(t.exchange.no_load[node][2] - expected, 2 * math.pi)) > SAME_ANGLE:
                yield f"exchange.no_load: {nodes[node]} is not at {expected:.6g} rad, where reference.va puts it"


def _find_boundary_problems(t: Any, network: Network) -> Iterator[str]:
    """Phases of a boundary that its buses do not have. A bus of another area has the phases of all its boundaries."""
    boundaries = _boundaries_of(t)
    foreign = find_foreign(t.area, boundaries.values())
    beyond = Counter(bus for boundary in boundaries.values() for bus in boundary.buses)
    for i, boundary in boundaries.items():
        for bus, found in boundary.phases.items():
            if bus not in network.row:
                continue
            there = network.bus(bus).phases
            may_have_fewer = (bus not in foreign or beyond[bus] > 1) and bool(found and there)
            if found != there and not (may_have_fewer and {*list_phases(found)} < {*list_phases(there)}):
                yield (
                    f"neighbour[{i + 1}].variables: has phases {found!r} at bus {bus}, which has {there!r} here; write "
                    "them as the split has"
                )


def _find_telemetry_problems(t: Any) -> Iterator[str]:
    kinds = [row.kind for row in t.telemetry.kind]
    for i, row in enumerate(t.telemetry.kind):
        if row.kind in kinds[:i]:
            yield f"telemetry.kind[{i + 1}].kind: {row.kind} is given twice; keep one"
        if None not in (row.lowest, row.highest) and row.lowest >= row.highest:
            yield f"telemetry.kind[{i + 1}].lowest: is {row.lowest:g}; it must be below highest, {row.highest:g}"
        if row.aging_s is not None and row.period_s is None:
            yield f"telemetry.kind[{i + 1}].aging_s: readings without period_s do not age; add period_s, or remove it"
    if t.telemetry.ticks == "clock" and t.scan_s is None:
        yield "telemetry.ticks: 'clock' needs the time between two ticks; add scan_s"


def _values_of(table: Any, key: str) -> list[Any]:
    """The values of ``key`` in a list of tables, or in a table of lists."""
    return [getattr(row, key) for row in table] if isinstance(table, list) else getattr(table, key)
