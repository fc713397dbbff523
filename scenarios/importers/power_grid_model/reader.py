"""power-grid-model input data as a network; its components become branches, loads and sources.

Everything comes in SI units; the base here is 1 MVA, as inside power-grid-model. The electric models are those of its
documentation, "Components": pi models whose series impedance stands at the to side, sources behind an impedance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.physical_ranges import find_base_problems
from dsse_core.grid.primitives import build_line, find_size
from scenarios.files.network_columns import default_branch_id
from scenarios.files.zero_impedances import reject_zero_impedances
from scenarios.importers.imported import (
    Imported,
    Remark,
    add_shunts,
    find_places,
    find_source_problems,
    fuse,
    fused_remarks,
    leave_out_islands,
    list_shunt_legs,
    loop_shunt,
    open_end_shunt,
)
from scenarios.importers.power_grid_model.branches import BUILDERS, find_rating
from scenarios.importers.power_grid_model.data import (
    APPLIANCES,
    IGNORED,
    SENSORS,
    Data,
    has_sensors,
    ids,
    is_asymmetric,
    load_data,
    rows,
    working_sources,
)
from scenarios.importers.power_grid_model.phases import build_three_phases, list_legs
from scenarios.importers.power_grid_model.sensors import Conversion, find_metered_branches, read_sensors
from scenarios.importers.sequences import ABC, spread

BASE_VA = 1e6
IN_PARALLEL = "links join its two ends, it carries nothing; its own consumption stays as a shunt"
STIFF = 1e-9  # p.u.; a source's impedance below it is none
CONSTANT_POWER, CONSTANT_IMPEDANCE = 0, 1


def read_power_grid_model(path: Path, tree: Any, frequency_hz: float) -> Imported:
    """Read power-grid-model input data, sensors included; ``frequency_hz`` turns capacitances into siemens.

    ``tree``: JSON tree of ``path``. power-grid-model, which has a parser of its own, gets it written again.

    Raises:
        InvalidInputError: power-grid-model is missing, or finds the data invalid; every component that the network
            model cannot hold; every sensor that no meter here can be.
    """
    data, remarks_of_data = load_data(str(path), tree)
    measured = has_sensors(data)
    conversion, remarks = _convert_checked(path, data, frequency_hz, measured=measured)
    readings, sensor_remarks = read_sensors(str(path), conversion)
    if measured and not readings:
        conversion, remarks = _convert_checked(path, data, frequency_hz, measured=False)
    if "line" in data:
        remarks.append(Remark("note", f"line capacitances at {frequency_hz:g} Hz, which the file does not hold"))
    converted = {name: len(data[name]) for name in sorted(data) if name not in SENSORS}
    substation = conversion.bus_of[int(working_sources(data)[0]["node"])]
    return Imported(
        network=conversion.network,
        data_source=f"power-grid-model input {path.name}",
        converted=converted,
        remarks=(*remarks_of_data, *remarks, *sensor_remarks),
        readings=readings,
        substation=substation,
        places=find_places(conversion.network, substation) if is_asymmetric(data) else None,
        zero_injection=_find_zero_injections(conversion) if readings else "virtual",
    )


def _convert_checked(path: Path, data: Data, frequency_hz: float, *, measured: bool) -> tuple[Conversion, list[Remark]]:
    try:
        conversion, remarks = _convert(path.stem, data, frequency_hz, measured=measured)
        names = {branch: _kind_of(data, component) for component, branch in conversion.branch_of.items()}
        cure = "put a link in its place, or where it is a source, give it an sk above 1e15 VA"
        reject_zero_impedances(conversion.network, names, cure)
    except InvalidInputError as error:
        raise InvalidInputError(str(path), error.problems) from None
    return conversion, remarks


def _kind_of(data: Data, component: int) -> str:
    """Type and id of a component, as ``line 7``."""
    kinds = [name for name in (*BUILDERS, "source") if name in data]
    return next(f"{name} {component}" for name in kinds if component in data[name]["id"])


def _convert(name: str, data: Data, frequency_hz: float, *, measured: bool) -> tuple[Conversion, list[Remark]]:
    kv = {int(node["id"]): float(node["u_rated"]) / 1000 for node in rows(data, "node")}
    if problems := [*find_base_problems(BASE_VA / 1e6, kv), *_find_problems(data, measured=measured)]:
        raise InvalidInputError(name, problems)
    closed = [link for link in rows(data, "link") if link["from_status"] and link["to_status"]]
    bus_of = fuse(kv, ((int(link["from_node"]), int(link["to_node"])) for link in closed))
    metered = find_metered_branches(data) if measured else frozenset()
    branches, branch_of, shunts, open_ends = _build_branches(data, kv, bus_of, frequency_hz, metered)
    legs = [*list_legs(data, bus_of), *_find_shunt_legs(data, kv, bus_of)] if is_asymmetric(data) else []
    for node, shunt in _find_shunts(data, kv, measured=measured):
        shunts.setdefault(bus_of[node], []).append(shunt)
    buses, generators = _build_buses(data, kv, bus_of, measured=measured)
    buses += open_ends.values()
    source_bus, source_branch, slack = _build_source(data, kv, bus_of, measured=measured)
    if source_bus and source_branch:
        buses.append(source_bus)
        branches.append(source_branch)
        branch_of[int(working_sources(data)[0]["id"])] = source_branch.id
    network = Network(
        name=name,
        base_mva=BASE_VA / 1e6,
        buses=tuple(add_shunts(bus, shunts[bus.id]) if bus.id in shunts else bus for bus in buses),
        branches=tuple(branches),
        generators=(slack, *generators),
        loads=tuple(legs),
    )
    network, island_remarks = leave_out_islands(network)
    remarks = [
        *fused_remarks(bus_of, "links"),
        *island_remarks,
        *_find_open_ends(data, open_ends),
        *_find_loops(data, bus_of),
    ]
    remarks += _find_unused(data)
    if source_branch:
        text = f"bus {source_branch.from_bus} is new: the inside of the source at bus {source_branch.to_bus}"
        remarks.append(Remark("note", text))
    known = {bus.id for bus in network.buses}
    bus_of = {node: bus for node, bus in bus_of.items() if bus in known}
    ids = {branch.id for branch in network.branches}
    branch_of = {component: branch for component, branch in branch_of.items() if branch in ids}
    return Conversion(data, measured, network, bus_of, branch_of, frozenset(shunts)), remarks


def _find_problems(data: Data, *, measured: bool) -> Iterator[str]:
    closed = [b for name in (*BUILDERS, "link") for b in rows(data, name) if b["from_status"] and b["to_status"]]
    nodes = (int(node["id"]) for node in rows(data, "node"))
    island_of = fuse(nodes, ((int(b["from_node"]), int(b["to_node"])) for b in closed))
    sources = [(f"source {source['id']}", int(source["node"])) for source in working_sources(data)]
    yield from find_source_problems(sources, island_of, "take the sources of the other islands out of service")
    if is_asymmetric(data):
        yield from _find_problems_of_phases(data, island_of, measured=measured)
        return
    for name in APPLIANCES:
        held = (CONSTANT_POWER, CONSTANT_IMPEDANCE)
        if bad := [a for a in rows(data, name) if not measured and a["status"] and a["type"] not in held]:
            yield f"{name} {ids(bad)}: constant current, which the network model cannot hold; make it constant power"


def _find_problems_of_phases(data: Data, bus_of: Mapping[int, int], *, measured: bool) -> Iterator[str]:
    branches = list(_all_branches(data))
    apart = [shunt for shunt in rows(data, "shunt") if shunt["status"] and _has_zero_sequence(data, shunt)]
    if measured and apart:
        yield f"shunt {ids(apart)}: g0, b0 are not g1, b1, and no sensor reads the power of a shunt; make them equal"
    if half := [b for b in branches if bool(b["from_status"]) != bool(b["to_status"])]:
        yield f"branch {ids(half)}: open at one end, which a branch with phases cannot be; open both ends"
    closed = [link for link in rows(data, "link") if link["from_status"] and link["to_status"]]
    joined = fuse(bus_of, ((int(link["from_node"]), int(link["to_node"])) for link in closed))
    if loops := [b for b in branches if b["from_status"] and joined[int(b["from_node"])] == joined[int(b["to_node"])]]:
        yield f"branch {ids(loops)}: links join its two ends; take it out of service"


def _find_open_ends(data: Data, open_ends: Mapping[int, Bus]) -> Iterator[Remark]:
    """Remarks on branches with open ends. ``open_ends``: branch that stays -> the bus at its open end."""
    branches = list(_all_branches(data))
    half = [b for b in branches if bool(b["from_status"]) != bool(b["to_status"])]
    if folded := [b for b in half if int(b["id"]) not in open_ends]:
        yield Remark("changed", f"branch {ids(folded)}: open at one end, written as the shunt that it is")
    for component, bus in open_ends.items():
        text = f"open at one end and metered, kept as a branch to bus {bus.id}, where nothing is injected"
        yield Remark("changed", f"branch {component}: {text}")
    if off := [b for b in branches if not b["from_status"] and not b["to_status"]]:
        yield Remark("left out", f"branch {ids(off)}: open at both ends")


def _find_loops(data: Data, bus_of: dict[int, int]) -> Iterator[Remark]:
    closed = [b for b in _all_branches(data) if b["from_status"] and b["to_status"]]
    if loops := [b for b in closed if bus_of[int(b["from_node"])] == bus_of[int(b["to_node"])]]:
        yield Remark("left out", f"branch {ids(loops)}: {IN_PARALLEL}")


def _find_unused(data: Data) -> Iterator[Remark]:
    for name, reason in IGNORED.items():
        if name in data:
            yield Remark("left out", f"{name} {ids(data[name])}: {reason}")
    for name in (*APPLIANCES, "source", "shunt"):
        if idle := [a for a in rows(data, name) if not a["status"]]:
            yield Remark("left out", f"{name} {ids(idle)}: out of service")
    for name in APPLIANCES:
        if unknown := [a for a in rows(data, name) if a["status"] and np.isnan(a["p_specified"]).any()]:
            yield Remark("changed", f"{name} {ids(unknown)}: no power is specified, 0 is written; its sensor counts")


def _all_branches(data: Data) -> Iterator[Any]:
    for name in BUILDERS:
        yield from rows(data, name)


def _build_branches(
    data: Data, kv: dict[int, float], bus_of: dict[int, int], frequency_hz: float, metered: frozenset[int]
) -> tuple[list[Branch], dict[int, str], dict[int, list[complex]], dict[int, Bus]]:
    """The branches between buses, their ids by component, and the shunts that the others are (by bus).

    Of branches with an open end the ``metered`` ones stay, each with a bus of its own at that end (by component).
    """
    taken: set[str | None] = set()
    branches, branch_of = [], {}
    open_ends: dict[int, Bus] = {}
    shunts: dict[int, list[complex]] = {}
    for name in BUILDERS:
        for component in rows(data, name):
            if not component["from_status"] and not component["to_status"]:
                continue
            nodes = int(component["from_node"]), int(component["to_node"])
            ends = bus_of[nodes[0]], bus_of[nodes[1]]
            is_open = bool(component["from_status"]) != bool(component["to_status"])
            if is_open and int(component["id"]) in metered:
                new, open_node = max(kv) + 2 + len(open_ends), nodes[1] if component["from_status"] else nodes[0]
                open_ends[int(component["id"])] = Bus(new, kv[open_node], name=f"open end of {component['id']}")
                ends, is_open = (ends[0], new) if component["from_status"] else (new, ends[1]), False
            branch_id = default_branch_id(*ends, taken)
            kv_of_ends = kv[nodes[0]], kv[nodes[1]]
            pi = BUILDERS[name](component, *kv_of_ends, frequency_hz)
            rated = find_rating(name, component, *kv_of_ends)
            branch = Branch(branch_id, ends[0], ends[1], **pi._asdict(), **rated)
            if is_asymmetric(data):
                branch = _with_phases(branch, build_three_phases(name, component, pi, kv_of_ends, frequency_hz))
            if not is_open and ends[0] == ends[1]:
                shunts.setdefault(ends[0], []).append(loop_shunt(branch))
            elif not is_open:
                taken.add(branch_id)
                branches.append(branch)
                branch_of[int(component["id"])] = branch_id
            else:
                connected = nodes[0] if component["from_status"] else nodes[1]
                alone = replace(branch, from_bus=nodes[0], to_bus=nodes[1])
                shunts.setdefault(bus_of[connected], []).append(open_end_shunt(alone, connected))
    return branches, branch_of, shunts, open_ends


def _with_phases(branch: Branch, primitive: Primitive) -> Branch:
    size = find_size(primitive)
    return Branch(
        branch.id, branch.from_bus, branch.to_bus, size.real, size.imag, i_max=branch.i_max, s_max=branch.s_max,
        primitive=primitive,
    )  # fmt: skip


def _find_shunts(data: Data, kv: dict[int, float], *, measured: bool) -> Iterator[tuple[int, complex]]:
    """(node, admittance in p.u.) of shunts in service and, if not measured, of appliances of constant impedance."""
    for shunt in rows(data, "shunt"):
        if shunt["status"] and not _has_zero_sequence(data, shunt):
            node = int(shunt["node"])
            yield node, complex(shunt["g1"], shunt["b1"]) * kv[node] ** 2
    for name, sign in () if measured or is_asymmetric(data) else APPLIANCES.items():
        for a in rows(data, name):
            if a["status"] and a["type"] == CONSTANT_IMPEDANCE:
                yield int(a["node"]), -sign * complex(_power(a, "p"), -_power(a, "q"))


def _has_zero_sequence(data: Data, shunt: Any) -> bool:
    """True for a shunt with phases that is not alike in all of them."""
    return is_asymmetric(data) and (shunt["g0"], shunt["b0"]) != (shunt["g1"], shunt["b1"])


def _find_shunt_legs(data: Data, kv: dict[int, float], bus_of: dict[int, int]) -> Iterator[Load]:
    for shunt in rows(data, "shunt"):
        if shunt["status"] and _has_zero_sequence(data, shunt):
            y1, y0 = (complex(shunt[f"g{k}"], shunt[f"b{k}"]) * kv[int(shunt["node"])] ** 2 for k in (1, 0))
            yield from list_shunt_legs(bus_of[int(shunt["node"])], [*ABC], spread(y1, y0))


def _power(appliance: Any, part: str) -> float:
    value = float(appliance[f"{part}_specified"])
    return 0.0 if math.isnan(value) else value / BASE_VA


def _build_buses(
    data: Data, kv: dict[int, float], bus_of: dict[int, int], *, measured: bool
) -> tuple[list[Bus], list[Generator]]:
    ids = sorted(set(bus_of.values()))
    if is_asymmetric(data):
        return [Bus(i, kv[i], phases=ABC) for i in ids], []
    loads: dict[int, complex] = {}
    generators = []
    for name in APPLIANCES:
        for a in rows(data, name):
            if not a["status"] or not (measured or a["type"] == CONSTANT_POWER):
                continue
            bus, p, q = bus_of[int(a["node"])], _power(a, "p"), _power(a, "q")
            if name == "sym_load":
                loads[bus] = loads.get(bus, 0j) + complex(p, q)
            else:
                generators.append(Generator(bus, Control.POWER, p, q))
    return [Bus(i, kv[i], p_load=(s := loads.get(i, 0j)).real, q_load=s.imag) for i in ids], generators


def _build_source(
    data: Data, kv: dict[int, float], bus_of: dict[int, int], *, measured: bool
) -> tuple[Bus | None, Branch | None, Generator]:
    """The slack behind the source's impedance, ``|z| = u^2 / sk`` with ``r / x = rx_ratio``; at its node if stiff.

    With sensors of phases at its node, too: power-grid-model's estimate fixes the angles of all phases there.
    """
    source = working_sources(data)[0]
    node = bus_of[int(source["node"])]
    sk = float(source["sk"]) if not math.isnan(source["sk"]) else 1e10
    ratio = float(source["rx_ratio"]) if not math.isnan(source["rx_ratio"]) else 0.1
    z = BASE_VA / sk
    va = 0.0 if math.isnan(source["u_ref_angle"]) else float(source["u_ref_angle"])
    vm = 1.0 if math.isnan(source["u_ref"]) else float(source["u_ref"])
    if z < STIFF or (measured and is_asymmetric(data)):
        return None, None, Generator(node, Control.SLACK, vm=vm, va=va)
    inside = max(kv) + 1
    x = z / math.hypot(1.0, ratio)
    branch = Branch(default_branch_id(inside, node, ()), inside, node, r=x * ratio, x=x)
    bus = Bus(inside, kv[node], name=f"inside source {source['id']}", phases=ABC if is_asymmetric(data) else "")
    if bus.phases:
        z01 = 1.0 if math.isnan(source["z01_ratio"]) else float(source["z01_ratio"])
        z1 = complex(branch.r, branch.x)
        branch = _with_phases(branch, build_line(ABC, spread(z1, z01 * z1)))
    return bus, branch, Generator(inside, Control.SLACK, vm=vm, va=va)


def _find_zero_injections(conversion: Conversion) -> tuple[int, ...]:
    """The buses without appliances and sources: they inject exactly nothing, for power-grid-model, too."""
    data, bus_of = conversion.data, conversion.bus_of
    used = {bus_of.get(int(a["node"])) for name in APPLIANCES for a in rows(data, name) if a["status"]}
    used |= {generator.bus for generator in conversion.network.generators}
    return tuple(bus.id for bus in conversion.network.buses if bus.id not in used)
