"""Many power flows at once: each row comes to what ``solve_power_flow`` finds alone, or fails as it does."""

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.power_flow.newton_raphson import solve_power_flow


@pytest.fixture(params=["newton", "sweep"])
def method(request) -> str:
    if request.param == "sweep":
        pytest.importorskip("numba", reason="sweeps need numba: pip install 'consensus-dsse[fast]'")
    return str(request.param)


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
def test_rows_of_a_batch_are_the_single_power_flows(case, method, threads):
    network = fed_by_the_substation(case("ieee33"))
    p, q = injections_of(network, 20)
    batch = solve_power_flow_batch(network, p, q, method=method, threads=threads)
    assert not batch.failures
    for k in range(20):
        alone = solve_power_flow(with_injections(network, p[k], q[k]), method=method)
        np.testing.assert_allclose(batch.vm[k], alone.vm, rtol=0, atol=1e-12)
        np.testing.assert_allclose(batch.va[k], alone.va, rtol=0, atol=1e-12)
        assert batch.iterations[k] == alone.iterations


def test_a_schedule_that_no_voltage_meets_does_not_disturb_its_neighbours(case, method):
    network = fed_by_the_substation(case("ieee33"))
    p, q = injections_of(network, 4)
    p[1] *= 100.0
    p[2, 5] = np.nan
    batch = solve_power_flow_batch(network, p, q, method=method, threads=2)
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
