"""A meter, and the name that it has in every table."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.meter_table import (
    KINDS,
    NO_BRANCH,
    UNKNOWN,
    each_fits,
    join_meters,
    list_columns,
    list_ids,
    make_meters,
    number_meters,
    tabulate_meters,
)
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import PHASES
from tests.support.phases import make_feeder

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


def test_meters_of_phases_as_columns_are_those_of_objects():
    feeder, a, b = make_feeder(), *map(PHASES.index, "ab")
    kind = np.array([KINDS.index(name) for name in (MeasurementKind.VM, MeasurementKind.VM, FLOW, FLOW)])
    bus, branch = np.array([671, 671, 632, 632]), np.array([NO_BRANCH, NO_BRANCH, 2, 1])
    phases = np.array([[a, a, b, 0], [UNKNOWN, b, UNKNOWN, UNKNOWN]])
    meters = make_meters(feeder, kind, bus, branch, phases=phases)
    objects = tuple(meters)
    ids = ["vm@671.a", "vm@671.ab", "q_flow@632.b:645-632", "q_flow@632:632-671"]
    assert list_ids(meters) == [meter.id for meter in objects] == ids
    assert list_columns(meters) == list_columns(objects)
    for name in ("kind", "bus", "branch", "phases", "node", "other", "port"):
        columns, of_objects = (getattr(tabulate_meters(feeder, given), name) for given in (meters, objects))
        assert columns.tolist() == of_objects.tolist(), name
    assert join_meters(feeder, [meters, meters]) == objects + objects
    assert each_fits(feeder, meters.take(np.arange(3)))


@pytest.mark.parametrize(
    ("text", "bus", "branch", "phases"),
    [
        ("vm@645.a", 645, NO_BRANCH, ("a", "")),
        ("vm@671.aa", 671, NO_BRANCH, ("a", "a")),
        ("vm@645.bc", 645, NO_BRANCH, ("b", "c")),
        ("q_flow@632.a:645-632", 632, 2, ("a", "")),
        ("q_flow@632.bc:645-632", 632, 2, ("b", "c")),
    ],
)
def test_a_meter_fits_where_its_phases_are_there(text: str, bus: int, branch: int, phases: tuple[str, str]):
    feeder, kind = make_feeder(), MeasurementKind(text.partition("@")[0])
    columns = [np.array([value]) for value in (KINDS.index(kind), bus, branch)]
    pair = np.array([[PHASES.index(phase) if phase else UNKNOWN] for phase in phases])
    meters = make_meters(feeder, *columns, phases=pair)
    assert list_ids(meters) == [text]
    assert each_fits(feeder, meters) == (not list(find_meter_problems(feeder, meters))) == (text == "vm@645.bc")
