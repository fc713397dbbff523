"""A network rejects everything that it cannot mean, all of it at once."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import carry_currents
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.primitives import build_line
from scenarios.scenario import load_scenario


def test_every_problem_is_reported_at_once():
    with pytest.raises(InvalidInputError) as caught:
        Network(
            "wrong",
            -1.0,
            (Bus(1, 10.0), Bus(1, 10.0), Bus(2, 0.0, p_load=math.nan), Bus(3, 10.0)),
            (
                Branch("a", 1, 2, 0.0, 0.0),
                Branch("a", 1, 9, 0.1, 0.1),
                Branch("b", 3, 3, 0.1, math.inf),
                Branch("c", 2, 3, 0.1, 0.1, tap=0.0),
                Branch("", 2, 3, 0.1, 0.1),
            ),
            (
                Generator(1, Control.SLACK),
                Generator(2, Control.SLACK, vm=-1.0),
                Generator(9, Control.POWER, p=math.nan),
                Generator(3, Control.VOLTAGE, vm=1.0),
                Generator(3, Control.VOLTAGE, vm=1.02),
            ),
        )
    text = str(caught.value)
    for expected in (
        "network 'wrong': 16 problems",
        "base_mva is -1.0",
        "bus 1 is defined more than once",
        "branch a is defined more than once",
        "bus 2: load or shunt is not a finite number",
        "bus 2: base_kv is 0.0",
        "branch a has no impedance",
        "branch a ends at bus 9",
        "branch b joins bus 3 to itself",
        "branch b: r, x, b, g, tap or shift is not a finite number",
        "branch c: tap is 0.0",
        "a branch from bus 2 to bus 3 has an empty id",
        "generator at bus 2: vm is -1.0",
        "a generator stands at bus 9",
        "generator at bus 9: p, q, vm or va is not a finite number",
        "generators at bus 3 hold different voltages, vm [1.0, 1.02]",
        "buses 1, 2 are all slack",
    ):
        assert expected in text


def test_a_network_without_a_bus_is_rejected():
    with pytest.raises(InvalidInputError, match="it has no bus"):
        Network("empty", 1.0, (), ())


def test_a_slack_and_a_generator_at_one_bus_may_hold_the_same_voltage():
    Network("ok", 1.0, (Bus(1, 10.0),), (), (Generator(1, Control.SLACK), Generator(1, Control.VOLTAGE)))


def test_an_id_is_not_a_row(meshed):
    assert meshed.row[10] == 0
    assert meshed.bus(10).id == 10
    assert meshed.branch("5-4").other_end(5) == 4
    assert meshed.slack.bus == 10


def test_a_branch_out_of_service_joins_nothing(meshed):
    assert "6-2" not in {b.id for b in meshed.active_branches}
    assert "6-2" not in {b.id for b in meshed.branches_at[6]}
    assert meshed.find_unreached_buses(10) == ()


def test_the_scheduled_injection_is_generation_minus_load(meshed):
    assert meshed.scheduled_injection(5) == pytest.approx(-0.20 - 0.07j)


def test_a_branch_is_none_below_a_share_of_the_median_of_those_in_service():
    impedances = {"a": 1.0, "b": 1.1e-6, "c": 0.9e-6, "d": 2.0, "e": 1.0}
    branches = [Branch(name, i, i + 1, 0.0, x) for i, (name, x) in enumerate(impedances.items())]
    branches.append(Branch("open", 0, 2, 0.0, 1e-9, in_service=False))
    network = Network("n", 1.0, tuple(Bus(i, 1.0) for i in range(6)), tuple(branches))
    assert network.median_impedance == 1.0
    assert [branch.id for branch in network.find_zero_impedances()] == ["c"]


def test_a_network_without_branches_has_none_without_impedance():
    assert Network("one bus", 1.0, (Bus(1, 1.0),), ()).find_zero_impedances() == ()


def test_a_node_at_open_branches_only_carries_no_load():
    line = build_line("a", np.array([[0.1 + 0.1j]]), np.zeros((1, 1)))
    branches = tuple(Branch(f"{k}-{k + 1}", k, k + 1, 0.1, 0.1, in_service=k < 2, primitive=line) for k in (1, 2))
    network = Network("tie", 3.0, tuple(Bus(bus, 1.0, phases="a") for bus in (1, 2, 3)), branches)
    assert carry_currents(network, network.nodes_at(1)).round(12).tolist() == [[1, 1, 0]]


@pytest.mark.parametrize("name", ["ieee33", "ieee13"])
def test_islands_without_a_branch_are_those_where_it_is_open(name):
    network = load_scenario(name).network
    for row, branch in enumerate(network.branches):
        branches = (*network.branches[:row], replace(branch, in_service=False), *network.branches[row + 1 :])
        without = replace(network, branches=branches).table.node_island
        np.testing.assert_array_equal(network.table.find_islands(row), without)


def test_a_branch_is_found_by_its_id_else_by_its_name_and_none_by_no_name():
    network = Network(
        "n", 1.0, (Bus(1, 1.0), Bus(2, 1.0)), (Branch("a", 1, 2, 0.1, 0.1, name="Cable"), Branch("b", 1, 2, 0.1, 0.1))
    )
    assert [network.id_of(text) for text in ("a", "cable", "", "c")] == ["a", "a", "", "c"]
