"""Areas of a scenario with a new state and new readings at each look, drawn instead of computed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation, ReadingsMessage, StateMessage
from coordinator.watch.observe.watcher import Watcher
from scenarios.scenario import Scenario
from scenarios.telemetry import read_meters

RUN = "run"
ME = Incarnation(1, 1)
SPREAD = 0.002  # p.u., of voltages from scan to scan
NOT_GOOD = 7  # one area in so many is degraded


@dataclass
class _Content:
    """Parts of an area's messages that stay from scan to scan, and the values around which the others scatter."""

    buses: tuple[int, ...]
    vm: np.ndarray
    va: np.ndarray
    neighbours: tuple[str, ...]
    meters: tuple[str, ...]
    values: np.ndarray
    sigmas: np.ndarray


@dataclass
class Feed:
    """Feed of a watcher. Each look is a scan of all areas: voltages and readings scatter around the power flow."""

    scenario: Scenario
    scan: int = 0
    watcher: Watcher = field(init=False)
    _contents: dict[str, _Content] = field(init=False)

    def __post_init__(self) -> None:
        scenario = self.scenario
        names = [area.name for area in scenario.partition.areas]
        self.watcher = Watcher(RUN, frozenset(names))
        for name in names:
            self.watcher.take_presence(live_key(RUN, "area", name, ME), True)
        read = read_meters(scenario)
        assert read.truth is not None, "the scenario has a power flow"
        place = {meter.id: k for k, meter in enumerate(scenario.meters)}
        meters = scenario.partition.meters_by_area(scenario.meters)
        self._contents = {}
        for area in scenario.partition.areas:
            rows = [scenario.network.row[bus.id] for bus in area.network.buses]
            own = [meter.id for meter in meters[area.name]]
            at = [place[name] for name in own]
            self._contents[area.name] = _Content(
                tuple(bus.id for bus in area.network.buses),
                read.truth.vm[rows],
                read.truth.va[rows],
                tuple(neighbour.area for neighbour in area.neighbours),
                tuple(own),
                read.values[at],
                read.sigmas[at],
            )

    def __call__(self, duration_s: float) -> Watcher:
        time.sleep(duration_s)
        self.scan += 1
        chance = np.random.default_rng(self.scan)
        for number, (name, content) in enumerate(self._contents.items()):
            header = Header(RUN, name, ME, self.scan, self.scan, time.time())
            self.watcher.take_state(
                _state_of(header, content, chance, (self.scan + number) % NOT_GOOD == 0), time.monotonic()
            )
            self.watcher.take_readings(_readings_of(header, content, chance))
        return self.watcher


def _state_of(header: Header, content: _Content, chance: np.random.Generator, is_degraded: bool) -> StateMessage:
    n = len(content.buses)
    small = (0.001,) * n
    return StateMessage(
        header=header,
        buses=content.buses,
        vm=tuple((content.vm + chance.normal(0, SPREAD, n)).tolist()),
        va=tuple(content.va.tolist()),
        sigma_vm=small,
        sigma_va=small,
        referenced=True,
        objective=float(len(content.meters)),
        degrees_of_freedom=len(content.meters),
        removed=(),
        critical=(),
        checked=True,
        sent=dict.fromkeys(content.neighbours, (1, header.scan)),
        received=dict.fromkeys(content.neighbours, (1, header.scan)),
        messages=5 * header.scan,
        bytes=500 * header.scan,
        lost=header.scan // 20,
        rejected={},
        notes=("neighbour area1 is silent",) if is_degraded else (),
        faults={},
        quality="degraded" if is_degraded else "good",
        telemetry_age=0.1,
        ages=dict.fromkeys(content.neighbours, 0.2),
        scans=dict.fromkeys(content.neighbours, header.scan),
        old_sides=(),
    )


def _readings_of(header: Header, content: _Content, chance: np.random.Generator) -> ReadingsMessage:
    n, off = len(content.meters), chance.normal(0, 1, len(content.meters))
    return ReadingsMessage(
        header=header,
        taken_at=header.time,
        meters=content.meters,
        values=tuple((content.values + content.sigmas * off).tolist()),
        sigmas=tuple(content.sigmas.tolist()),
        times=(header.time,) * n,
        estimates=tuple(content.values.tolist()),
        normalised=tuple(np.abs(off).tolist()),
    )
