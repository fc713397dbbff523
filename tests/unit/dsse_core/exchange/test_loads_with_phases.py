"""Load messages of networks with phases: loads carried through banks as currents of the unloaded grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.exchange.boundary_load import (
    NetLoad,
    load_message_for,
    measured_net_loads,
    own_net_loads,
    powers_from,
    scheduled_load_messages,
)
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.division import build_partition
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.ieee_feeders import load_feeder
from tests.support.ieee_feeders.placing import cut_at
from tests.support.phases import AREAS, DEEP, KIND, RING, TIE, make_feeder


def light(network: Network, factor: float = 0.01) -> Network:
    """``network`` with little load, where losses count little, most of it in one phase of the bank."""
    heavy = {(675, "a"): 3.0, (675, "b"): 0.2}
    loads = [replace(load, s=factor * heavy.get((load.bus, load.phases), 1.0) * load.s) for load in network.loads]
    return replace(network, loads=(*loads, Load(675, "bc", factor * (0.3 + 0.1j), (1.0, 2.0))))


def powers_into(network: Network, branch: str, bus: int) -> dict[str, complex]:
    """Phase -> power from ``bus`` into ``branch`` by the power flow, p.u."""
    flow = solve_power_flow(network)
    v = flow.vm * np.exp(1j * flow.va)
    b = network.branch(branch)
    assert b.primitive is not None
    ports = [(b.from_bus, p) for p in b.primitive.from_phases] + [(b.to_bus, p) for p in b.primitive.to_phases]
    u = np.array([v[network.node(*port)] for port in ports])
    s = u * (b.primitive.y @ u).conj()
    return {phase: complex(power) for (at, phase), power in zip(ports, s, strict=True) if at == bus}


@pytest.mark.parametrize(
    ("child", "branch", "bus"), [("bank", "692-675", 692), ("two", "645-632", 632), ("one", "684-611", 684)]
)
def test_a_child_states_the_power_of_each_phase_that_flows_into_it(child: str, branch: str, bus: int):
    network = light(make_feeder())
    partition = build_partition(network, DEEP)
    parent = partition.area(child).parent
    assert parent is not None
    stated = scheduled_load_messages(partition)[parent.area][child]
    expected = powers_into(network, branch, bus)
    largest = max(map(abs, expected.values()))
    assert len(stated) == len(expected)
    for load, (phase, power) in zip(stated, expected.items(), strict=True):
        assert abs(load.s - power) < 0.01 * largest, phase


def test_loads_behind_a_delta_winding_are_not_those_of_the_same_phase_before_it():
    network = light(make_feeder())
    partition = build_partition(network, DEEP)
    stated = scheduled_load_messages(partition)["east"]["bank"]
    behind = [load.s for load in own_net_loads(partition.area("bank"))][3:]
    assert max(abs(load.s - s) for load, s in zip(stated, behind, strict=True)) > 0.3 * max(map(abs, behind))
    assert sum(load.s for load in stated) == pytest.approx(sum(behind), rel=1e-2)


def test_loads_of_all_messages_add_up_to_what_the_substation_supplies():
    for areas, ties in ((AREAS, ()), (DEEP, ()), (RING, (TIE,))):
        network = light(make_feeder(*ties))
        partition = build_partition(network, areas)
        received = scheduled_load_messages(partition)
        head = partition.area("head")
        total = sum(load.s for load in own_net_loads(head))
        total += sum(load.s for loads in received["head"].values() for load in loads)
        assert total == pytest.approx(sum(powers_into(network, "reg", 650).values()), rel=0.02)


def test_generation_that_is_measured_counts_at_each_phase_or_as_their_total():
    head = build_partition(make_feeder(), AREAS).area("head")
    total = [
        Measurement(Meter(kind, 650), value, 0.01) for kind, value in ((KIND.P_INJECTION, 0.6), (KIND.Q_INJECTION, 0.3))
    ]
    of_b = [Measurement(Meter(KIND.P_INJECTION, 650, phases="b"), 0.5, 0.02)]
    nodes = head.network.nodes_at(650).tolist()
    assert measured_net_loads(head, total) == dict.fromkeys(nodes, NetLoad(-0.6 - 0.3j, 1e-4))
    assert measured_net_loads(head, total + of_b)[nodes[1]] == NetLoad(-0.5 - 0.3j, 4e-4)
    own = own_net_loads(head, measured_net_loads(head, total))
    assert own[nodes[0]].s.real == pytest.approx(-0.6, abs=1e-3)  # beside charging
    message = load_message_for(head, "two", own, {"west": (NetLoad(0.1 + 0j),) * 2, "east": (NetLoad(0.2 + 0j),) * 3})
    assert [load.variance for load in message] == pytest.approx([1e-4, 1e-4], rel=0.1)


def test_a_stand_in_has_the_power_of_each_phase():
    area = build_partition(make_feeder(), AREAS).area("head")
    loads = (NetLoad(0.1 + 0.05j, 1e-4), NetLoad(-0.2 + 0.3j))
    boundary = area.boundaries["west"]
    assert powers_from(area.name, boundary, loads) == pytest.approx([0.1, 0.05, -0.2, 0.3])
    assert powers_from("west", boundary, loads) == pytest.approx([-0.1, -0.05, 0.2, -0.3])


@pytest.mark.parametrize("name", ["dy", "yd", "grdyd"])
def test_a_bank_of_opendss_carries_unequal_loads_to_other_phases(name: str):
    """The loads of each phase are 30, 50 and 70 % of the feeder's: what is left are losses and voltage drop."""
    feeder = load_feeder(f"4bus-{name}")
    network = replace(
        feeder, loads=tuple(replace(load, s=k * load.s) for load, k in zip(feeder.loads, (0.3, 0.5, 0.7), strict=True))
    )
    partition = build_partition(network, cut_at(network, (2,)))
    (child,) = (area for area in partition.areas if area.parent)
    flow = solve_power_flow(network)
    v = (flow.vm * np.exp(1j * flow.va))[partition.rows_of_nodes[child.name]]
    parent, nodes = child.neighbours[0].area, child.boundary_nodes[child.neighbours[0].area]
    power = (v * (build_admittance(child.network).ybus @ v).conj())[nodes]
    stated = np.array([load.s for load in scheduled_load_messages(partition)[parent][child.name]])
    of_phase = [load.s for load in own_net_loads(child)][-3:]  # at the last bus, where all loads are
    assert abs(stated - power).max() < 0.16 * abs(power).max() < 0.25 * abs(power).max() < abs(of_phase - power).max()
