"""One scan of readings as telemetry messages, for the plant's process and for the simulator."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agents.messages.packing import Header, Incarnation, TelemetryMessage, encode
from agents.security.access import PLANT
from dsse_core.grid.columns import read_column, take_items
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.meter_table import find_virtual, list_ids, read_meters_of
from dsse_core.grid.switches import READ_AS, name_status_meter
from dsse_core.split_identity import NO_SPLIT, SplitIdentity
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

DRAW = 1  # of the noise: the same readings for the same seed
NO_STATUS: Mapping[str, str] = {}


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings of the meters of one area at ``times``, s since 1970; p.u. and rad."""

    meters: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    times: tuple[float, ...]

    def with_statuses(self, statuses: Mapping[str, str], time: float) -> Readings:
        """These readings, and those of ``statuses``, of switch -> status, at ``time``, s since 1970."""
        count = len(statuses)
        return Readings(
            (*self.meters, *map(name_status_meter, statuses)),
            (*self.values, *(READ_AS[status] for status in statuses.values())),
            (*self.sigmas, *(0.0,) * count),
            (*self.times, *(time,) * count),
        )

    def measured_at(self, time: float) -> Readings:
        """The same values, read at ``time``, s since 1970."""
        return replace(self, times=(time,) * len(self.times))


def read(measurements: Sequence[Measurement], measured_at: float | Mapping[str, float]) -> Readings:
    """Readings of ``measurements`` without the virtual ones, which agents add themselves.

    ``measured_at``: time of measurement, s since 1970, of all or by id of the meter.
    """
    real = np.flatnonzero(~find_virtual(read_meters_of(measurements)))
    readings = take_items(measurements, real)
    ids = tuple(list_ids(read_meters_of(readings)))
    return Readings(
        ids,
        tuple(read_column(readings, "value", float).tolist()),
        tuple(read_column(readings, "sigma", float).tolist()),
        (measured_at,) * len(ids) if isinstance(measured_at, float) else tuple(measured_at[k] for k in ids),
    )


def make_payloads(
    scenario: Scenario,
    run: str,
    incarnation: Incarnation,
    scan: int = 1,
    draw: int = DRAW,
    split: SplitIdentity = NO_SPLIT,
) -> dict[str, bytes]:
    """Area -> its encoded readings with noise ``draw``. ``split``: of ``scenario``, stated in the messages."""
    by_area = make_telemetry(scenario, draw).by_area
    now = time.time()
    return encode_readings(((area, read(part, now)) for area, part in by_area.items()), run, incarnation, scan, split)


def encode_readings(
    readings: Iterable[tuple[str, Readings]],
    run: str,
    incarnation: Incarnation,
    scan: int,
    split: SplitIdentity = NO_SPLIT,
) -> dict[str, bytes]:
    """Area -> its ``readings``, encoded as an incarnation of the plant publishes them. ``split``: of its scenario."""
    header = Header(run=run, sender=PLANT, incarnation=incarnation, scan=scan, sequence=scan, time=time.time())
    return {area: encode(_message(header, area, part, split)) for area, part in readings}


def make_message(
    header: Header, area: str, measurements: Sequence[Measurement], statuses: Mapping[str, str] = NO_STATUS
) -> TelemetryMessage:
    """One scan of ``area``'s meters as a message. ``statuses``: switch of the area -> its status as it is read."""
    return _message(header, area, read(measurements, header.time).with_statuses(statuses, header.time))


def _message(header: Header, area: str, readings: Readings, split: SplitIdentity = NO_SPLIT) -> TelemetryMessage:
    count = len(readings.meters)  # all meters of a simulated plant are sound
    columns = readings.meters, readings.values, readings.sigmas, readings.times, (True,) * count
    return TelemetryMessage(header, area, *columns, split)
