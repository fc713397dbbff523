"""MATPOWER case files, version 2, as networks. Columns and their meaning: MATPOWER's ``caseformat``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.printable import listed
from scenarios.files.network_columns import default_branch_id
from scenarios.importers.fused_branches import fuse_zero_impedances
from scenarios.importers.imported import (
    Imported,
    Remark,
    find_source_problems,
    fuse,
    leave_out_islands,
    rating,
    without_buses,
)
from scenarios.importers.matpower.program import BASE_KV, BR_R, BR_X, PD, QD, Case, Matrix, run_program

BUS_I, BUS_TYPE, GS, BS, VA_BUS = 0, 1, 4, 5, 8
F_BUS, T_BUS, BR_B, RATE_A, TAP, SHIFT, BR_STATUS = 0, 1, 4, 5, 8, 9, 10
GEN_BUS, PG, QG, VG, GEN_STATUS = 0, 1, 2, 5, 7
PQ, PV, REF, ISOLATED = 1, 2, 3, 4


def read_matpower(path: Path) -> Imported:
    """Read a MATPOWER case.

    Raises:
        InvalidInputError: listing every statement that is not understood, and all that the network cannot hold.
    """
    case = run_program(read_text(path, errors="replace"))
    if case.problems or case.base_mva is None:
        raise InvalidInputError(str(path), case.problems)
    return _build(path, case, case.base_mva)


def _build(path: Path, case: Case, base: float) -> Imported:
    buses, remarks = _build_buses(case.matrices["bus"], base)
    if len(case.bus_names) == len(buses):
        buses = tuple(replace(bus, name=name) for bus, name in zip(buses, case.bus_names, strict=True))
    elif case.bus_names:
        text = f"mpc.bus_name: {len(case.bus_names)} names of {len(buses)} buses do not tell which name is of which bus"
        remarks.append(Remark("left out", text))
    isolated = {int(row[BUS_I]) for row in case.matrices["bus"] if row[BUS_TYPE] == ISOLATED}
    generators, problems = _build_generators(case.matrices["bus"], case.matrices["gen"], base)
    problems += _find_reference_problems(case.matrices["bus"], case.matrices["branch"])
    if problems:
        raise InvalidInputError(str(path), problems)
    try:
        network = Network(path.stem, base, buses, _build_branches(case.matrices["branch"], base), generators)
        if isolated:
            network, gone = without_buses(network, isolated, "they are isolated, type 4")
            remarks += gone
        network, gone = leave_out_islands(network)
        remarks += gone
        network, fused = fuse_zero_impedances(network)
        remarks += fused
    except InvalidInputError as error:
        raise InvalidInputError(str(path), error.problems) from None
    open_branches = [branch.id for branch in network.branches if not branch.in_service]
    if open_branches:
        cure = "kept as open branches; write `switch = true` where one may be closed"
        remarks.append(Remark("note", f"branch {listed(open_branches)}: out of service, {cure}"))
    if idle := [int(row[GEN_BUS]) for row in case.matrices["gen"] if row[GEN_STATUS] <= 0]:
        remarks.append(Remark("left out", f"generator at bus {listed(idle)}: out of service"))
    converted = {
        "buses": len(network.buses),
        "branches": len(network.branches),
        "generators": len(network.generators),
    }
    return Imported(
        network,
        f"MATPOWER case {path.name}",
        converted,
        (
            *(Remark("changed", c) for c in case.changes),
            *remarks,
            *(Remark("left out", field) for field in case.left_out),
        ),
    )


def _build_buses(rows: Matrix, base: float) -> tuple[tuple[Bus, ...], list[Remark]]:
    without_kv = [int(row[BUS_I]) for row in rows if row[BASE_KV] == 0]
    buses = tuple(
        Bus(
            id=int(row[BUS_I]),
            base_kv=row[BASE_KV] or 1.0,
            p_load=row[PD] / base,
            q_load=row[QD] / base,
            g_shunt=row[GS] / base,
            b_shunt=row[BS] / base,
        )
        for row in rows
    )
    text = f"bus {listed(without_kv)}: the case gives no base voltage, 1 kV is written; p.u. do not depend on it"
    return buses, [Remark("changed", text)] if without_kv else []


def _build_branches(rows: Matrix, base: float) -> tuple[Branch, ...]:
    taken: set[str | None] = set()
    branches = []
    for row in rows:
        from_bus, to_bus = int(row[F_BUS]), int(row[T_BUS])
        branch_id = default_branch_id(from_bus, to_bus, taken)
        taken.add(branch_id)
        branches.append(
            Branch(
                id=branch_id,
                from_bus=from_bus,
                to_bus=to_bus,
                r=row[BR_R],
                x=row[BR_X],
                b=row[BR_B],
                tap=row[TAP] or 1.0,
                shift=math.radians(row[SHIFT]),
                in_service=row[BR_STATUS] > 0,
                s_max=rating(row[RATE_A], base),
            )
        )
    return tuple(branches)


def _build_generators(bus_rows: Matrix, rows: Matrix, base: float) -> tuple[tuple[Generator, ...], list[str]]:
    """The generators in service, and the problems of buses with them.

    The type of a bus decides what its generators hold; of those at the reference bus, the first is the slack.
    """
    kinds = {int(row[BUS_I]): row[BUS_TYPE] for row in bus_rows}
    angles = {int(row[BUS_I]): math.radians(row[VA_BUS]) for row in bus_rows}
    references = [bus for bus, kind in kinds.items() if kind == REF]
    working = [row for row in rows if row[GEN_STATUS] > 0]
    known = (PQ, PV, REF, ISOLATED)
    problems = [
        f"bus {bus} is of type {kind:g}; 1 (load), 2 (generator), 3 (reference) and 4 (isolated) are known"
        for bus, kind in kinds.items()
        if kind not in known
    ]
    if len(references) == 1 and references[0] not in {int(row[GEN_BUS]) for row in working}:
        problems.append(f"the reference, bus {references[0]}, has no generator in service that says its voltage")
    generators: list[Generator] = []
    slack_found = False
    for row in working:
        bus = int(row[GEN_BUS])
        control = {PV: Control.VOLTAGE, REF: Control.VOLTAGE}.get(int(kinds.get(bus, PQ)), Control.POWER)
        if kinds.get(bus) == REF and not slack_found:
            control, slack_found = Control.SLACK, True
        generators.append(
            Generator(
                bus=bus,
                control=control,
                p=row[PG] / base,
                q=row[QG] / base,
                vm=row[VG] if control is not Control.POWER else 1.0,
                va=angles[bus] if control is Control.SLACK else 0.0,
            )
        )
    return tuple(generators), problems


def _find_reference_problems(bus_rows: Matrix, branch_rows: Matrix) -> list[str]:
    """Problems of a case without exactly one reference, for each island that branches in service make."""
    references = [(f"the reference (type {REF})", int(row[BUS_I])) for row in bus_rows if row[BUS_TYPE] == REF]
    if not references:
        return ["no bus is of type 3 (reference); the network model holds exactly one substation"]
    if len(references) == 1:
        return []
    buses = [int(row[BUS_I]) for row in bus_rows]
    ends = ((int(row[F_BUS]), int(row[T_BUS])) for row in branch_rows if row[BR_STATUS] > 0)
    island_of = fuse(buses, ((a, b) for a, b in ends if {a, b} <= set(buses)))
    how = "set the types of the others' buses to 4 (isolated)"
    return list(find_source_problems(references, island_of, how))
