"""Areas whose clocks number scans, on the simulator, with meters that read at different intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from agents.messages.packing import Header, Incarnation, ReadingsMessage, TelemetryMessage
from coordinator.lab.deployment.split import area_files
from coordinator.lab.evaluation.evaluation import estimate_centralised
from coordinator.lab.evaluation.used_readings import UsedReadings
from coordinator.lab.plant.held_readings import HeldReadings
from coordinator.lab.plant.telemetry_messages import make_message
from coordinator.lab.simulator.simulator import STARTED_AT
from dsse_core.grid.measurement import Measurement
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus

SCAN_S = 1.0
BY_CLOCK: Mapping[str, object] = {
    "telemetry.ticks": "clock",
    "run.scan_s": SCAN_S,
    "measurements.voltage.period_s": 1.0,
    "measurements.flow.period_s": 5.0,
    "measurements.injection.period_s": 60.0,
}


def by_clock(name: str = "ieee33", **changes: object) -> Scenario:
    """Meters of 1 s, 5 s and 60 s; ``changes``: keys with two underscores for each dot."""
    return load_scenario(name, changes={**BY_CLOCK, **{key.replace("__", "."): v for key, v in changes.items()}})


class Ticking:
    """A run of ``scenario`` whose meters read when it is their time; ``spoil``: what becomes of a message of readings
    of the gateway on its way, None if it is lost.

    ``readings``: all that areas have said of the readings that they used.
    """

    def __init__(
        self,
        scenario: Scenario,
        spoil: Callable[[TelemetryMessage, float], TelemetryMessage | None] = lambda message, now: message,
        **watchers: Any,
    ) -> None:
        self.scenario = scenario
        self.readings: list[ReadingsMessage] = []
        self.publishes = True
        self._spoil = spoil
        self._sequence = 0
        self._held = HeldReadings(next(iter(scenario.reading_rules.values())).kinds)
        nothing: dict[str, Sequence[Measurement]] = {area.name: () for area in scenario.partition.areas}
        watchers["on_readings"] = lambda at, readings: self.readings.append(readings)
        self.bus = SimulatedBus(area_files(scenario, "sim", ("tcp/127.0.0.1:0",)), nothing, **watchers)
        self._read()

    def _read(self) -> None:
        """The gateway reads all meters that are due, shortly before each tick, and says all that it knows."""
        self._sequence += 1
        now = self.bus.now
        fresh = make_telemetry(self.scenario, self._sequence).by_area
        by_area, read_at = self._held.take(fresh, STARTED_AT + now)
        for area, part in by_area.items() if self.publishes else ():
            header = Header("sim", "plant", Incarnation(1, 1), 0, self._sequence, STARTED_AT + now)
            message = make_message(header, area, part)
            message = replace(message, times=tuple(read_at[k] for k in message.meters))
            if (spoilt := self._spoil(message, now)) is not None:
                self.bus.publish_readings(spoilt)
        self.bus.at(now + SCAN_S, self._read)

    def run(self, duration_s: float) -> None:
        self.bus.run(duration_s)

    def find_gap(self) -> float:
        """The largest difference, p.u. and rad, of what areas show to the centralised estimate of what they used."""
        states = self.bus.states
        scans = {state.header.scan for state in states.values()}
        assert len(scans) == 1, scans
        used = UsedReadings(self.scenario)
        for message in self.readings:
            if message.header.scan in scans:
                used.take(message)
        assert not list(used.find_missing(states))
        telemetry = used.put_into(make_telemetry(self.scenario), self.bus.states)
        report = estimate_centralised(self.scenario, telemetry).report
        assert report is not None
        row = self.scenario.network.row
        gaps = [0.0]
        for state in states.values():
            rows = [row[bus] for bus in state.buses]
            assert rows
            gaps += [
                float(np.max(np.abs(np.array(mine) - whole[rows])))
                for mine, whole in ((state.vm, report.result.vm), (state.va, report.result.va))
            ]
        return max(gaps)

    def qualities(self) -> dict[str, str]:
        return {name: state.quality for name, state in sorted(self.bus.states.items())}

    def notes_of(self, name: str) -> str:
        return "; ".join(self.bus.states[name].notes)
