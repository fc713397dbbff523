"""A meter, and the name that it has in every table."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.meter_table import (
    KINDS,
    NO_BRANCH,
    UNKNOWN,
    list_ids,
    make_meters,
    number_meters,
    tabulate_meters,
)
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network

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


@pytest.mark.parametrize("in_service", [True, False])
def test_a_meter_on_a_branch_that_is_not_there_is_not_the_meter_at_its_bus(in_service: bool):
    """As columns and as objects: a readings file may name ``vm@1:9-9``."""
    buses = (Bus(1, 20.0), Bus(2, 20.0))
    branches = (Branch("1-2", 1, 2, 0.1, 0.1), Branch("2-1", 2, 1, 0.1, 0.1, in_service=in_service))
    network = Network("two", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    kind, bus = np.full(2, KINDS.index(MeasurementKind.VM)), np.ones(2, dtype=np.int64)
    meters = make_meters(network, kind, bus, np.array([NO_BRANCH, UNKNOWN]))
    assert list_ids(meters) == [meter.id for meter in meters] == ["vm@1", "vm@1:?"]
    assert len(set(number_meters(network, meters).tolist())) == 2
    assert tabulate_meters(network, meters).branch.tolist() == [NO_BRANCH, UNKNOWN]
    assert tabulate_meters(network, tuple(meters)).branch.tolist() == [NO_BRANCH, UNKNOWN]
    with pytest.raises(InvalidInputError, match=r"vm@1:\?: a vm meter stands at a bus, not on a branch"):
        build_estimation_plan(network, meters, backend="sparse")
