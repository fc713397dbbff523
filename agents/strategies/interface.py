"""The interface between the protocol and a strategy: three decisions, no clock, no bus."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from agents.area_file import AreaFile
from agents.messages import BoundaryMessage, Header
from dsse_core.boundary_load import NetLoad
from dsse_core.measurement import Measurement
from dsse_core.partition import Neighbour


@dataclass(frozen=True)
class Knowledge:
    """What an area knows at present.

    ``measurements``: its telemetry of the current scan, virtual measurements included. ``loads``: neighbour ->
    load message; ``boundary``: neighbour -> its newest boundary message; silent neighbours are absent from both.
    """

    measurements: tuple[Measurement, ...]
    loads: Mapping[str, NetLoad] = field(default_factory=dict)
    boundary: Mapping[str, BoundaryMessage] = field(default_factory=dict)


@dataclass(frozen=True)
class Estimate:
    """An area's state as published: arrays of shape (n_bus,) in the order of the area's buses, p.u. and rad.

    ``referenced``: ``va`` counts from the substation. ``removed``: meters taken out as bad data.
    """

    vm: np.ndarray
    va: np.ndarray
    sigma_vm: np.ndarray
    sigma_va: np.ndarray
    referenced: bool
    objective: float
    degrees_of_freedom: int
    removed: tuple[str, ...]


class Strategy(ABC):
    """One area's side of a boundary-exchange strategy."""

    @abstractmethod
    def __init__(self, content: AreaFile) -> None: ...

    @abstractmethod
    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        """The estimate that ``known`` allows, None if it allows none, and in words what is missing."""

    @abstractmethod
    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> BoundaryMessage:
        """What ``neighbour`` is to hear of ``estimate``."""

    @abstractmethod
    def is_news(self, message: BoundaryMessage, last: BoundaryMessage) -> bool:
        """Whether ``message`` differs from the last one sent enough to be worth sending at once."""
