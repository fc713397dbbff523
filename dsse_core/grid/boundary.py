"""The variables y of a boundary: their number, kinds, buses, phases and names.

A name stands for two variables in each phase: ``s@12>area2`` for (p, q), the power from bus 12 into the branches of
area2, and ``v@12`` for (vm, va), the voltage of bus 12. Phases follow the bus: ``s@12.abc>area2``, ``v@12.s1s2``. The
voltages follow from the powers, so messages name the powers alone. The lengths of messages and the meaning of their
numbers follow from the names.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from dsse_core.grid.nodes import ANY_PHASE, name_node, read_phases, write_phases
from dsse_core.printable import listed

MOST_VARIABLES = 1000
NAME = re.compile(rf"(?P<what>[sv])@(?P<bus>-?(0|[1-9][0-9]{{0,15}}))(\.(?P<phases>({ANY_PHASE})+))?(>(?P<area>.+))?")


class Kind(StrEnum):
    """Active and reactive power, p.u.; voltage magnitude, p.u., and angle, rad."""

    P = "p"
    Q = "q"
    VM = "vm"
    VA = "va"


DEGREE = {Kind.P: 2.0, Kind.Q: 2.0, Kind.VM: 1.0, Kind.VA: 0.0}
"""The power k for which a variable grows as c^k where all voltages grow by c."""
D_SINGLE = 4
"""The number of variables where areas meet at a single balanced bus: y = (p, q, vm, va)."""


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of y at ``bus``. ``area``: the area into whose branches a power flows; empty for a voltage."""

    kind: Kind
    bus: int
    phase: str = ""
    area: str = ""


@dataclass(frozen=True)
class Boundary:
    """The variables that two areas share, powers first, then voltages.

    ``names``: as messages and area files have them (``find_wrong_name``).
    """

    names: tuple[str, ...]

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of y, in its order."""
        return tuple(variable for name in self.names for variable in _read_name(name))

    @cached_property
    def d(self) -> int:
        """The number of variables."""
        return len(self.variables)

    @cached_property
    def places(self) -> dict[Kind, np.ndarray]:
        """Kind -> the positions of its variables in y."""
        return {kind: np.flatnonzero([variable.kind is kind for variable in self.variables]) for kind in Kind}

    @cached_property
    def degrees(self) -> np.ndarray:
        """The degree of each variable, shape (d,), see ``DEGREE``."""
        return np.array([DEGREE[variable.kind] for variable in self.variables])

    @cached_property
    def n_powers(self) -> int:
        """The number of powers, which are the first variables."""
        return sum(variable.kind in (Kind.P, Kind.Q) for variable in self.variables)

    @property
    def powers(self) -> tuple[Variable, ...]:
        """The powers of y."""
        return self.variables[: self.n_powers]

    def needs_powers(self, area: str) -> bool:
        """True where ``area`` does not compute all powers of y itself, as some flow into other areas."""
        return any(power.area != area for power in self.powers)

    @property
    def is_single(self) -> bool:
        """True where the areas meet at a single bus of a balanced network."""
        return self.d == 2 * self.n_powers == D_SINGLE and not self.variables[0].phase

    @cached_property
    def has_one_flow(self) -> bool:
        """True where all that passes is the flow from one bus into one area, so that each side is a net load."""
        return len({(v.bus, v.area) for v in self.variables[: self.n_powers]}) == 1

    @property
    def n_loads(self) -> int:
        """The number of net loads on a side: one of a balanced side, else of each phase of each bus."""
        return len(self.places[Kind.VM]) if self.variables[0].phase else 1

    @cached_property
    def buses(self) -> tuple[int, ...]:
        """The buses at which the areas meet."""
        return tuple(dict.fromkeys(variable.bus for variable in self.variables))

    @cached_property
    def phases(self) -> dict[int, str]:
        """Bus -> its phases in the boundary, such as "abc"; "" in a balanced network."""
        voltages = [variable for variable in self.variables if variable.kind is Kind.VM]
        return {bus: "".join(v.phase for v in voltages if v.bus == bus) for bus in self.buses}

    def per_kind(self, p: float, q: float, vm: float, va: float) -> np.ndarray:
        """One number for each variable, by its kind, shape (d,)."""
        of_kind = {Kind.P: p, Kind.Q: q, Kind.VM: vm, Kind.VA: va}
        return np.array([of_kind[variable.kind] for variable in self.variables])


def boundary_at(buses: Sequence[int | str], child: str) -> Boundary:
    """The boundary where ``child`` and its parent meet at ``buses``, such as 12, or "12.abc" of one with phases."""
    return boundary_of(add_voltages(tuple(f"s@{bus}>{child}" for bus in buses)))


@functools.lru_cache(maxsize=1024)
def add_voltages(powers: tuple[str, ...]) -> tuple[str, ...]:
    """The names of ``powers``, then of the voltages of their buses in the phases that the powers there have together.

    A text that names no variables adds none.
    """
    sets: dict[int, int] = {}
    for name in powers:
        if found := NAME.fullmatch(name):
            bus = int(found["bus"])
            sets[bus] = sets.get(bus, 0) | _read_set(found)
    return *powers, *(f"v@{name_node(bus, write_phases(phases))}" for bus, phases in sets.items())


@functools.lru_cache(maxsize=1024)
def boundary_of(names: tuple[str, ...]) -> Boundary:
    """The boundary of ``names``, found once for all messages about it."""
    return Boundary(names)


@functools.lru_cache(maxsize=1024)
def find_wrong_name(names: tuple[str, ...]) -> str:
    """The first problem of ``names`` as names of a boundary's variables, as text; empty if there is none."""
    for name in names:
        found = NAME.fullmatch(name)
        if found is None or (found["what"] == "s") != bool(found["area"]) or not _read_set(found):
            return f"variable {name[:40]!a}"
    variables = [variable for name in names for variable in _read_name(name)]
    if len(set(variables)) < len(variables):
        return "a variable given twice"
    powers = select_powers(names)
    if names != (expected := add_voltages(powers)):
        return f"other voltages than {listed(expected[len(powers) :]) or 'none'} behind its powers"
    return "" if 0 < len(variables) <= MOST_VARIABLES else f"{len(variables)} variables, not 1 to {MOST_VARIABLES}"


def select_powers(names: tuple[str, ...]) -> tuple[str, ...]:
    """Those of ``names`` that stand for powers, from which the others follow."""
    return tuple(name for name in names if name.startswith("s"))


def _read_set(found: re.Match[str]) -> int:
    """The set of phases of a name; 0 where they do not stand in their order."""
    return int(read_phases([found["phases"] or ""])[0])


def _read_name(name: str) -> Iterator[Variable]:
    found = NAME.fullmatch(name)
    if found is None:
        raise ValueError(f"{name!a} is the name of no variables")
    kinds = (Kind.P, Kind.Q) if found["what"] == "s" else (Kind.VM, Kind.VA)
    for phase in re.findall(ANY_PHASE, found["phases"] or "") or [""]:
        for kind in kinds:
            yield Variable(kind, int(found["bus"]), phase, found["area"] or "")
