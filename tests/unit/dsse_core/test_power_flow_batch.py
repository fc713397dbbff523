"""Many power flows at once: each row comes to what ``solve_power_flow`` finds alone, or fails as it does."""

import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow import batch as batch_module
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.power_flow.plan import build_power_flow_plan


@pytest.fixture(params=["newton", "sweep", "compiled"])
def solve(request, monkeypatch):
    """Batches by method, and sweeps compiled or not; and the method."""
    monkeypatch.delitem(sys.modules, batch_module.COMPILED, raising=False)
    method = "newton" if request.param == "newton" else "sweep"
    if request.param == "compiled":
        pytest.importorskip("numba", reason="compiled sweeps need numba: pip install 'consensus-dsse[fast]'")
        return lambda network, *rest, **more: solve_power_flow_batch(
            build_power_flow_plan(network, method=method), *rest, **more
        ), method
    return partial(solve_power_flow_batch, method=method), method


def fed_by_the_substation(network):
    """``network`` without any other source: sweeps serve where no other bus holds its voltage."""
    return replace(network, generators=(network.slack,))


def injections_of(network, n_row, seed=0):
    """Schedules between 0 and twice that of the network, (n_row, n_bus)."""
    scheduled = np.array([network.scheduled_injection(bus.id) for bus in network.buses])
    level = np.random.default_rng(seed).uniform(0, 2, (n_row, len(scheduled)))
    return scheduled.real * level, scheduled.imag * level


def with_injections(network, p, q):
    """``network`` with these injections alone."""
    buses = tuple(replace(bus, p_load=-float(p[k]), q_load=-float(q[k])) for k, bus in enumerate(network.buses))
    return replace(network, buses=buses, generators=(replace(network.slack, p=0.0, q=0.0),))


@pytest.mark.parametrize("threads", [1, 2])
def test_rows_of_a_batch_are_the_single_power_flows(case, solve, threads):
    solve_batch, method = solve
    network = fed_by_the_substation(case("ieee33"))
    p, q = injections_of(network, 20)
    batch = solve_batch(network, p, q, threads=threads)
    assert not batch.failures
    for k in range(20):
        alone = solve_power_flow(with_injections(network, p[k], q[k]), method=method)
        np.testing.assert_allclose(batch.vm[k], alone.vm, rtol=0, atol=1e-12)
        np.testing.assert_allclose(batch.va[k], alone.va, rtol=0, atol=1e-12)
        assert abs(batch.iterations[k] - alone.iterations) <= 1


def test_a_schedule_that_no_voltage_meets_does_not_disturb_its_neighbours(case, solve):
    solve_batch, method = solve
    network = fed_by_the_substation(case("ieee33"))
    p, q = injections_of(network, 4)
    p[1] *= 100.0
    p[2, 5] = np.nan
    batch = solve_batch(network, p, q, threads=2)
    with pytest.raises(PowerFlowDivergedError) as alone:
        solve_power_flow(with_injections(network, p[1], q[1]), method=method)
    assert batch.failures[1] == str(alone.value)
    assert "finite" in batch.failures[2]
    assert list(batch.failures) == [1, 2]
    for k in (0, 3):
        alone = solve_power_flow(with_injections(network, p[k], q[k]), method=method)
        np.testing.assert_allclose(batch.vm[k], alone.vm, rtol=0, atol=1e-12)


def test_loops_and_held_voltages_are_served_by_newton():
    network = Network(
        name="loop",
        base_mva=1.0,
        buses=tuple(Bus(i, 20.0, p_load=0.1) for i in range(1, 5)),
        branches=tuple(Branch(f"b{i}", i, i % 4 + 1, 0.01, 0.02) for i in range(1, 5)),
        generators=(Generator(1, Control.SLACK, vm=1.01), Generator(3, Control.VOLTAGE, p=0.2, vm=1.02)),
    )
    p, q = injections_of(network, 3)
    batch = solve_power_flow_batch(network, p, q)
    assert not batch.failures
    np.testing.assert_allclose(batch.vm[:, 2], 1.02, rtol=0, atol=1e-12)


def test_shapes_that_do_not_fit_are_rejected(case):
    with pytest.raises(InvalidInputError, match="p and q have shapes"):
        solve_power_flow_batch(case("ieee33"), np.zeros((2, 3)), np.zeros((2, 3)))


def test_sweeps_of_a_batch_are_compiled_for_a_kept_plan_many_rows_or_where_they_are_loaded(case, monkeypatch):
    monkeypatch.delitem(sys.modules, batch_module.COMPILED, raising=False)
    plan = build_power_flow_plan(fed_by_the_substation(case("ieee33")))
    swept = []
    monkeypatch.setattr(batch_module, "find_obstacle", lambda what: None)
    monkeypatch.setattr(batch_module._Rows, "by_sweeps", lambda rows: swept.append(len(rows.p)) or rows.one_by_one())
    few, many = (injections_of(plan.network, n_row) for n_row in (2, 3))
    monkeypatch.setattr(batch_module, "FEWEST_BUSES_OF_COMPILED", 3 * (33 + batch_module.BUSES_OF_A_ROW))
    solve_power_flow_batch(plan.network, *few, threads=1)
    assert swept == []
    solve_power_flow_batch(plan.network, *many, threads=1)
    solve_power_flow_batch(plan, *few, threads=1)
    monkeypatch.setitem(sys.modules, batch_module.COMPILED, None)
    solve_power_flow_batch(plan.network, *few, threads=1)
    assert swept == [3, 2, 2]
