"""Nodes and ports: a node is a phase of a bus, a port the end of a branch at a node.

A balanced bus has one node, of the phase "". Rows of nodes follow the buses, rows of ports all from ends, then all to
ends of the branches in service; the phases of a bus or of an end stand in the order of ``PHASES``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

PHASES = ("", "a", "b", "c", "s1", "s2")  # "": all three of a balanced network; s1, s2 of split-phase secondaries
ANY_PHASE = "[abc]|s[12]"  # pattern
PHASE_ANGLE = np.radians([0.0, 0.0, -120.0, 120.0, 0.0, 180.0])  # of each phase at a substation of angle 0
BALANCED = 1  # set of phases, a bit for each: that of a balanced bus
CARRIED = 1e-4  # share of a branch's admittances, below which one is charging, or rounding
ROUNDING = 1e-9  # share of the largest admittance of a branch, below which a sum of some is 0
_BIT = 1 << np.arange(len(PHASES))


def read_phases(texts: Iterable[str]) -> np.ndarray:
    """The set of phases of each text, such as "" or "abc", (n,), a bit for each phase; 0 where it is none, or where
    its phases do not stand in the order of PHASES.
    """
    return np.array([_read_set(text) for text in texts], dtype=np.int64)


def write_phases(phases: int) -> str:
    """The text of a set of phases, see ``read_phases``."""
    return "".join(phase for k, phase in enumerate(PHASES) if phases >> k & 1)


@lru_cache
def list_phases(text: str) -> tuple[str, ...]:
    """The phases of a text, such as ("a", "b") of "ab", in its order; ("",) of ""; empty where it is none."""
    found = re.findall(ANY_PHASE, text)
    return (tuple(found) if text else ("",)) if "".join(found) == text else ()


def share_of_power(phases: str) -> float:
    """The share of the power base that is 1 p.u. at all ``phases`` of a bus: a third at each, all of a balanced bus."""
    return max(1, len(list_phases(phases))) / 3 if phases else 1.0


def explain_phases(text: str) -> str:
    """The problem of a text that is no set of phases, and its cure."""
    neutral = (
        "; a neutral is no node: leave it out, and reduce impedances to those of the phases" if "n" in text else ""
    )
    return f"is {text!r}; give some of {', '.join(PHASES[1:])}, in this order{neutral}"


@lru_cache
def _read_set(text: str) -> int:
    places = [PHASES.index(phase) for phase in list_phases(text)]
    return sum(1 << place for place in places) if places == sorted(set(places)) else 0


def name_node(bus: int, phase: str) -> str:
    """The name of a node, such as 671.a; the bus alone in a balanced network."""
    return f"{bus}.{phase}" if phase else str(bus)


class PhaseRows:
    """Rows of the phases of items, item by item: of buses the nodes, of branch ends the ports.

    ``sets`` (n_item,): the phases of each item, see ``read_phases``. ``item``, ``phase`` (n,): the item and the place
    in PHASES of each row. ``first`` (n_item,): the first row of each item.
    """

    def __init__(self, sets: np.ndarray) -> None:
        self.sets, self.is_balanced = sets, bool((sets == BALANCED).all())
        if self.is_balanced:
            self.item, self.phase = np.arange(len(sets)), np.zeros(len(sets), dtype=np.int64)
        else:
            self.item, self.phase = np.nonzero(sets[:, None] & _BIT)
        self.first = self.item if self.is_balanced else np.searchsorted(self.item, np.arange(len(sets)))

    def __len__(self) -> int:
        return len(self.item)

    def find(self, item: np.ndarray, phase: np.ndarray | int = 0) -> np.ndarray:
        """The row of each item and phase, (k,); -1 where there is none, and of the item -1."""
        if self.is_balanced and not np.any(phase):
            return item
        bit = np.left_shift(1, phase)
        sets, first = (np.append(rows, rows.dtype.type(0))[item] for rows in (self.sets, self.first))  # of -1: 0
        return np.where(sets & bit != 0, first + np.bitwise_count(sets & (bit - 1)), -1)

    def of(self, items: np.ndarray) -> np.ndarray:
        """The rows of all phases of ``items`` (k,), item by item."""
        if self.is_balanced:
            return items
        counts = np.bitwise_count(self.sets[items]).astype(np.intp)
        start = np.repeat(self.first[items] - np.cumsum(counts) + counts, counts)
        return start + np.arange(len(start))

    def at(self, item: int) -> np.ndarray:
        """The rows of one item."""
        first = int(self.first[item])
        return np.arange(first, first + int(self.sets[item]).bit_count())


@dataclass(frozen=True, eq=False)
class Primitive:
    """A branch with phases: its admittance over its ports, the phases at its from end, then those at its to end.

    ``y`` (n_port, n_port), complex, p.u. (of a third of the power base, and of voltages to ground): currents into the
    ports for voltages of their nodes. ``charging``: the part of it that draws current without load.
    """

    from_phases: str
    to_phases: str
    y: np.ndarray
    charging: np.ndarray

    @cached_property
    def is_straight(self) -> bool:
        """True for a line, and for what is one in p.u.: equal voltages at both ends draw charging only."""
        y, n = self.y - self.charging, len(self.y) // 2
        if self.from_phases != self.to_phases or not n:
            return False
        return bool(abs(y[:, :n] + y[:, n:]).max() <= ROUNDING * abs(y).max())

    @cached_property
    def joined_ports(self) -> np.ndarray:
        """The pairs of ports that conductors or windings join, (2, n_pair)."""
        if self.is_straight:
            return np.arange(len(self.y)).reshape(2, -1)
        y = abs(self.y - self.charging)
        return np.array(np.nonzero(y > CARRIED * y.max(initial=0.0)))

    def without(self, dead: np.ndarray) -> Primitive:
        """The branch with no current at its ports ``dead`` (n_port,): there and between them and others y is 0.

        What flows between the others then follows from ``i_dead = 0``, so that a dead conductor of a line couples no
        other two, and its own voltage, which coupling causes, counts nowhere.
        """
        y, idle = _eliminate(self.y, dead), _eliminate(self.y - self.charging, dead)
        return Primitive(self.from_phases, self.to_phases, y, y - idle)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Primitive):
            return NotImplemented
        phases = self.from_phases == other.from_phases and self.to_phases == other.to_phases
        return phases and np.array_equal(self.y, other.y) and np.array_equal(self.charging, other.charging)

    def __hash__(self) -> int:
        return hash((self.from_phases, self.to_phases, self.y.tobytes()))


def _eliminate(y: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """Admittances ``y`` over all ports without the ports ``dead``, whose rows and columns become 0."""
    live, left = np.flatnonzero(~dead), np.zeros_like(y)
    to_live = y[np.ix_(live, dead)] @ np.linalg.pinv(y[np.ix_(dead, dead)], rcond=ROUNDING)
    left[np.ix_(live, live)] = y[np.ix_(live, live)] - to_live @ y[np.ix_(dead, live)]
    return left
