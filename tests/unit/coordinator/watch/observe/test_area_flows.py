"""What flows in an area follows from its state and its file alone, and is what the whole network has there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import StateMessage
from coordinator.watch.observe.area_flows import make_area_flows
from dsse_core.errors import InvalidInputError
from dsse_core.grid.partition import Area
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import Results, results_of_power_flow
from scenarios.scenario import load_scenario
from tests.support.shown_states import a_state


@pytest.fixture(scope="module")
def solved() -> tuple[Area, StateMessage, Results]:
    """area1 of ieee33, what it would say of the power flow, its buses in another order, and the whole."""
    scenario = load_scenario("ieee33")
    flow, area = solve_power_flow(scenario.network), scenario.partition.area("area1")
    buses = tuple(bus.id for bus in reversed(area.network.buses))
    rows = [scenario.network.row[bus] for bus in buses]
    vm, va = tuple(flow.vm[rows].tolist()), tuple(flow.va[rows].tolist())
    sigma = tuple(1e-3 * np.arange(1, len(buses) + 1))
    state = a_state(buses=buses, vm=vm, va=va, sigma_vm=sigma, sigma_va=sigma)
    return area, state, results_of_power_flow(flow)


def test_flows_of_an_area_are_those_of_the_whole_network(solved):
    area, state, whole = solved
    buses, branches = make_area_flows(area, state)
    rows = [whole.branches.branch.index(branch) for branch in branches.branch]
    for column in ("p_from_kw", "q_to_kvar", "i_from_a", "i_to_a", "loss_kw"):
        np.testing.assert_allclose(branches[column], whole.branches[column][rows], rtol=0, atol=1e-6)
    assert buses.columns == (*whole.buses.columns, "injection_problem")
    assert branches.columns == whole.branches.columns
    at = [whole.buses.bus.tolist().index(bus) for bus in buses.bus.tolist()]
    np.testing.assert_array_equal(buses.vm_kv, whole.buses.vm_kv[at])
    inner = ~np.isin(buses.bus, area.boundary_buses)
    np.testing.assert_allclose(buses.p_kw[inner], whole.buses.p_kw[at][inner], rtol=0, atol=1e-6)
    assert buses.sigma_vm_pu[0] == state.sigma_vm[-1]  # the first bus is the last that the state names


def test_angles_that_count_from_nowhere_are_not_shown_and_flows_are(solved):
    area, state, _ = solved
    turned = replace(state, va=tuple(angle + 1.0 for angle in state.va), referenced=False)
    buses, branches = make_area_flows(area, turned)
    assert np.isnan(buses.va_deg).all()
    assert np.isnan(buses.sigma_va_deg).all()
    np.testing.assert_allclose(branches.p_from_kw, make_area_flows(area, state)[1].p_from_kw, rtol=0, atol=1e-8)
    assert not math.isnan(buses.vm_kv[0])


def test_a_file_of_another_system_is_named_with_the_buses_that_differ(solved):
    area, state, _ = solved
    other = a_state(
        buses=(*state.buses[1:], 999), **{k: getattr(state, k) for k in ("vm", "va", "sigma_vm", "sigma_va")}
    )
    with pytest.raises(InvalidInputError, match=rf"differ in bus {state.buses[0]}, 999"):
        make_area_flows(area, other)
