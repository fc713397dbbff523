"""pandapower networks: read and converted to per unit by pandapower itself, and translated from that here.

``pandapower.converter.to_ppc`` fuses buses at closed switches, models transformers (T model), puts charged line ends at
open switches and takes unsupplied buses out; the result are MATPOWER's matrices with conductances.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.printable import listed, on_one_line
from scenarios.files.network_columns import default_branch_id
from scenarios.files.zero_impedances import reject_zero_impedances
from scenarios.importers.imported import (
    Imported,
    Remark,
    add_shunts,
    fused_remarks,
    load_extra,
    loop_shunt,
    open_end_shunt,
)
from scenarios.importers.matpower.program import BASE_KV, BR_R, BR_X, PD, QD
from scenarios.importers.matpower.reader import BR_B, BS, BUS_I, F_BUS, GS, SHIFT, T_BUS, TAP
from scenarios.importers.pandapower.checks import find_broken, find_constant_currents, find_unread, find_unsupported
from scenarios.importers.pandapower.elements import describe_element, find_left_out, name_rows, read_place
from scenarios.importers.pandapower.measurements import Conversion, find_metered_branches, read_measurements
from scenarios.importers.pandapower.objects import write_anew
from scenarios.importers.pandapower.phases import has_phases, read_three_phases

COUNTED = ("line", "trafo", "impedance", "load", "gen", "shunt", "ward", "motor", "storage")


def read_pandapower(path: Path, tree: Any) -> Imported:
    """Read a pandapower network and its measurement table.

    ``tree``: JSON tree that ``pandapower.to_json`` saved in ``path``. pandapower gets it written again.

    Raises:
        InvalidInputError: the file names objects that are no data; pandapower is missing or cannot read it; every
            element that the network model cannot hold; every measurement that no meter here can read.
    """
    pandapower = load_extra("pandapower", "pandapower", str(path))
    text = write_anew(str(path), tree)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        net = _read_net(pandapower, path, text)
        if has_phases(net):
            return read_three_phases(path, _name_of(net) or path.stem, net)
        sgen = net.sgen.copy()  # sources here, negative loads in pandapower's matrices, clipped to limits there
        net.sgen["in_service"] = False
        ppc = _to_ppc(path, net)
    try:
        conversion, remarks = _convert(_name_of(net) or path.stem, net, sgen, ppc)
        names = {branch: f"{name} {index}" for (name, index), branch in conversion.branch_of.items()}
        cure = "put a closed switch between its two buses in its place"
        reject_zero_impedances(conversion.network, names, cure)
    except InvalidInputError as error:
        raise InvalidInputError(str(path), error.problems) from None
    readings, reading_remarks = read_measurements(str(path), conversion)
    network = conversion.network if readings else _with_impedance_loads(str(path), conversion)
    converted = {"buses": len(network.buses)}
    converted |= {name: int(net[name].in_service.sum()) for name in COUNTED if len(net[name])}
    converted["sgen"] = int(sgen.in_service.sum())
    return Imported(
        network=network,
        data_source=f"pandapower network {net.name or path.name}",
        converted=converted,
        remarks=(*remarks, *reading_remarks, *find_unread(net)),
        readings=readings,
        zero_injection=tuple(conversion.unloaded.values()) or "measured" if readings else "virtual",
    )


def _read_net(pandapower: Any, path: Path, text: str) -> Any:
    """The network in ``text``, read by pandapower and checked with ``find_broken`` and ``find_unsupported``."""
    try:
        net = pandapower.from_json_string(text)
    except Exception as error:  # whatever a foreign reader raises
        raise InvalidInputError(str(path), [f"pandapower cannot read it: {on_one_line(error)}"]) from None
    try:
        problems = list(find_broken(net)) or list(find_unsupported(net))
    except Exception as error:  # tables so broken that pandas cannot go through them
        found = f"{type(error).__name__}: {on_one_line(error)}"
        problems = [f"its tables are broken ({found}); pandapower.diagnostic may say why"]
    if problems:
        raise InvalidInputError(str(path), problems)
    return net


def _to_ppc(path: Path, net: Any) -> Any:
    """The matrices that pandapower makes of ``net`` for a power flow."""
    try:
        return load_extra("pandapower.converter.pypower.to_ppc", "pandapower", str(path)).to_ppc(
            net, init="flat", calculate_voltage_angles=True, check_connectivity=True, mode="pf"
        )
    except Exception as error:
        found = f"{type(error).__name__}: {on_one_line(error)}"
        problem = f"pandapower cannot convert it ({found}); pandapower.diagnostic may say why"
        raise InvalidInputError(str(path), [problem]) from None


def _name_of(net: Any) -> str:
    """The name that the network gives itself, on one line; empty if it gives none."""
    return " ".join(net.name.split()) if isinstance(net.name, str) else ""


def _convert(name: str, net: Any, sgen: Any, ppc: dict[str, Any]) -> tuple[Conversion, list[Remark]]:
    base = float(ppc["baseMVA"])
    bus_of, ids = name_rows(net, ppc)
    auxiliary = set(ids.values()) - set(bus_of.values())
    buses = [_build_bus(net, row, ids[int(row[BUS_I].real)], base) for row in ppc["bus"]]
    all_branches = _build_branches(net, ppc, ids)
    metered = find_metered_branches(net)
    unloaded = {
        element: end
        for element, branch in all_branches.items()
        for end in {branch.from_bus, branch.to_bus}.intersection(auxiliary)
        if element in metered
    }
    folded = auxiliary - set(unloaded.values())
    buses, open_ends, loops = _fold_into_shunts(buses, all_branches, folded)
    branches = {element: branch for element, branch in all_branches.items() if element not in {*open_ends, *loops}}
    network = Network(
        name=name,
        base_mva=base,
        buses=tuple(buses),
        branches=tuple(branches.values()),
        generators=tuple(_build_generators(net, sgen, bus_of, base)),
    )
    remarks = [*fused_remarks(bus_of, "closed switches"), *find_left_out(net, bus_of, all_branches.keys())]
    if open_ends:
        remarks.append(Remark("changed", f"{_named(open_ends)}: open at one end, written as the shunt that it is"))
    for element, end in unloaded.items():
        text = f"open at one end and metered, kept as a branch to bus {end}, where nothing is injected"
        remarks.append(Remark("changed", f"{_named([element])}: {text}"))
    if loops:
        text = "closed switches join its two ends, it carries nothing; its own consumption stays as a shunt"
        remarks.append(Remark("left out", f"{_named(loops)}: {text}"))
    conversion = Conversion(
        net=net,
        sgen=sgen,
        network=network,
        bus_of=bus_of,
        branch_of={element: branch.id for element, branch in branches.items()},
        unloaded=unloaded,
        loops=frozenset(loops),
    )
    return conversion, remarks


def _build_bus(net: Any, row: Any, bus_id: int, base: float) -> Bus:
    name = net.bus.name.get(bus_id)
    x, y = read_place(net, bus_id)
    return Bus(
        id=bus_id,
        base_kv=float(row[BASE_KV].real),
        name=name if isinstance(name, str) else "",
        p_load=float(row[PD].real) / base,
        q_load=float(row[QD].real) / base,
        g_shunt=float(row[GS].real) / base,
        b_shunt=float(row[BS].real) / base,
        x=x,
        y=y,
    )


def _with_impedance_loads(what: str, conversion: Conversion) -> Network:
    """The network with the share of loads that is a constant impedance moved from the load to the shunt of its bus.

    Raises:
        InvalidInputError: listing the loads of constant current.
    """
    net, network, bus_of = conversion.net, conversion.network, conversion.bus_of
    if problems := list(find_constant_currents(net)):
        raise InvalidInputError(what, problems)
    shunts: dict[int, complex] = {}
    for _, load in net.load[net.load.in_service].iterrows():
        p = load.p_mw * load.scaling * load.get("const_z_p_percent", 0.0) / 100 / network.base_mva
        q = load.q_mvar * load.scaling * load.get("const_z_q_percent", 0.0) / 100 / network.base_mva
        if (p or q) and load.bus in bus_of:
            bus = bus_of[int(load.bus)]
            shunts[bus] = shunts.get(bus, 0j) + complex(p, -q)
    buses = [
        add_shunts(replace(b, p_load=b.p_load - y.real, q_load=b.q_load + y.imag), [y])
        if (y := shunts.get(b.id, 0j))
        else b
        for b in network.buses
    ]
    return replace(network, buses=tuple(buses))


def _build_generators(net: Any, sgen: Any, bus_of: dict[int, int], base: float) -> list[Generator]:
    """External grid, generators that hold a voltage, and static generators, in service at supplied buses."""
    generators = []
    for _, grid in net.ext_grid[net.ext_grid.in_service].iterrows():
        va = math.radians(grid.va_degree)
        generators.append(Generator(bus_of[int(grid.bus)], Control.SLACK, vm=float(grid.vm_pu), va=va))
    for _, gen in net.gen[net.gen.in_service].iterrows():
        if gen.bus in bus_of:
            control = Control.SLACK if gen.get("slack", False) else Control.VOLTAGE
            p = gen.p_mw * gen.scaling / base
            generators.append(Generator(bus_of[int(gen.bus)], control, p=float(p), vm=float(gen.vm_pu)))
    for _, gen in sgen[sgen.in_service].iterrows():
        if gen.bus in bus_of:
            p, q = (float(power * gen.scaling / base) for power in (gen.p_mw, gen.q_mvar))
            generators.append(Generator(bus_of[int(gen.bus)], Control.POWER, p, q))
    return generators


def _build_branches(net: Any, ppc: dict[str, Any], ids: dict[int, int]) -> dict[tuple[str, int], Branch]:
    """(element type, index) -> branch, of those in service."""
    base, rows, elements = float(ppc["baseMVA"]), ppc["branch"], _elements_of_rows(net, ppc)
    lopsided = {
        elements[k]
        for key in ("branch_r_asym", "branch_x_asym", "branch_g_asym", "branch_b_asym")
        for k, difference in enumerate(ppc.get(key, ()))
        if difference
    }
    if lopsided:
        text = "its two ends differ in impedance or losses, which the network model cannot hold"
        raise InvalidInputError("branches", [f"{_named(sorted(lopsided))}: {text}"])
    conductance = ppc.get("branch_g", [0.0] * len(rows))
    taken: set[str | None] = set()
    branches = {}
    for element, row, g in zip(elements, rows, conductance, strict=True):
        ends = ids[int(row[F_BUS].real)], ids[int(row[T_BUS].real)]
        branch_id = default_branch_id(*ends, taken)
        taken.add(branch_id)
        branches[element] = Branch(
            id=branch_id,
            from_bus=ends[0],
            to_bus=ends[1],
            r=float(row[BR_R].real),
            x=float(row[BR_X].real),
            b=float(row[BR_B].real),
            tap=float(row[TAP].real) or 1.0,
            shift=math.radians(float(row[SHIFT].real)),
            g=float(g.real),
            **describe_element(net, *element, base),
        )
    return branches


def _elements_of_rows(net: Any, ppc: dict[str, Any]) -> list[tuple[str, int]]:
    """The element (type, index) of each row of branches; pandapower keeps the rows in service only."""
    element_of: dict[int, tuple[str, int]] = {}
    for name, (start, end) in net._pd2ppc_lookups["branch"].items():
        index = net.switch.index[net._impedance_bb_switches] if name == "switch" else net[name].index
        element_of |= {row: (name, int(i)) for row, i in zip(range(start, end), index, strict=True)}
    return [element_of[row] for row, in_service in enumerate(ppc["internal"]["branch_is"]) if in_service]


def _fold_into_shunts(
    buses: list[Bus], branches: dict[tuple[str, int], Branch], auxiliary: set[int]
) -> tuple[list[Bus], list[tuple[str, int]], list[tuple[str, int]]]:
    """The buses with the shunts of the branches that carry nothing; those with an open end, and those in a loop.

    An open end is one of pandapower's ``auxiliary`` buses, which go. A loop has both ends at one bus.
    """
    shunts: dict[int, list[complex]] = {}
    open_ends = [e for e, branch in branches.items() if auxiliary & {branch.from_bus, branch.to_bus}]
    for branch in map(branches.__getitem__, open_ends):
        connected = branch.to_bus if branch.from_bus in auxiliary else branch.from_bus
        shunts.setdefault(connected, []).append(open_end_shunt(branch, connected))
    loops = [e for e, branch in branches.items() if branch.from_bus == branch.to_bus]
    for branch in map(branches.__getitem__, loops):
        shunts.setdefault(branch.from_bus, []).append(loop_shunt(branch))
    kept = [add_shunts(bus, shunts[bus.id]) if bus.id in shunts else bus for bus in buses if bus.id not in auxiliary]
    return kept, open_ends, loops


def _named(elements: Collection[tuple[str, int]]) -> str:
    return listed([f"{name} {index}" for name, index in elements])
