"""Networks and meters of columns: the same grid, and a plan of it visits no object."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, SOURCES, make_meters
from dsse_core.grid.network import Branch, Bus, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow

Kind = MeasurementKind
BUS_COLUMNS = ("id", "base_kv", "p_load", "q_load", "g_shunt", "b_shunt")
BRANCH_COLUMNS = ("from_bus", "to_bus", "r", "x", "b", "tap", "shift", "in_service", "g")


def in_columns(network: Network) -> Network:
    buses = {name: np.array([getattr(bus, name) for bus in network.buses]) for name in BUS_COLUMNS}
    branches = {name: np.array([getattr(branch, name) for branch in network.branches]) for name in BRANCH_COLUMNS}
    branches["id"] = [branch.id for branch in network.branches]
    return replace(network, buses=Records(Bus, buses), branches=Records(Branch, branches))


def meters_in_columns(network, meters):
    row = {branch.id: k for k, branch in enumerate(network.branches)}
    return make_meters(
        network,
        np.array([KINDS.index(m.kind) for m in meters]),
        np.array([m.bus for m in meters]),
        np.array([NO_BRANCH if m.branch is None else row[m.branch] for m in meters]),
        np.array([SOURCES.index(m.source) for m in meters]),
    )


def meters_of(network):
    powers = (Kind.P_INJECTION, Kind.Q_INJECTION)
    passive = [bus.id for bus in network.buses if bus.p_load == bus.q_load == 0][1:]
    found = [Meter(Kind.VM, bus.id) for bus in network.buses]
    for bus in network.buses:
        source = Source.VIRTUAL if bus.id in passive else Source.TELEMETERED
        found += [Meter(kind, bus.id, source=source) for kind in powers]
    return found + [Meter(k, b.from_bus, b.id) for b in network.active_branches for k in (Kind.P_FLOW, Kind.CURRENT)]


def test_a_plan_of_columns_makes_no_object(case):
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    network = case("ieee33")
    meters = meters_of(network)
    tabled = in_columns(network)
    plan = build_estimation_plan(tabled, meters_in_columns(network, meters), backend="radial")
    made = [records for records in (tabled.buses, tabled.branches, plan.meters) if "objects" in vars(records)]
    assert not made
    expected = build_estimation_plan(network, meters, backend="radial")
    for name in ("order", "parent", "admittance", "slot", "start"):
        np.testing.assert_array_equal(getattr(plan.radial, name), getattr(expected.radial, name))
    np.testing.assert_array_equal(plan.virtual, expected.virtual)


def test_columns_give_the_estimate_of_objects(rich, backend):
    kinds = (Kind.VM, Kind.P_INJECTION, Kind.Q_INJECTION)
    meters = [Meter(kind, bus.id) for bus in rich.buses for kind in kinds]
    tabled = in_columns(rich)
    values = solve_power_flow(tabled).read_all(meters)
    sigmas = np.full(len(meters), 0.01)
    plans = [
        build_estimation_plan(rich, meters, backend=backend),
        build_estimation_plan(tabled, meters_in_columns(tabled, meters), backend=backend),
    ]
    one, two = (estimate_with_plan(plan, values, sigmas) for plan in plans)
    np.testing.assert_array_equal(one.vm, two.vm)
    np.testing.assert_array_equal(one.va, two.va)
    assert one.objective == two.objective


def test_a_network_of_columns_equals_that_of_objects(rich):
    tabled = in_columns(rich)
    named = tuple(replace(bus, name="") for bus in rich.buses)
    assert tabled.buses == named
    assert tabled.branches == rich.branches
    assert tabled.branches[0] == rich.branches[0]
    assert list(tabled.buses)[1:3] == list(tabled.buses[1:3])


def test_problems_of_columns_are_named_as_those_of_objects(case):
    network = case("ieee33")
    tabled = in_columns(network)
    columns = dict(tabled.branches.columns)
    columns["tap"] = columns["tap"].copy()
    columns["tap"][3] = -1.0
    with pytest.raises(InvalidInputError, match=f"branch {network.branches[3].id}: tap is -1.0"):
        replace(tabled, branches=Records(Branch, columns))


def test_a_meter_of_columns_that_does_not_fit_is_named(case, backend):
    network = case("ieee33")
    meters = make_meters(network, np.array([0, 0]), np.array([1, 99]), np.array([NO_BRANCH, NO_BRANCH]))
    with pytest.raises(InvalidInputError, match="meter vm@99: bus 99 is not in network"):
        build_estimation_plan(network, meters, backend=backend)


def test_columns_of_different_length_are_rejected():
    with pytest.raises(ValueError, match="differ in length"):
        Records(Bus, {"id": np.arange(3), "base_kv": np.ones(2)})


def test_a_bus_number_that_no_column_of_64_bits_holds_can_be_named():
    buses = (Bus(10**30, 20.0), Bus(1, 20.0), Bus(10**30, 20.0))
    assert Network(name="x", base_mva=1.0, buses=buses[:2], branches=()).row == {10**30: 0, 1: 1}
    with pytest.raises(InvalidInputError, match=f"bus {10**30} is defined more than once"):
        Network(name="x", base_mva=1.0, buses=buses, branches=())


def test_columns_are_sent_to_another_process_without_their_objects(meshed):
    tabled = in_columns(meshed)
    meters = meters_in_columns(tabled, meters_of(meshed))
    assert tabled.buses.objects
    assert meters.objects
    network, again = pickle.loads(pickle.dumps((tabled, meters)))
    assert "objects" not in vars(network.buses)
    assert "objects" not in vars(again)
    assert network == tabled
    assert again == meters
