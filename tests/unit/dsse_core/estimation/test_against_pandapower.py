"""pandapower, an independent implementation, agrees on the 33-bus feeder to 1e-6: power flow and WLS."""

import numpy as np
import pytest

from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Control
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.pandapower_tables import ONE_WORKER, LoadedLate

pandapower = LoadedLate("pandapower")
Kind = MeasurementKind
pytestmark = [
    ONE_WORKER,
    pytest.mark.filterwarnings("ignore:.*SettingWithCopy.*", "ignore:\\nA value is trying to be set on a copy"),
    pytest.mark.slow,
]


@pytest.fixture
def feeder(case):
    return case("ieee33")


def pandapower_net(network):
    net = pandapower.create_empty_network(sn_mva=network.base_mva)
    for bus in network.buses:
        pandapower.create_bus(net, bus.base_kv, index=bus.id)
        pandapower.create_load(net, bus.id, bus.p_load * network.base_mva, bus.q_load * network.base_mva)
    for branch in network.active_branches:
        z_base = network.bus(branch.from_bus).base_kv ** 2 / network.base_mva
        pandapower.create_line_from_parameters(
            net, branch.from_bus, branch.to_bus, 1.0, branch.r * z_base, branch.x * z_base, 0.0, 1.0, name=branch.id
        )
    for g in network.generators:
        if g.control is Control.SLACK:
            pandapower.create_ext_grid(net, g.bus, vm_pu=g.vm)
        else:
            pandapower.create_gen(net, g.bus, g.p * network.base_mva, vm_pu=g.vm)
    return net


def test_the_power_flows_agree(feeder):
    net = pandapower_net(feeder)
    pandapower.runpp(net, tolerance_mva=1e-9, numba=False)
    result = solve_power_flow(feeder)
    np.testing.assert_allclose(result.vm, net.res_bus.vm_pu, atol=1e-6)
    np.testing.assert_allclose(result.va, np.radians(net.res_bus.va_degree), atol=1e-6)


def test_the_estimates_of_the_same_noisy_measurements_agree(feeder, meters_of, read):
    from pandapower.estimation import estimate

    meters = [Meter(Kind.VM, bus) for bus in (1, 16, 22, 30)]
    meters += [Meter(k, b.from_bus, b.id) for b in feeder.active_branches for k in (Kind.P_FLOW, Kind.Q_FLOW)]
    meters += meters_of(feeder, Kind.P_INJECTION, Kind.Q_INJECTION)
    noisy = read(solve_power_flow(feeder), meters, sigma=0.002, noise=np.random.default_rng(8))

    net = pandapower_net(feeder)
    line = dict(zip(net.line.name, net.line.index, strict=True))
    for m in noisy:
        mva = feeder.base_mva
        match m.meter.kind:
            case Kind.VM:
                pandapower.create_measurement(net, "v", "bus", m.value, m.sigma, m.meter.bus)
            case Kind.P_INJECTION | Kind.Q_INJECTION:  # pandapower counts consumption positive
                pandapower.create_measurement(net, m.meter.kind[0], "bus", -m.value * mva, m.sigma * mva, m.meter.bus)
            case _:
                pandapower.create_measurement(
                    net, m.meter.kind[0], "line", m.value * mva, m.sigma * mva, line[m.meter.branch], side="from"
                )
    assert estimate(net, init="flat", tolerance=1e-9, zero_injection=None)["success"]

    result = estimate_state(feeder, noisy, tolerance=1e-9)
    np.testing.assert_allclose(result.vm, net.res_bus_est.vm_pu, atol=1e-6)
    np.testing.assert_allclose(result.va, np.radians(net.res_bus_est.va_degree), atol=1e-6)
