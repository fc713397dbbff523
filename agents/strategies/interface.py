"""What a strategy is: what the program asks of every one, and the interface of asynchronous ones.

An asynchronous strategy takes three decisions, without clock and bus: solve, what to send, is it to be sent at once.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from agents.messages.packing import BoundaryUpdate, Header
from agents.protocol.configuration import Configuration
from dsse_core.exchange.boundary_load import NetLoad
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.partition import Area, Neighbour

LARGEST_VM = 10.0  # p.u.; an iteration that goes there wanders for long before it comes back, if it does
LARGEST_VA = 1e3  # rad; digits are lost beyond
LARGEST_SPREAD = 6.0  # rad, of one area's angles beyond what its transformers turn; a bus off by full turns is beyond


@dataclass(frozen=True)
class Knowledge:
    """What an area knows at present.

    ``measurements``: its telemetry of the current scan, virtual measurements included. ``loads``: neighbour ->
    load message; ``boundary``: neighbour -> its newest boundary message; silent neighbours are absent from both.
    ``present``: the neighbours that are present and receive this area's messages.
    """

    measurements: tuple[Measurement, ...]
    loads: Mapping[str, NetLoad] = field(default_factory=dict)
    boundary: Mapping[str, BoundaryUpdate] = field(default_factory=dict)
    present: frozenset[str] = frozenset()
    scan: int = 0


@dataclass(frozen=True)
class Estimate:
    """An area's state as published: arrays of shape (n_bus,) in the order of the area's buses, p.u. and rad.

    ``referenced``: ``va`` counts from the substation. ``removed``: meters taken out as bad data.
    ``critical``: meters that cannot be spared, whatever they read. ``checked``: bad data have been looked for.
    ``settled``: no exchange under way is going to move it. ``undecided``: groups of meters of which the first is taken
    out, and the readings do not tell which of them is wrong.
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

    def is_reasonable(self, no_load_va: np.ndarray) -> bool:
        """Whether a grid can be in this state, however far from any real one. ``no_load_va``: of its unloaded buses.

        NaN is none, and nor is a negative magnitude or a bus that is full turns off, images of a state at which an
        iteration that went astray can settle. Transformers may turn a bus by more than that, or angles be counted anew.
        """
        least, most, load = self.va.min(), self.va.max(), self.va - no_load_va
        voltages = self.vm.min() > 0 and self.vm.max() < LARGEST_VM
        voltages = voltages and least > -LARGEST_VA and most < LARGEST_VA and load.max() - load.min() < LARGEST_SPREAD
        return bool(voltages and math.isfinite(self.sigma_vm.sum() + self.sigma_va.sum() + self.objective))


class AnyStrategy:
    """What the program asks of a strategy, whatever protocol it runs on; nothing asks for its name.

    Attributes:
        message_types: the classes of the messages that areas send each other, beside load messages and heartbeats.
        reconciles_magnitudes: the voltage magnitudes that two areas find at their boundary become equal. If not,
            consensus does not wait for it.
        estimates_alone: each area makes its estimate of ``local_meters`` and of what its neighbours send, and must
            be observable with these; else the areas must be observable together.
        takes_rings: two areas may meet at several buses (``Boundary``).
    """

    message_types: ClassVar[tuple[type[Any], ...]] = ()
    reconciles_magnitudes: ClassVar[bool] = True
    estimates_alone: ClassVar[bool] = False
    takes_rings: ClassVar[bool] = False

    @classmethod
    def find_ring_problems(cls, strategy: str, areas: Iterable[Area]) -> list[str]:
        """Pairs of areas that meet at several buses, where ``strategy``, which this class is, cannot take that."""
        met = {frozenset((a.name, n.area)): a.boundaries[n.area].buses for a in areas for n in a.neighbours}
        return [
            f"areas {' and '.join(sorted(pair))} meet at buses {', '.join(map(str, buses))}: a ring, which "
            f"strategy {strategy!r} cannot take; use 'information', or cut where they meet at one bus"
            for pair, buses in met.items()
            if len(buses) > 1 and not cls.takes_rings
        ]

    @classmethod
    def kinds(cls) -> tuple[str, ...]:
        """Those of its messages, which are parts of keys."""
        return tuple(message_type.kind for message_type in cls.message_types)

    @classmethod
    def local_meters(cls, area: Area, own: Sequence[Meter]) -> Sequence[Meter]:
        """What the estimate of ``area`` rests on where it ``estimates_alone``.

        Its ``own`` meters, or some of them, and pseudo-measurements for what messages say. Those of injections at
        boundary buses stand for load messages.
        """
        return own


class Strategy(AnyStrategy, ABC):
    """One area's side of an asynchronous strategy: it solves with what it knows, and sends each neighbour the result.

    A strategy of one's own derives from it, and its distribution names it in an entry point of group
    ``dsse.strategies`` (docs/tutorials/own-strategy.md). The protocol delivers its messages whatever is lost, and
    keeps the newest of each neighbour. ``message_types`` are subclasses of ``BoundaryUpdate``. Exceptions of
    arithmetic leave the area without an estimate until something changes; the object is then made anew.

    Args:
        content: the area file: the area, its network, neighbours and meters, in p.u. and rad.
    """

    message_types: ClassVar[tuple[type[BoundaryUpdate], ...]]

    @abstractmethod
    def __init__(self, content: Configuration) -> None: ...

    @abstractmethod
    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        """The estimate that ``known`` allows, None if it allows none, and in words what is missing.

        Called whenever something in ``known`` has changed, and at heartbeats.
        """

    @abstractmethod
    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> BoundaryUpdate:
        """What ``neighbour`` is to receive of ``estimate``; ``header`` is passed on as it is."""

    @abstractmethod
    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        """Whether ``message`` to ``neighbour`` differs enough from the last one sent to be sent at once."""

    def find_rejection(self, message: BoundaryUpdate) -> str:
        """Why a neighbour's message cannot be used, in short; empty if it can."""
        return ""

    def describe_backend(self) -> str:
        """For the log: what computes the exchange, and how often something else had to; empty without such a choice."""
        return ""
