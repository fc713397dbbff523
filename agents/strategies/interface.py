"""The interface between the asynchronous protocol and a strategy: three decisions, no clock, no bus."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from agents.area_files.area_file import AreaFile
from agents.messages.packing import BoundaryUpdate, Header
from dsse_core.exchange.boundary_load import NetLoad
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.partition import Neighbour

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
    ``settled``: no exchange under way is going to move it.
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

    def is_reasonable(self, no_load_va: np.ndarray) -> bool:
        """Whether a grid can be in this state, however far from any real one. ``no_load_va``: of its unloaded buses.

        NaN is none, and nor is a negative magnitude or a bus that is full turns off, images of a state at which an
        iteration that went astray can settle. Transformers may turn a bus by more than that, or angles be counted anew.
        """
        least, most, load = self.va.min(), self.va.max(), self.va - no_load_va
        voltages = self.vm.min() > 0 and self.vm.max() < LARGEST_VM
        voltages = voltages and least > -LARGEST_VA and most < LARGEST_VA and load.max() - load.min() < LARGEST_SPREAD
        return bool(voltages and math.isfinite(self.sigma_vm.sum() + self.sigma_va.sum() + self.objective))


class Strategy(ABC):
    """One area's side of an asynchronous strategy. ``kind``: that of the messages it sends and takes."""

    kind: ClassVar[str]

    @abstractmethod
    def __init__(self, content: AreaFile) -> None: ...

    @abstractmethod
    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        """The estimate that ``known`` allows, None if it allows none, and in words what is missing."""

    def describe_backend(self) -> str:
        """For the log: what computes the exchange, and how often something else had to; empty without such a choice."""
        return ""

    def find_rejection(self, message: BoundaryUpdate) -> str:
        """Why a neighbour's message cannot be used, in short; empty if it can."""
        return ""

    @abstractmethod
    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> BoundaryUpdate:
        """What ``neighbour`` is to receive of ``estimate``."""

    @abstractmethod
    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        """Whether ``message`` to ``neighbour`` differs from the last one sent enough to be worth sending at once."""
