"""Branches without impedance beside the others, taken for the busbars that they stand for: their buses become one."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.loads import Shunt
from dsse_core.grid.network import Branch, Bus, Network
from dsse_core.grid.nodes import list_phases, read_phases, write_phases
from dsse_core.grid.physical_ranges import find_range_problems
from dsse_core.printable import listed
from scenarios.files.network_columns import default_branch_id
from scenarios.importers.imported import Remark, add_shunts, fuse, fused_remarks


def fuse_zero_impedances(network: Network) -> tuple[Network, list[Remark]]:
    """``network`` with the two buses of each branch without impedance as one, and remarks on the changes.

    Loads, shunts and sources add up at the remaining bus, which has the phases of all. A branch both ends of which are
    now at it carries nothing and is left out; its charging stays as a shunt, of a branch with phases it is left out.
    The others get the ids that their new ends give.

    Raises:
        InvalidInputError: a transformer would be fused, or left out, whose ratio keeps the two voltages apart; a line
            that joins some phases only of those that both buses have; or a number is one that no grid has.
    """
    if problems := list(find_range_problems(network)):
        raise InvalidInputError(f"network {network.name!r}", problems)
    zero = network.find_zero_impedances()
    if not zero:
        return network, []
    root = fuse(network.row, ((branch.from_bus, branch.to_bus) for branch in zero))
    gone = [b for b in network.branches if root[b.from_bus] == root[b.to_bus]]
    _check_one_voltage(network, gone)
    shunts: dict[int, list[complex]] = {}
    for branch in gone:
        if branch.in_service and not branch.primitive:
            shunts.setdefault(root[branch.from_bus], []).append(complex(branch.g, branch.b))
    members: dict[int, list[Bus]] = {}
    for bus in network.buses:
        members.setdefault(root[bus.id], []).append(bus)
    fused = replace(
        network,
        buses=tuple(_add_up(of, shunts.get(bus, [])) for bus, of in members.items()),
        branches=_moved([b for b in network.branches if root[b.from_bus] != root[b.to_bus]], root),
        generators=tuple(replace(g, bus=root[g.bus]) for g in network.generators),
        loads=tuple(replace(load, bus=root[load.bus]) for load in network.loads),
        shunts=(*(replace(shunt, bus=root[shunt.bus]) for shunt in network.shunts), *_find_legs_of_shunts(members)),
    )
    rest, more = fuse_zero_impedances(fused)  # the median of the remaining branches may be larger
    return rest, [*_find_remarks(network, zero, gone, root), *more]


def _find_remarks(
    network: Network, zero: Collection[Branch], gone: Iterable[Branch], root: Mapping[int, int]
) -> Iterator[Remark]:
    for first in sorted({root[branch.from_bus] for branch in zero}):
        by = listed([f"{b.id} ({abs(complex(b.r, b.x)):.3g} p.u.)" for b in zero if root[b.from_bus] == first])
        by = f"branch {by}, which has no impedance beside the median of {network.median_impedance:.3g} p.u."
        yield from fused_remarks({bus: to for bus, to in root.items() if to == first}, by)
    if charged := [b.id for b in gone if b.in_service and b.primitive and b.primitive.charging.any()]:
        yield Remark("left out", f"branch {listed(charged)}: its charging, as it has no impedance")
    if loops := [branch.id for branch in gone if branch not in zero]:
        yield Remark("left out", f"branch {listed(loops)}: both ends are at one bus now, it carries nothing")


def _check_one_voltage(network: Network, gone: Iterable[Branch]) -> None:
    problems = []
    for b in gone:
        one, other = network.bus(b.from_bus).base_kv, network.bus(b.to_bus).base_kv
        both = {*list_phases(network.bus(b.from_bus).phases)} & {*list_phases(network.bus(b.to_bus).phases)}
        if b.in_service and b.primitive and (apart := sorted(both - {*list_phases(b.primitive.from_phases)})):
            problems.append(
                f"branch {b.id}: without impedance it makes one bus of its two, but it leaves their phases "
                f"{', '.join(apart)} apart; give it an impedance"
            )
        if b.in_service and (one != other or b.tap != 1.0 or b.shift != 0.0):
            problems.append(
                f"branch {b.id}: branches without impedance make one bus of its two, but their voltages differ: "
                f"{one:g} and {other:g} kV, ratio {b.tap:g}, shift {math.degrees(b.shift):g} degrees; correct r "
                "and x of those branches"
            )
    if problems:
        raise InvalidInputError(f"network {network.name!r}", problems)


def _add_up(members: Sequence[Bus], shunts: Iterable[complex]) -> Bus:
    """The bus that ``members`` become, called by the smallest, with all their loads and shunts, and ``shunts``."""
    if len(members) == 1:
        return members[0]
    p, q = sum(bus.p_load for bus in members), sum(bus.q_load for bus in members)
    first, *others = sorted(members, key=lambda bus: bus.id)
    phases = _join_phases(members)
    added = [complex(bus.g_shunt, bus.b_shunt) for bus in others if bus.phases == phases]
    whole = replace(first, p_load=p, q_load=q, phases=phases)
    if first.phases != phases:
        whole = replace(whole, g_shunt=0.0, b_shunt=0.0)
    return add_shunts(whole, [*added, *shunts])


def _join_phases(members: Iterable[Bus]) -> str:
    return write_phases(int(np.bitwise_or.reduce(read_phases([bus.phases for bus in members]))))


def _find_legs_of_shunts(members: Mapping[int, Sequence[Bus]]) -> Iterator[Shunt]:
    """Shunts of buses with some phases of the one that they become."""
    for first, of_first in members.items():
        for bus in of_first:
            if bus.has_shunt and bus.phases != _join_phases(of_first):
                y = complex(bus.g_shunt, bus.b_shunt)
                yield from (Shunt(first, phase, y) for phase in list_phases(bus.phases))


def _moved(branches: Iterable[Branch], root: Mapping[int, int]) -> tuple[Branch, ...]:
    moved: dict[str | None, Branch] = {}
    for branch in branches:
        ends = root[branch.from_bus], root[branch.to_bus]
        branch_id = default_branch_id(*ends, moved)
        moved[branch_id] = replace(branch, id=branch_id, from_bus=ends[0], to_bus=ends[1])
    return tuple(moved.values())
