"""Network files: a whole grid in engineering units (kV, MW, Mvar, ohm) as TOML; per unit and radians come out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.strict_table import load_strict
from dsse_core.files.wording import suggest
from dsse_core.grid.network import Control, Generator, Network
from dsse_core.grid.nodes import share_of_power
from dsse_core.grid.physical_ranges import find_base_problems, find_range_problems
from dsse_core.printable import listed
from scenarios.files.network_columns import BranchArrays, BusArrays
from scenarios.files.network_phases import PhaseParts, find_parts_with_phases, read_phase_parts
from scenarios.files.network_tables import NetworkFile, SourceTable
from scenarios.files.shipped_files import find_shipped
from scenarios.files.zero_impedances import find_zero_impedance_problems


def load_case(name: str) -> Network:
    """The shipped network called ``name``.

    Raises:
        InvalidInputError: no such network; lists those that are shipped.
    """
    cases = find_shipped("cases")
    if name not in cases:
        problem = f"no shipped network has this name; shipped: {', '.join(cases)}{suggest(name, cases)}"
        raise InvalidInputError(f"network {name!r}", [f"{problem} (a network file of your own ends in .toml or .json)"])
    return load_network(cases[name])


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # such numbers are named, with their key
def load_network(path: Path) -> Network:
    """Read a network file; its quantities in p.u. on ``base_mva`` and rad.

    Raises:
        InvalidInputError: listing every problem of the file, with key paths.
    """
    file = load_strict(path, NetworkFile)
    what, base = file.called(path), file.base_mva
    buses = BusArrays.of(file.bus, base)
    phases = dict(zip(buses.id.tolist(), buses.phases, strict=True)) if any(buses.phases) else {}
    if problems := list(_find_form_problems(file, has_phases=bool(phases))):
        raise InvalidInputError(what, problems)
    shares = {bus: share_of_power(text) for bus, text in phases.items()}
    generators = tuple(_build_generator(source, base * shares.get(source.bus, 1.0)) for source in file.source)
    base_kv = dict(zip(buses.id[::-1].tolist(), buses.base_kv[::-1].tolist(), strict=True))
    if problems := list(find_base_problems(base, base_kv)):  # others are divided by these numbers
        raise InvalidInputError(what, problems)
    parts = PhaseParts()
    if phases:
        parts = read_phase_parts(file, dict(zip(buses.id.tolist(), buses.base_kv.tolist(), strict=True)), phases)
    branches = BranchArrays.of(parts.branches or file.branch, buses, base)
    problems = [
        *parts.problems,
        *_find_unit_problems(branches, is_list=isinstance(file.branch, list)),
        *_find_id_problems(branches),
    ]
    try:
        of_branches = branches.build(parts.primitives)
        loads, shunts = tuple(parts.loads), tuple(parts.shunts)
        network = Network(file.name, base, buses.build(), of_branches, generators, loads, shunts=shunts)
    except InvalidInputError as error:
        raise InvalidInputError(what, [*problems, *error.problems]) from None
    if problems := [*problems, *find_range_problems(network), *find_zero_impedance_problems(network)]:
        raise InvalidInputError(what, problems)
    return network


def _find_form_problems(file: NetworkFile, *, has_phases: bool) -> Iterator[str]:
    """Tables that only a network with phases has, or cannot have."""
    if has_phases and not isinstance(file.branch, list):
        yield "branch.phases: missing; in a network with phases each branch says those that it joins"
    if not has_phases and (parts := find_parts_with_phases(file)):
        yield f"bus: {listed(parts)} has phases, and no bus has; give each bus its phases"


def _find_unit_problems(branches: BranchArrays, *, is_list: bool) -> Iterator[str]:
    """Branches between two voltages with an impedance in ohm or a rating in ampere, which are ambiguous there.

    ``is_list``: true where the file has a list of branches, false where it has a list for each key.
    """
    from_kv, to_kv = branches.from_kv, branches.to_kv
    between = (from_kv != to_kv) & ~np.isnan(from_kv) & ~np.isnan(to_kv)
    in_ampere = ~np.isnan(branches.i_max)
    for k in np.flatnonzero(between & (branches.in_ohm | in_ampere)).tolist():
        joins = (
            f"the branch joins bus {branches.from_bus[k]} of {from_kv[k]} kV and bus {branches.to_bus[k]} of "
            f"{to_kv[k]} kV"
        )
        at = f"branch[{k + 1}].{{}}" if is_list else f"branch.{{}}[{k + 1}]"
        if branches.in_ohm[k]:
            yield f"{at.format('r_ohm')}: {joins}, so an impedance in ohm is ambiguous; give r_pu and x_pu"
        if in_ampere[k]:
            yield f"{at.format('rating_a')}: {joins}, so a current is ambiguous; give rating_mva"


def _find_id_problems(branches: BranchArrays) -> Iterator[str]:
    """Ids given to a branch by which another one, between other buses, is called."""
    ends = list(zip(branches.from_bus.tolist(), branches.to_bus.tolist(), strict=True))
    given = {branch_id: of for branch_id, of in zip(branches.id, ends, strict=True) if branch_id}
    called_by_ends = (at for branch_id, at in zip(branches.id, ends, strict=True) if given and not branch_id)
    for from_bus, to_bus in dict.fromkeys(called_by_ends):
        of = given.get(f"{from_bus}-{to_bus}")
        if of and {*of} != {from_bus, to_bus}:
            yield (
                f"branch {from_bus}-{to_bus}: the branch between bus {of[0]} and bus {of[1]} has this id; give it "
                f"another, or the branch from {from_bus} to {to_bus} one of its own"
            )


def _build_generator(source: SourceTable, base_mva: float) -> Generator:
    return Generator(
        bus=source.bus,
        control=Control(source.kind),
        p=source.p_mw / base_mva,
        q=source.q_mvar / base_mva,
        vm=1.0 if source.vm_pu is None else source.vm_pu,
        va=math.radians(source.va_deg or 0.0),
    )
