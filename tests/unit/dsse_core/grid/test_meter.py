"""A meter, and the name that it has in every table."""

from __future__ import annotations

import pickle
from dataclasses import replace

from dsse_core.grid.measurement import MeasurementKind, Meter

FLOW = MeasurementKind.Q_FLOW


def test_tables_that_name_a_meter_do_not_each_hold_a_text_of_their_own():
    meter = Meter(FLOW, 3, "3-6")
    assert meter.id == "q_flow@3:3-6"
    assert meter.id is meter.id


def test_a_meter_that_has_been_named_is_the_same_meter():
    named, other = Meter(FLOW, 3, "3-6"), Meter(FLOW, 3, "3-6")
    assert named.id
    assert (named, hash(named), repr(named)) == (other, hash(other), repr(other))
    assert pickle.loads(pickle.dumps(named)) == other


def test_a_meter_made_of_another_does_not_keep_its_name():
    meter = Meter(FLOW, 3, "3-6")
    assert meter.id
    assert replace(meter, bus=6).id == "q_flow@6:3-6"
