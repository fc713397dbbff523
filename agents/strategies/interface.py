"""Interfaces of strategies: that of all strategies to the program, and that of asynchronous ones.

An asynchronous strategy takes three decisions, without clock and bus: the estimate, the message to each neighbour, and
whether the message is sent at once.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from agents.messages.packing import BoundaryUpdate, Header
from agents.protocol.configuration import Configuration
from dsse_core.exchange.boundary_load import Loads
from dsse_core.gauss_newton import FARTHEST_DVM, are_magnitudes
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.partition import Area, Neighbour

LARGEST_VM = FARTHEST_DVM  # p.u.; an iteration that exceeds it wanders for long before it comes back, if it does
LARGEST_VA = 1e3  # rad; larger angles lose digits


@dataclass(frozen=True)
class Knowledge:
    """Present knowledge of an area, from which its strategy solves.

    ``measurements``: its telemetry of the current scan, virtual measurements included. ``loads``: neighbour -> net
    loads of its side, one of a balanced side, else one of each phase of the boundary; ``boundary``: neighbour -> its
    newest boundary message; silent neighbours are absent from both. ``present``: the neighbours that are present and
    receive this area's messages. ``scan``: number of the scan.
    """

    measurements: tuple[Measurement, ...]
    loads: Mapping[str, Loads] = field(default_factory=dict)
    boundary: Mapping[str, BoundaryUpdate] = field(default_factory=dict)
    present: frozenset[str] = frozenset()
    scan: int = 0


@dataclass(frozen=True)
class Estimate:
    """An area's state as published: arrays of shape (n_nodes,) in the order of the area's nodes, p.u. and rad.

    ``referenced``: ``va`` counts from the substation. ``removed``: meters taken out as bad data.
    ``critical``: meters that cannot be spared, whatever they read. ``checked``: the search for bad data has been done.
    ``settled``: no exchange under way is going to move the estimate. ``undecided``: groups of meters of which the first
    is taken out, while the readings do not tell which meter of the group is wrong. ``into_children``: the powers into
    the branches of the children, p.u., as ``Area.powers_into_children`` has them; empty where they are not known.
    ``dead``: nodes without supply, by rows, whose voltage is published as 0. ``taps``: branch -> its estimated tap
    ratio, and the standard deviation of that.
    """

    vm: np.ndarray
    va: np.ndarray
    sigma_vm: np.ndarray
    sigma_va: np.ndarray
    referenced: bool
    objective: float
    degrees_of_freedom: int
    removed: tuple[str, ...]
    critical: tuple[str, ...] = ()
    checked: bool = True
    settled: bool = True
    undecided: tuple[tuple[str, ...], ...] = ()
    into_children: tuple[float, ...] = ()
    dead: tuple[int, ...] = ()
    taps: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def is_reasonable(self, no_load_va: np.ndarray) -> bool:
        """True where a grid can be in this state, however unusual it is; ``no_load_va``: angles of the unloaded buses.

        NaN is no such state. A bus that is off by full turns is an image of one, as a negative magnitude is (see
        ``are_magnitudes``), and no such state either. So angles spread over less than half a turn. Turns that the
        unloaded buses have, too, as behind transformers, and a common shift of all angles do not count.
        """
        least, most, load = self.va.min(), self.va.max(), self.va - no_load_va
        voltages = are_magnitudes(self.vm) and self.vm.max() < LARGEST_VM
        voltages = voltages and least > -LARGEST_VA and most < LARGEST_VA and load.max() - load.min() < math.pi
        return bool(voltages and math.isfinite(self.sigma_vm.sum() + self.sigma_va.sum() + self.objective))


class AnyStrategy:
    """Interface of a strategy to the program, for every protocol; no decision depends on the strategy's name.

    Attributes:
        message_types: the classes of the messages that areas send each other, beside load messages and heartbeats.
        reconciles_magnitudes: the voltage magnitudes that two areas find at their boundary become equal. If not,
            consensus does not wait for that.
        estimates_alone: each area estimates from ``local_meters`` and the messages of its neighbours, and must be
            observable with these; else the areas must be observable together.
        takes_rings: more than one flow may pass a boundary (``Boundary``), and switches may be operated.
        why_no_phases: the reason why buses may not have phases; empty where they may.
    """

    message_types: ClassVar[tuple[type[Any], ...]] = ()
    reconciles_magnitudes: ClassVar[bool] = True
    estimates_alone: ClassVar[bool] = False
    takes_rings: ClassVar[bool] = False
    why_no_phases: ClassVar[str] = "it counts one voltage for each bus"

    @classmethod
    def find_area_problems(cls, strategy: str, areas: Sequence[Area]) -> list[str]:
        """Rings between areas, switches and phases, where this class, named ``strategy``, takes none."""
        met = {frozenset((a.name, n.area)): a.boundaries[n.area] for a in areas for n in a.neighbours}
        problems = []
        if cls.why_no_phases and not all(area.network.table.nodes.is_balanced for area in areas):
            problem = f"buses have phases, which strategy {strategy!r} cannot take: {cls.why_no_phases}"
            problems.append(f"{problem}; use 'information' or 'admm'")
        for area in areas if not cls.takes_rings else ():
            if switches := area.network.switches:
                problem = f"area {area.name} has the switch {', '.join(switches)}, which strategy {strategy!r}"
                problems.append(f"{problem} cannot operate; use 'information', or leave `switch = true` out")
            if taps := area.network.estimated_taps:
                problem = f"area {area.name} has the tap of branch {', '.join(taps)}, which strategy {strategy!r}"
                problems.append(f"{problem} cannot estimate; use 'information', or leave `estimate_tap = true` out")
        return problems + [
            f"areas {' and '.join(sorted(pair))} share bus {', '.join(map(str, boundary.buses))}: a ring, which "
            f"strategy {strategy!r} cannot take; use 'information', or cut so that areas form a tree"
            for pair, boundary in met.items()
            if not (boundary.has_one_flow or cls.takes_rings)
        ]

    @classmethod
    def kinds(cls) -> tuple[str, ...]:
        """Kinds of the strategy's messages, which are parts of keys."""
        return tuple(message_type.kind for message_type in cls.message_types)

    @classmethod
    def local_meters(cls, area: Area, own: Sequence[Meter]) -> Sequence[Meter]:
        """Meters on which the estimate of ``area`` rests where the strategy ``estimates_alone``.

        These are its ``own`` meters, or some of them, and pseudo-measurements for the content of messages.
        Pseudo-measurements of injections at boundary buses stand for load messages.
        """
        return own


