"""power-grid-model input data: its own reader and validator; its components become branches, loads and sources.

Everything comes in SI units; the base here is 1 MVA, as inside power-grid-model. The electric models are those of its
documentation, "Components": pi models whose series impedance stands at the to side, sources behind an impedance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.network import Branch, Bus, Control, Generator, Network
from scenarios.importers.imported import (
    Imported,
    Remark,
    add_shunts,
    fuse,
    fused_remarks,
    leave_out_islands,
    load_extra,
    open_end_shunt,
)
from scenarios.importers.power_grid_model_branches import BUILDERS
from scenarios.network_file import default_branch_id
from scenarios.wording import listed
from scenarios.zero_impedances import refuse_zero_impedances

BASE_VA = 1e6
STIFF = 1e-9  # p.u.; a source's impedance below it is none
APPLIANCES = {"sym_load": -1, "sym_gen": 1}
"""Component -> sign of its power as an injection."""
SENSORS = ("sym_voltage_sensor", "sym_power_sensor", "sym_current_sensor")
IGNORED = {"fault": "for short circuits only", "transformer_tap_regulator": "taps stay where they are"}
SUPPORTED = {*BUILDERS, *APPLIANCES, *SENSORS, *IGNORED, "node", "link", "source", "shunt"}
CONSTANT_POWER, CONSTANT_IMPEDANCE = 0, 1

Data = dict[str, Any]


@dataclass(frozen=True)
class Conversion:
    """The network made of ``data``, and how its components are called here.

    ``measured``: there are sensors, so that a load draws what they say, at whatever voltage; else it has its own law.
    ``bus_of``: node -> bus; ``branch_of``: branch component or source -> branch id, the ``to`` bus of a source's branch
    being its node; ``shunted``: buses with shunts, which loads of constant impedance are, too, unless ``measured``.
    """

    data: Data
    measured: bool
    network: Network
    bus_of: dict[int, int]
    branch_of: dict[int, str]
    shunted: frozenset[int]


def read_power_grid_model(path: Path, tree: Any, frequency_hz: float) -> Imported:
    """Read power-grid-model input data, sensors included; ``frequency_hz`` turns capacitances into siemens.

    ``tree``: that of the JSON in ``path``. power-grid-model, which has a parser of its own, gets it written anew.

    Raises:
        InvalidInputError: power-grid-model is missing, or finds the data invalid; every component that the network
            model cannot hold; every sensor that no meter can be.
    """
    data = _load(path, tree)
    from scenarios.importers.power_grid_model_sensors import read_sensors

    measured = _has_sensors(data)
    conversion, remarks = _convert_checked(path, data, frequency_hz, measured=measured)
    readings, sensor_remarks = read_sensors(str(path), conversion)
    if measured and not readings:
        conversion, remarks = _convert_checked(path, data, frequency_hz, measured=False)
    if "line" in data:
        remarks.append(Remark("note", f"line capacitances at {frequency_hz:g} Hz, which the file does not hold"))
    converted = {name: len(data[name]) for name in sorted(data) if name not in SENSORS}
    return Imported(
        network=conversion.network,
        data_source=f"power-grid-model input {path.name}",
        converted=converted,
        remarks=(*remarks, *sensor_remarks),
        readings=readings,
        substation=conversion.bus_of[int(_working_source(data)["node"])],
        zero_injection=_find_zero_injections(conversion) if readings else "virtual",
    )


def _convert_checked(path: Path, data: Data, frequency_hz: float, *, measured: bool) -> tuple[Conversion, list[Remark]]:
    try:
        conversion, remarks = _convert(path.stem, data, frequency_hz, measured=measured)
        names = {branch: _kind_of(data, component) for component, branch in conversion.branch_of.items()}
        cure = "put a link in its place, or where it is a source, give it an sk above 1e15 VA"
        refuse_zero_impedances(conversion.network, names, cure)
    except InvalidInputError as error:
        raise InvalidInputError(str(path), error.problems) from None
    return conversion, remarks


def _has_sensors(data: Data) -> bool:
    return any(name in data for name in SENSORS)


def _load(path: Path, tree: Any) -> Data:
    utils = load_extra("power_grid_model.utils", "power-grid-model", str(path))
    validation = load_extra("power_grid_model.validation", "power-grid-model", str(path))
    enum = load_extra("power_grid_model", "power-grid-model", str(path))
    try:
        loaded = utils.json_deserialize(json.dumps(tree))
    except Exception as error:  # whatever a foreign reader raises
        raise InvalidInputError(str(path), [f"power-grid-model cannot read it: {error}"]) from None
    data = {str(getattr(name, "value", name)): table for name, table in loaded.items() if len(table)}
    foreign = [
        f"{name} {_ids(table)}: the network model cannot hold it"
        for name, table in data.items()
        if name not in SUPPORTED
    ]
    if foreign:
        raise InvalidInputError(str(path), foreign)
    purpose = enum.CalculationType.state_estimation if _has_sensors(data) else enum.CalculationType.power_flow
    if errors := validation.validate_input_data(loaded, calculation_type=purpose, symmetric=True):
        raise InvalidInputError(str(path), [f"power-grid-model: {error} Ids: {_ids_of(error)}" for error in errors])
    return data


def _ids_of(error: Any) -> str:
    """The elements that a validation error is about; of several tables (table, id) pairs."""
    ids = [f"{i[0]} {i[1]}" if isinstance(i, tuple) else str(i) for i in error.ids]
    return listed(ids)


def _kind_of(data: Data, component: int) -> str:
    """``line 7``: what a component is, beside its id."""
    kinds = [name for name in (*BUILDERS, "source") if name in data]
    return next(f"{name} {component}" for name in kinds if component in data[name]["id"])


def rows(data: Data, name: str) -> Any:
    """The components called ``name``, none if the data have none."""
    return data.get(name, ())


def _convert(name: str, data: Data, frequency_hz: float, *, measured: bool) -> tuple[Conversion, list[Remark]]:
    if problems := list(_find_problems(data, measured=measured)):
        raise InvalidInputError(name, problems)
    kv = {int(node["id"]): float(node["u_rated"]) / 1000 for node in data["node"]}
    closed = [link for link in rows(data, "link") if link["from_status"] and link["to_status"]]
    bus_of = fuse(kv, ((int(link["from_node"]), int(link["to_node"])) for link in closed))
    branches, branch_of, shunts = _build_branches(data, kv, bus_of, frequency_hz)
    for node, shunt in _find_shunts(data, kv, measured=measured):
        shunts.setdefault(bus_of[node], []).append(shunt)
    buses, generators = _build_buses(data, kv, bus_of, measured=measured)
    source_bus, source_branch, slack = _build_source(data, kv, bus_of)
    if source_bus and source_branch:
        buses.append(source_bus)
        branches.append(source_branch)
        branch_of[int(_working_source(data)["id"])] = source_branch.id
    network = Network(
        name=name,
        base_mva=BASE_VA / 1e6,
        buses=tuple(add_shunts(bus, shunts[bus.id]) if bus.id in shunts else bus for bus in buses),
        branches=tuple(branches),
        generators=(slack, *generators),
    )
    network, island_remarks = leave_out_islands(network)
    remarks = [*fused_remarks(bus_of, "links"), *island_remarks, *_find_open_ends(data), *_find_unused(data)]
    if source_branch:
        text = f"bus {source_branch.from_bus} is new: the inside of the source at bus {source_branch.to_bus}"
        remarks.append(Remark("note", text))
    known = {bus.id for bus in network.buses}
    bus_of = {node: bus for node, bus in bus_of.items() if bus in known}
    ids = {branch.id for branch in network.branches}
    branch_of = {component: branch for component, branch in branch_of.items() if branch in ids}
    return Conversion(data, measured, network, bus_of, branch_of, frozenset(shunts)), remarks


def _find_problems(data: Data, *, measured: bool) -> Iterator[str]:
    sources = [source for source in rows(data, "source") if source["status"]]
    if len(sources) != 1:
        found = listed([f"source {source['id']} at node {source['node']}" for source in sources]) or "none"
        yield f"exactly one source must be in service, the substation; found {found}"
    for name in APPLIANCES:
        held = (CONSTANT_POWER, CONSTANT_IMPEDANCE)
        if bad := [a for a in rows(data, name) if not measured and a["status"] and a["type"] not in held]:
            yield f"{name} {_ids(bad)}: constant current, which the network model cannot hold; make it constant power"


def _find_open_ends(data: Data) -> Iterator[Remark]:
    branches = list(_all_branches(data))
    if half := [b for b in branches if bool(b["from_status"]) != bool(b["to_status"])]:
        yield Remark("changed", f"branch {_ids(half)}: open at one end, written as the shunt that it is")
    if off := [b for b in branches if not b["from_status"] and not b["to_status"]]:
        yield Remark("left out", f"branch {_ids(off)}: open at both ends")


def _find_unused(data: Data) -> Iterator[Remark]:
    for name, reason in IGNORED.items():
        if name in data:
            yield Remark("left out", f"{name} {_ids(data[name])}: {reason}")
    for name in APPLIANCES:
        if unknown := [a for a in rows(data, name) if a["status"] and math.isnan(a["p_specified"])]:
            yield Remark("changed", f"{name} {_ids(unknown)}: no power is specified, 0 is written; its sensor counts")


def _ids(components: Iterable[Any]) -> str:
    return listed([int(component["id"]) for component in components])


def _all_branches(data: Data) -> Iterator[Any]:
    for name in BUILDERS:
        yield from rows(data, name)


def _build_branches(
    data: Data, kv: dict[int, float], bus_of: dict[int, int], frequency_hz: float
) -> tuple[list[Branch], dict[int, str], dict[int, list[complex]]]:
    """The branches closed at both ends, their ids by component, and the shunts of those closed at one (by bus)."""
    taken: set[str | None] = set()
    branches, branch_of = [], {}
    shunts: dict[int, list[complex]] = {}
    for name in BUILDERS:
        for component in rows(data, name):
            if not component["from_status"] and not component["to_status"]:
                continue
            ends = bus_of[int(component["from_node"])], bus_of[int(component["to_node"])]
            branch_id = default_branch_id(*ends, taken)
            nodes_kv = kv[int(component["from_node"])], kv[int(component["to_node"])]
            pi = BUILDERS[name](component, *nodes_kv, frequency_hz)
            branch = Branch(branch_id, *ends, **pi._asdict())
            if component["from_status"] and component["to_status"]:
                taken.add(branch_id)
                branches.append(branch)
                branch_of[int(component["id"])] = branch_id
            else:
                connected = ends[0] if component["from_status"] else ends[1]
                shunts.setdefault(connected, []).append(open_end_shunt(branch, connected))
    return branches, branch_of, shunts


def _find_shunts(data: Data, kv: dict[int, float], *, measured: bool) -> Iterator[tuple[int, complex]]:
    """(node, admittance in p.u.) of shunts in service and, if not measured, of what else is a constant impedance."""
    for shunt in rows(data, "shunt"):
        if shunt["status"]:
            node = int(shunt["node"])
            yield node, complex(shunt["g1"], shunt["b1"]) * kv[node] ** 2
    for name, sign in () if measured else APPLIANCES.items():
        for a in rows(data, name):
            if a["status"] and a["type"] == CONSTANT_IMPEDANCE:
                yield int(a["node"]), -sign * complex(_power(a, "p"), -_power(a, "q"))


def _power(appliance: Any, part: str) -> float:
    value = float(appliance[f"{part}_specified"])
    return 0.0 if math.isnan(value) else value / BASE_VA


def _build_buses(
    data: Data, kv: dict[int, float], bus_of: dict[int, int], *, measured: bool
) -> tuple[list[Bus], list[Generator]]:
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
    ids = sorted(set(bus_of.values()))
    return [Bus(i, kv[i], p_load=(s := loads.get(i, 0j)).real, q_load=s.imag) for i in ids], generators


def _working_source(data: Data) -> Any:
    return next(source for source in data["source"] if source["status"])


def _build_source(
    data: Data, kv: dict[int, float], bus_of: dict[int, int]
) -> tuple[Bus | None, Branch | None, Generator]:
    """The slack behind the source's impedance, ``|z| = u^2 / sk`` with ``r / x = rx_ratio``; at its node if stiff."""
    source = _working_source(data)
    node = bus_of[int(source["node"])]
    sk = float(source["sk"]) if not math.isnan(source["sk"]) else 1e10
    ratio = float(source["rx_ratio"]) if not math.isnan(source["rx_ratio"]) else 0.1
    z = BASE_VA / sk
    va = 0.0 if math.isnan(source["u_ref_angle"]) else float(source["u_ref_angle"])
    vm = 1.0 if math.isnan(source["u_ref"]) else float(source["u_ref"])
    if z < STIFF:
        return None, None, Generator(node, Control.SLACK, vm=vm, va=va)
    inside = max(kv) + 1
    x = z / math.hypot(1.0, ratio)
    branch = Branch(default_branch_id(inside, node, ()), inside, node, r=x * ratio, x=x)
    bus = Bus(inside, kv[node], name=f"inside source {source['id']}")
    return bus, branch, Generator(inside, Control.SLACK, vm=vm, va=va)


def _find_zero_injections(conversion: Conversion) -> tuple[int, ...]:
    """The buses where nothing is connected: for power-grid-model, too, they inject exactly nothing."""
    data, bus_of = conversion.data, conversion.bus_of
    used = {bus_of.get(int(a["node"])) for name in APPLIANCES for a in rows(data, name) if a["status"]}
    used |= {generator.bus for generator in conversion.network.generators}
    return tuple(bus.id for bus in conversion.network.buses if bus.id not in used)
