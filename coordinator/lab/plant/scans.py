"""Scans that a plant publishes: made by the plant itself, or a single one made for it that stays."""

from __future__ import annotations

import pickle
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from agents.messages.packing import Incarnation
from coordinator.lab.deployment.split import find_split
from coordinator.lab.plant.held_readings import HeldReadings
from coordinator.lab.plant.telemetry_messages import DRAW, encode_readings, read
from dsse_core.grid.switches import take_own
from dsse_core.split_identity import SplitIdentity
from scenarios.faults.switching import find_next, find_operated
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry, find_lateness, make_telemetry


class Scans(Protocol):
    """Interface of the scans of a plant.

    ``seed``: of their noise. ``heartbeat_s``: interval at which a scan is repeated. ``split``: of their scenario.
    """

    @property
    def seed(self) -> int: ...

    @property
    def heartbeat_s(self) -> float: ...

    @property
    def split(self) -> SplitIdentity: ...

    def payloads(self, run: str, incarnation: Incarnation, scan: int, elapsed_s: float = 0.0) -> dict[str, bytes]:
        """Area -> its encoded readings, ``elapsed_s`` after the start of the run, which says how switches stand."""
        ...

    def find_next(self, elapsed_s: float) -> float | None:
        """The next time after ``elapsed_s`` at which a switch or its status changes, s; None without one."""
        ...

    def late_s(self, scan: int) -> Mapping[str, float]:
        """Area -> delay of its readings, s."""
        ...


@dataclass(frozen=True)
class OwnScans:
    """Scans made from ``scenario``. ``many``: each scan has noise of its own. Meters read at their intervals."""

    scenario: Scenario
    many: bool

    @property
    def seed(self) -> int:
        return self.scenario.seed

    @property
    def heartbeat_s(self) -> float:
        return self.scenario.run.beat_s

    def payloads(self, run: str, incarnation: Incarnation, scan: int, elapsed_s: float = 0.0) -> dict[str, bytes]:
        scenario, now = self.scenario, time.time()
        operated = find_operated(scenario.faults.events, scenario.network.switches, elapsed_s)
        by_area = make_telemetry(scenario, scan if self.many else DRAW, operated.closed).by_area
        read_at: float | Mapping[str, float] = now
        if scenario.renew_s is not None:
            by_area, read_at = self._held.take(by_area, now)
        readings = (
            (area.name, read(by_area[area.name], read_at).with_statuses(take_own(area.network, operated.read), now))
            for area in scenario.partition.areas
        )
        return encode_readings(readings, run, incarnation, scan, self.split)

    def find_next(self, elapsed_s: float) -> float | None:
        return find_next(self.scenario.faults.events, elapsed_s)

    def late_s(self, scan: int) -> Mapping[str, float]:
        return find_lateness(self.scenario, scan)

    @cached_property
    def split(self) -> SplitIdentity:
        return find_split(self.scenario)

    @cached_property
    def _held(self) -> HeldReadings:
        return HeldReadings(self.scenario.common_rules.kinds)


@dataclass(frozen=True)
class MadeScan:
    """The readings of one scan. On a large grid, passing them on takes a tenth of the time that the scenario takes.

    ``readings``: area -> its readings, pickled, which takes a quarter of the memory while they are kept for a restart.
    Their time of measurement is the time at which a plant asks for them, because the state of the grid is constant.
    """

    readings: Mapping[str, bytes]
    lateness: Mapping[str, float]
    seed: int
    heartbeat_s: float
    split: SplitIdentity

    @classmethod
    def of(cls, scenario: Scenario, telemetry: Telemetry) -> MadeScan:
        """The only scan of ``scenario``, from its ``telemetry``."""
        now = time.time()
        readings = {area: pickle.dumps(read(part, now)) for area, part in telemetry.by_area.items()}
        return cls(readings, find_lateness(scenario, DRAW), scenario.seed, scenario.run.beat_s, find_split(scenario))

    def payloads(self, run: str, incarnation: Incarnation, scan: int, elapsed_s: float = 0.0) -> dict[str, bytes]:
        now = time.time()
        unpacked = ((area, pickle.loads(part).measured_at(now)) for area, part in self.readings.items())
        return encode_readings(unpacked, run, incarnation, scan, self.split)

    def late_s(self, scan: int) -> Mapping[str, float]:
        return self.lateness

    def find_next(self, elapsed_s: float) -> float | None:
        return None
