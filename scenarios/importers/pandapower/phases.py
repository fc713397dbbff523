"""pandapower networks with asymmetric loads or sources: three phases at each bus, by pandapower's own sequences.

``pandapower.runpp_3ph`` makes matrices of the zero, positive and negative sequence, of transformers by their vector
groups. The sequences of each branch joined are its admittances between phases. pandapower's source holds the positive
sequence at its bus, and stands behind its short-circuit impedance in the others. Here it stands behind that impedance
in all, with the voltage that gives pandapower's at the bus in the state that it solves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.primitives import build_line, find_size
from dsse_core.printable import listed, on_one_line
from scenarios.files.network_columns import default_branch_id
from scenarios.importers.fused_branches import fuse_zero_impedances
from scenarios.importers.imported import (
    Imported,
    Remark,
    find_places,
    leave_out_islands,
    load_extra,
)
from scenarios.importers.matpower.program import BASE_KV
from scenarios.importers.matpower.reader import BS, BUS_I, F_BUS, GS, T_BUS
from scenarios.importers.pandapower.checks import ASYMMETRIC
from scenarios.importers.pandapower.elements import describe_element, find_left_out, name_rows, read_place
from scenarios.importers.sequences import ABC, OF_SEQUENCES, join_sequences, spread

APPLIANCES = ("load", "sgen", *ASYMMETRIC)
LEGS = {"wye": ("a", "b", "c"), "delta": ("ab", "bc", "ca")}
VOLTAGE_FACTOR = 1.1  # of the short-circuit power of a source, as in runpp_3ph
VM, VA = 7, 8  # columns of buses
CLOSED = 10  # column of branches
COUNTED = ("line", "trafo", "impedance", "load", "sgen", *ASYMMETRIC, "shunt")


def has_phases(net: Any) -> bool:
    """True where an asymmetric load or source is in service."""
    return any(bool(net[name].in_service.astype(bool).any()) for name in ASYMMETRIC)


def _find_unread_by_phase(net: Any) -> Iterator[str]:
    """Elements in service that ``runpp_3ph`` leaves out, or whose connection it does not know."""
    for name in ("gen", "ward", "motor", "storage"):
        if len(working := net[name].index[net[name].in_service.astype(bool)]):
            text = "beside asymmetric loads or sources it is not read; write it as asymmetric_load or asymmetric_sgen"
            yield f"{name} {listed(list(working))}: {text}"
    for name in APPLIANCES:
        table = net[name][net[name].in_service.astype(bool)]
        known = table["type"].isin(list(LEGS)) if "type" in table.columns else table.bus.isna()
        if len(strange := table.index[~known]):
            yield f"{name} {listed(list(strange))}: type is neither 'wye' nor 'delta'; asymmetric power flows need one"


def read_three_phases(path: Path, name: str, net: Any) -> Imported:
    """The network of ``net``, a node for each phase.

    Raises:
        InvalidInputError: what pandapower's three-phase power flow does not solve, or no network with phases holds.
    """
    if problems := list(_find_unread_by_phase(net)):
        raise InvalidInputError(str(path), problems)
    try:
        load_extra("pandapower.pf.runpp_3ph", "pandapower", str(path)).runpp_3ph(net, numba=False)
    except Exception as error:  # of any kind, such as a missing column of the zero sequence
        text = f"pandapower finds no three-phase power flow: {on_one_line(error)}"
        raise InvalidInputError(str(path), [text]) from None
    bus_of, ids = name_rows(net, net._ppc1)
    branches = _build_branches(net, ids)
    head = bus_of[int(net.ext_grid.bus[net.ext_grid.in_service.astype(bool)].iloc[0])]
    buses = [_build_bus(net, row, ids[int(row[BUS_I].real)]) for row in net._ppc1["bus"]]
    base = 3 * float(net.sn_mva)
    bare = Network(name, base, tuple(buses), tuple(branches.values()), (), tuple(_list_loads(net, bus_of)))
    network = _add_source(bare, head, _find_impedance(net), _find_voltages(net))
    network, gone = leave_out_islands(network)
    network, fused = fuse_zero_impedances(network)
    remarks = [*fused, *gone, *find_left_out(net, bus_of, branches.keys())]
    if len(net.measurement):
        text = "of symmetric quantities, which a network with phases does not have; give meters in the scenario"
        remarks.append(Remark("left out", f"{len(net.measurement)} measurements: {text}"))
    converted = {"buses": len(network.buses), "nodes": network.n_nodes}
    converted |= {kind: int(net[kind].in_service.sum()) for kind in COUNTED if len(net[kind])}
    source = f"pandapower network {net.name or path.name}"
    return Imported(network, source, converted, tuple(remarks), substation=head, places=find_places(network, head))


def _build_bus(net: Any, row: Any, bus_id: int) -> Bus:
    name, (x, y) = net.bus.name.get(bus_id), read_place(net, bus_id)
    called, (g, b) = name if isinstance(name, str) else "", (float(row[k].real) / net.sn_mva for k in (GS, BS))
    return Bus(bus_id, float(row[BASE_KV].real), called, g_shunt=g, b_shunt=b, x=x, y=y, phases=ABC)


def _build_branches(net: Any, ids: Mapping[int, int]) -> dict[tuple[str, int], Branch]:
    """(element type, index) -> branch, of those in service."""
    two_ports = load_extra("pandapower.pypower.makeYbus", "pandapower", "branches").branch_vectors
    rows = net._ppc1["branch"]
    with np.errstate(divide="ignore", invalid="ignore"):  # of branches out of service
        vectors = [two_ports(net[f"_ppc{k}"]["branch"], len(rows)) for k in range(3)]
    taken, found = set[str | None](), dict[tuple[str, int], Branch]()
    for kind, (start, end) in net._pd2ppc_lookups["branch"].items():
        index = net.switch.index[net._impedance_bb_switches] if kind == "switch" else net[kind].index
        for k, i in zip(range(start, end), index, strict=True):
            ends = ids[int(rows[k, F_BUS].real)], ids[int(rows[k, T_BUS].real)]
            if not rows[k, CLOSED].real or ends[0] == ends[1]:
                continue
            ytt, yff, yft, ytf = (np.array([of[part][k] for of in vectors]) for part in range(4))
            y = join_sequences(np.array([[yff, yft], [ytf, ytt]]).transpose(2, 0, 1))
            charging = np.zeros((6, 6), dtype=complex)
            if kind == "line":
                at_ends = np.array([np.diag(of) for of in zip(yff + yft, ytt + ytf, strict=True)])
                charging = join_sequences(at_ends)
            primitive = Primitive(ABC, ABC, y, charging)
            size, branch_id = find_size(primitive), default_branch_id(*ends, taken)
            taken.add(branch_id)
            described = describe_element(net, kind, int(i), 3 * float(net.sn_mva))
            found[kind, int(i)] = Branch(branch_id, *ends, size.real, size.imag, primitive=primitive, **described)
    return found


def _list_loads(net: Any, bus_of: Mapping[int, int]) -> Iterator[Load]:
    """A leg for each phase, or between two, of each load and source."""
    for name in APPLIANCES:
        for _, a in net[name][net[name].in_service.astype(bool)].iterrows():
            if (bus := bus_of.get(int(a.bus))) is None:
                continue
            sign = (-1 if name.endswith("sgen") else 1) * a.scaling / net.sn_mva
            for phase, leg in zip(ABC, LEGS[a.type], strict=True):
                s = (
                    complex(a[f"p_{phase}_mw"], a[f"q_{phase}_mvar"])
                    if name in ASYMMETRIC
                    else complex(a.p_mw, a.q_mvar) / 3
                )
                if s:
                    yield Load(bus, leg, complex(s * sign))


def _find_impedance(net: Any) -> np.ndarray:
    """The impedance of the source between its phases, p.u., as ``runpp_3ph`` has that of its other sequences."""
    (grid,) = (grid for _, grid in net.ext_grid[net.ext_grid.in_service.astype(bool)].iterrows())
    x = VOLTAGE_FACTOR / (grid.s_sc_max_mva / 3 / net.sn_mva) / math.hypot(grid.rx_max, 1.0)
    x0 = x * grid.x0x_max
    return spread(complex(grid.rx_max * x, x), complex(grid.r0x0_max * x0, x0))


def _find_voltages(net: Any) -> np.ndarray:
    """The voltages of the phases of each row of the matrices, p.u., (n_row, 3), 1 where none was found."""
    by_sequence = [
        of["bus"][:, VM] * np.exp(1j * np.radians(of["bus"][:, VA])) for of in (net._ppc0, net._ppc1, net._ppc2)
    ]
    v = (OF_SEQUENCES @ np.array(by_sequence)).T
    return np.asarray(np.where(np.isfinite(v) & (v != 0), v, 1.0))


def _add_source(bare: Network, head: int, z: np.ndarray, v: np.ndarray) -> Network:
    """``bare`` with a source behind ``z`` at ``head`` that gives the positive sequence there of ``v`` (n_bus, 3)."""
    rows, of_nodes = bare.nodes_at(head), v.ravel()
    drawn = build_admittance(bare).ybus @ of_nodes - (bare.find_scheduled(of_nodes) / of_nodes).conj()
    e = complex((of_nodes[rows] + z @ drawn[rows]) @ OF_SEQUENCES[:, 1].conj() / 3)
    inner, primitive = max(bus.id for bus in bare.buses) + 1, build_line(ABC, z, np.zeros((3, 3)))
    size = find_size(primitive)
    feeding = Branch(f"{inner}-{head}", inner, head, size.real, size.imag, name="ext_grid", primitive=primitive)
    buses = (*bare.buses, Bus(inner, bare.bus(head).base_kv, "ext_grid", phases=ABC))
    source = Generator(inner, Control.SLACK, vm=abs(e), va=math.atan2(e.imag, e.real))
    return Network(bare.name, bare.base_mva, buses, (feeding, *bare.branches), (source,), bare.loads)
