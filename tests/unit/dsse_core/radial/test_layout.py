"""What the compiled layout of a tree holds is what the tables of the network say."""

from __future__ import annotations

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.columns import Rows
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.meter_table import KINDS, make_meters
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network

pytest.importorskip("numba")
from dsse_core.radial.plan import RadialPlan, build_radial_plan


def make_tapped_network() -> Network:
    """Bus ids with gaps, taps and shifts in both directions, a shunt, and an open branch before the others."""
    buses = (Bus(5, 20.0), Bus(9, 10.0), Bus(7, 0.4, g_shunt=0.01, b_shunt=0.02), Bus(30, 10.0))
    branches = (
        Branch("open", 9, 30, r=0.1, x=0.1, in_service=False),
        Branch("down", 5, 9, r=0.01, x=0.04, b=0.02, tap=1.05, shift=0.3),
        Branch("up", 7, 9, r=0.02, x=0.05, g=0.01, tap=0.95, shift=-0.2),
        Branch("line", 9, 30, r=0.03, x=0.02, b=0.01),
    )
    return Network("tapped", 1.0, buses, branches, (Generator(5, Control.SLACK, va=0.1),))


def plan_of(network: Network, branch: str) -> RadialPlan:
    """Voltmeters everywhere, power where they leave the state open; P at the end of ``branch`` comes first."""
    row = {b.id: k for k, b in enumerate(network.branches)}
    places = [(MeasurementKind.P_FLOW, network.branch(branch).from_bus, row[branch])]
    places += [(MeasurementKind.VM, bus.id, -2) for bus in network.buses]
    places += [
        (k, bus.id, -2) for bus in network.buses for k in (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    ]
    kind, bus, branch_row = (np.array(column) for column in zip(*places, strict=True))
    meters = make_meters(
        network, np.array([KINDS.index(k) for k in kind]), bus.astype(np.int64), branch_row.astype(np.int64)
    )
    plan = build_radial_plan(network, meters)
    assert isinstance(plan, RadialPlan)
    return plan


def test_admittances_of_the_tree_are_those_of_the_network_where_a_branch_is_open() -> None:
    network = make_tapped_network()
    plan = plan_of(network, "up")
    ybus, Y = build_admittance(network).ybus.toarray(), plan.admittance.conj()
    below, above = plan.order[1:], plan.order[plan.parent[1:]]
    np.testing.assert_allclose(Y[1:, 1], ybus[below, above], rtol=1e-14)
    np.testing.assert_allclose(Y[1:, 3], ybus[above, below], rtol=1e-14)
    own = Y[:, 7] + np.append(0, Y[1:, 0])
    np.add.at(own, plan.parent[1:], Y[1:, 2])
    np.testing.assert_allclose(own, ybus.diagonal()[plan.order], rtol=1e-14)


def test_the_start_follows_taps_and_shifts_in_both_directions() -> None:
    network = make_tapped_network()
    plan = plan_of(network, "down")
    vm, va = flat_start(network, 5)
    np.testing.assert_allclose(plan.start, (vm * np.exp(1j * (va + 0.1)))[plan.order], rtol=1e-14)
    np.testing.assert_allclose(plan.start_va, (va + 0.1)[plan.order], rtol=1e-14)


def test_a_meter_on_an_open_branch_has_no_slot() -> None:
    with pytest.raises(InvalidInputError, match="branch open is out of service"):
        plan_of(make_tapped_network(), "open")


@pytest.mark.parametrize("ids", [[5, 9, 7, 30], [4, 5, 6, 7]])
def test_the_row_of_an_unknown_id_is_none(ids: list[int]) -> None:
    rows = Rows(np.array(ids))
    assert [rows.row_of(wanted) for wanted in [*ids, 3, 8, 31]] == [0, 1, 2, 3, -1, -1, -1]
    assert rows.find(np.array([3, ids[2], 8])).tolist() == [-1, 2, -1]
