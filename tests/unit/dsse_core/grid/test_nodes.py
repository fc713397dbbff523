"""Nodes and ports: networks whose buses have phases, built in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive

Z = np.array([[0.0346 + 0.1018j, 0.0156 + 0.0502j, 0.0158 + 0.0424j]] * 3)  # of ieee13's configuration 601, p.u.
Z = np.triu(Z, 1) + np.triu(Z, 1).T + np.diag([0.0346 + 0.1018j, 0.0337 + 0.1048j, 0.0341 + 0.1035j])


def coupled_line(name: str, ends: tuple[int, int], phases: str, length: float = 1.0) -> Branch:
    """A line of ``phases`` whose conductors are coupled, with some charging."""
    chosen = ["abc".index(phase) for phase in phases]
    yi, k = np.linalg.inv(length * Z[np.ix_(chosen, chosen)]), len(chosen)
    charging = np.kron(np.eye(2), 1e-4j * (np.eye(k) - 0.1))
    primitive = Primitive(phases, phases, np.kron([[1, -1], [-1, 1]], yi) + charging, charging)
    return Branch(name, *ends, r=0.03 * length, x=0.1 * length, primitive=primitive)


@pytest.fixture
def feeder() -> Network:
    """A source, a coupled line of three phases, and a lateral of two."""
    buses = tuple(Bus(k, 4.16, phases=phases) for k, phases in ((650, "abc"), (632, "abc"), (645, "bc")))
    lines = coupled_line("650-632", (650, 632), "abc", 0.4), coupled_line("632-645", (632, 645), "bc", 0.1)
    return Network("feeder", 5.0, buses, lines, (Generator(650, Control.SLACK),))


def test_a_bus_has_a_node_for_each_phase_and_a_branch_a_port_at_each_of_them(feeder: Network) -> None:
    table = feeder.table
    assert feeder.n_nodes == 8
    assert [feeder.node(645, phase) for phase in ("a", "b", "c")] == [-1, 6, 7]
    assert feeder.nodes_at(632).tolist() == [3, 4, 5]
    assert table.port_node.tolist() == [0, 1, 2, 4, 5, 3, 4, 5, 6, 7]


def test_currents_at_nodes_are_the_sums_of_the_currents_into_their_ports(feeder: Network) -> None:
    rng = np.random.default_rng(3)
    v, stacked = rng.normal(size=8) + 1j * rng.normal(size=8), build_admittance(feeder).stacked
    i = stacked @ v
    expected = np.zeros(8, dtype=complex)
    np.add.at(expected, feeder.table.port_node, i[8:])
    assert i[:8] == pytest.approx(expected, rel=1e-12)
    first = feeder.branches[0].primitive
    assert first is not None
    assert i[8:][[0, 1, 2, 5, 6, 7]] == pytest.approx(first.y @ v[:6], rel=1e-12)


def test_without_load_no_current_flows_and_the_phases_are_a_third_of_a_turn_apart(feeder: Network) -> None:
    vm, va = flat_start(feeder, 650)
    assert vm == pytest.approx(np.ones(8), abs=1e-12)
    assert np.degrees(va) == pytest.approx([0, -120, 120, 0, -120, 120, -120, 120], abs=1e-9)
    assert abs(build_admittance(feeder, with_shunts=False).ybus @ (vm * np.exp(1j * va))).max() < 1e-12


def test_a_balanced_network_has_one_node_per_bus_in_the_same_order(meshed: Network) -> None:
    table = meshed.table
    assert table.nodes.item.tolist() == list(range(len(table.bus_id)))
    assert table.port_node.tolist() == [*table.f.tolist(), *table.t.tolist()]


@pytest.mark.parametrize(
    ("phases", "line", "problem"),
    [
        ("", "abc", "bus 645 has no phases, and others have"),
        ("xy", "bc", "bus 645: phases is 'xy'; give some of a, b, c, s1, s2"),
        ("cb", "bc", "bus 645: phases is 'cb'"),
        ("b", "bc", "branch 632-645 has phase c at bus 645, which lacks it"),
        ("bc", "", "branch 632-645 joins buses with phases; give it admittances over its ports"),
    ],
)
def test_phases_that_do_not_fit_are_refused_by_name(feeder: Network, phases: str, line: str, problem: str) -> None:
    bus = replace(feeder.buses[2], phases=phases)
    branch = coupled_line("632-645", (632, 645), line) if line else replace(feeder.branches[1], primitive=None)
    with pytest.raises(InvalidInputError, match=problem):
        replace(feeder, buses=(*feeder.buses[:2], bus), branches=(feeder.branches[0], branch))
