"""A plant whose meters read at intervals says their last reading in between, with its time."""

from __future__ import annotations

from coordinator.lab.plant.held_readings import HeldReadings
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.reading_rules import KindRule

VM, INJECTION = Meter(MeasurementKind.VM, 1), Meter(MeasurementKind.P_INJECTION, 1)
RULES = {MeasurementKind.VM: KindRule(period_s=5.0)}


def scan(value: float, *meters: Meter) -> dict[str, tuple[Measurement, ...]]:
    return {"area1": tuple(Measurement(meter, value, 0.01) for meter in meters)}


def held_at(held: HeldReadings, value: float, now: float, *meters: Meter) -> dict[str, tuple[float, float]]:
    """Meter id -> what the plant says it has read, and when."""
    readings, times = held.take(scan(value, *meters), now)
    return {m.meter.id: (m.value, times[m.meter.id]) for m in readings["area1"]}


def test_a_meter_with_an_interval_reads_when_it_is_due_and_the_others_always():
    held = HeldReadings(RULES)
    assert held_at(held, 1.0, 11.0, VM, INJECTION) == {"vm@1": (1.0, 11.0), "p_injection@1": (1.0, 11.0)}
    assert held_at(held, 2.0, 14.0, VM, INJECTION) == {"vm@1": (1.0, 11.0), "p_injection@1": (2.0, 14.0)}
    assert held_at(held, 3.0, 15.0, VM, INJECTION) == {"vm@1": (3.0, 15.0), "p_injection@1": (3.0, 15.0)}


def test_where_a_reading_is_lost_the_last_one_stays_if_there_is_an_interval():
    held = HeldReadings(RULES)
    held_at(held, 1.0, 10.0, VM, INJECTION)
    assert held_at(held, 2.0, 15.0) == {"vm@1": (1.0, 10.0)}
    assert held_at(held, 3.0, 16.0, VM) == {"vm@1": (1.0, 10.0)}, "it reads again when it is due"
    assert held_at(held, 4.0, 20.0, VM) == {"vm@1": (4.0, 20.0)}
