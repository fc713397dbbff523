"""Statuses of switches: from orders and gateways, of which two that contradict each other leave a switch as it was."""

from __future__ import annotations

import math

from agents.messages.packing import Header, Incarnation, TelemetryMessage
from agents.protocol.statuses import Statuses
from dsse_core.reading_rules import ReadingRules

RULES = ReadingRules(gateways={"plant": "all", "rtu": ("status@S1",)})


def read(gateway: str, sequence: int, time: float | None = None, **values: float) -> TelemetryMessage:
    """The statuses of switches as readings, nan: marked as invalid."""
    header, n = Header("run", gateway, Incarnation(1, 1), sequence, sequence, 100.0), len(values)
    numbers = tuple(0.0 if math.isnan(value) else value for value in values.values())
    times, valid = (sequence if time is None else time,) * n, tuple(not math.isnan(v) for v in values.values())
    return TelemetryMessage(header, "area1", tuple(f"status@{s}" for s in values), numbers, (0.0,) * n, times, valid)


def test_the_newest_status_of_the_gateway_that_may_read_a_switch_holds():
    statuses = Statuses({"S1": True, "S2": True}, RULES, 1.0)
    assert statuses.take(read("plant", 2, S1=0, S9=0), 100.0)
    assert not statuses.take(read("plant", 3, S1=0), 100.0)
    assert not statuses.take(read("plant", 1, S1=1), 100.0)
    assert not statuses.take(read("plant", 4, 200.0, S1=1), 100.0), "of the future"
    assert not statuses.take(read("rtu", 5, S2=0), 100.0), "not that of this gateway"
    assert statuses.closed == {"S1": False, "S2": True}
    assert not statuses.unknown


def test_two_sources_that_contradict_each_other_leave_a_switch_as_it_was_and_are_named():
    statuses = Statuses({"S1": True}, RULES, 1.0)
    statuses.take(read("plant", 1, S1=1), 100.0)
    assert not statuses.follow({"S1": False, "S2": False})
    assert statuses.closed == {"S1": True}
    assert statuses.unknown == {"S1": "gateway plant reads closed, the operator has ordered open"}
    assert statuses.take(read("plant", 2, S1=math.nan), 100.0), "an order holds where the gateway does not know"
    assert statuses.closed == {"S1": False}
    assert not statuses.take(read("rtu", 1, S1=1), 100.0)
    assert statuses.unknown == {
        "S1": "gateway plant reads unknown, gateway rtu reads closed, the operator has ordered open"
    }
    assert not statuses.take(read("rtu", 2, S1=0), 100.0)
    assert not statuses.unknown


def test_a_status_that_nobody_knows_begins_as_it_was():
    statuses = Statuses({"S1": False}, RULES, 1.0)
    assert not statuses.take(read("plant", 1, S1=0.5), 100.0)
    assert statuses.closed == {"S1": False}
    assert statuses.unknown == {"S1": "gateway plant reads unknown"}
