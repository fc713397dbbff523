"""Networks with phases in evaluations: gaps and errors node by node."""

from __future__ import annotations

import numpy as np
import pytest

from agents.messages.packing import Incarnation, StateMessage
from coordinator.lab.evaluation.comparison import compare
from coordinator.lab.evaluation.evaluation import estimate_centralised
from dsse_core.grid.network import Network
from scenarios.telemetry import make_telemetry
from tests.support.scenario_with_phases import make_scenario
from tests.support.shown_states import published_by

SCENARIO = make_scenario()
PARTITION = SCENARIO.partition


def show(area: str, network: Network, vm: np.ndarray, va: np.ndarray) -> StateMessage:
    """A state of ``area`` with voltages of its nodes."""
    sigmas = dict.fromkeys(("sigma_vm", "sigma_va"), (0.001,) * network.n_nodes)
    nodes = {"buses": network.node_buses, "phases": network.node_phases}
    return published_by(area, Incarnation(1, 1), vm=tuple(vm.tolist()), va=tuple(va.tolist()), **nodes, **sigmas)


def test_gaps_and_errors_are_those_of_the_nodes_and_each_node_counts_for_the_owner_of_its_bus():
    telemetry = make_telemetry(SCENARIO)
    centre = estimate_centralised(SCENARIO, telemetry).report
    assert centre is not None
    assert telemetry.truth is not None
    shift = {"west": 1e-3, "head": 1e-4}
    states = {}
    for area in PARTITION.areas:
        rows = PARTITION.rows_of_nodes[area.name]
        vm, va = centre.result.vm[rows], centre.result.va[rows]
        if area.name in shift:
            vm[area.network.node(671, "c")] += shift[area.name]
        states[area.name] = show(area.name, area.network, vm, va)
    found = compare(PARTITION, states, telemetry.truth, centre)
    assert found.gap.vm_pu == pytest.approx(1e-4)  # bus 671 is of head
    assert found.gap_at == "671.c"
    assert found.gap_of("west").vm_pu == pytest.approx(1e-3)
    assert found.gap_of("east").vm_pu == pytest.approx(0.0, abs=1e-12)
    assert found.centralised_error.vm_pu == pytest.approx(abs(centre.result.vm - telemetry.truth.vm).max())
    assert not np.isnan(found.sigma.vm).any()


def test_an_area_without_a_state_leaves_the_nodes_of_its_buses_unknown():
    unknown = compare(PARTITION, {}, None, None)
    assert np.isnan(unknown.decentralised.vm).sum() == SCENARIO.network.n_nodes
    assert (unknown.gap.vm_pu, unknown.gap_at, unknown.knows_truth) == (None, None, False)
