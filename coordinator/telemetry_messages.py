"""One scan of readings as telemetry messages: of the plant's process and of the twin alike."""

from __future__ import annotations

import time
from collections.abc import Sequence

from agents.access import PLANT
from agents.messages import Header, Incarnation, TelemetryMessage, encode
from dsse_core.measurement import Measurement, Source
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

DRAW = 1  # of the noise: the same readings for the same seed


def make_payloads(scenario: Scenario, run: str, life: Incarnation, scan: int = 1, draw: int = DRAW) -> dict[str, bytes]:
    """Area -> its encoded readings with noise ``draw``. Virtual measurements are no readings: agents know them."""
    header = Header(
        run=run,
        sender=PLANT,
        incarnation=life,
        scan=scan,
        sequence=scan,
        time=time.time(),
    )
    return {
        area: encode(make_message(header, area, measurements))
        for area, measurements in make_telemetry(scenario, draw).by_area.items()
    }


def make_message(header: Header, area: str, measurements: Sequence[Measurement]) -> TelemetryMessage:
    """One scan of ``area``'s meters as a message."""
    readings = [m for m in measurements if m.meter.source is not Source.VIRTUAL]
    return TelemetryMessage(
        header,
        area,
        tuple(m.meter.id for m in readings),
        tuple(float(m.value) for m in readings),
        tuple(float(m.sigma) for m in readings),
    )