class Strategy(AnyStrategy, ABC):
    """One area's side of an asynchronous strategy: its estimate from its knowledge, and a message to each neighbour.

    Your own strategy derives from this class, and its distribution names it in an entry point of group
    ``dsse.strategies`` (docs/tutorials/own-strategy.md). The protocol repeats its messages, so that lost ones arrive in
    the end, and keeps the newest of each neighbour. ``message_types`` are subclasses of ``BoundaryUpdate``. Exceptions
    of arithmetic leave the area without an estimate until something changes; then a new object is made.

    Args:
        content: the area file: the area, its network, neighbours and meters, in p.u. and rad.
    """

    message_types: ClassVar[tuple[type[BoundaryUpdate], ...]]

    @abstractmethod
    def __init__(self, content: Configuration) -> None: ...

    @abstractmethod
    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        """The estimate that ``known`` allows, None if it allows none, and notes, such as on missing messages.

        Called whenever something in ``known`` has changed, and at heartbeats.
        """

    @abstractmethod
    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> BoundaryUpdate:
        """Message to ``neighbour`` about ``estimate``; ``header`` is passed on as it is."""

    @abstractmethod
    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        """True where ``message`` to ``neighbour`` differs enough from the ``last`` one sent to be sent at once."""

    def find_rejection(self, message: BoundaryUpdate) -> str:
        """Reason why a neighbour's message cannot be used, in short; empty if it can."""
        return ""

    def describe_backend(self) -> str:
        """Back end of the exchange, and the number of uses of another one, for the log; empty without such a choice."""
        return ""
