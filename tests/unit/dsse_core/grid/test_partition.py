"""Areas form a tree; every way in which they do not is reported; load messages add up to the load of the grid."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsse_core.errors import InvalidInputError
from dsse_core.exchange.boundary_load import Loads, NetLoad, boundary_loads, own_net_loads, scheduled_load_messages
from dsse_core.grid.admittance import find_no_load
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.partition import Neighbour

Kind = MeasurementKind


def grid(*ends, loads=None, slack=1, generators=()):
    """A network with branches between the given bus pairs."""
    ids = sorted({bus for pair in ends for bus in pair})
    loads = loads or {}
    return Network(
        "grid",
        1.0,
        tuple(Bus(i, 10.0, p_load=loads.get(i, i / 100), q_load=i / 200, b_shunt=0.01) for i in ids),
        tuple(Branch(f"{f}-{t}", f, t, 0.01, 0.02, b=0.004) for f, t in ends),
        (Generator(slack, Control.SLACK, p=0.3, q=0.1), *generators),
    )


def row(n):
    return grid(*((i, i + 1) for i in range(1, n)))


def problems_of(network, areas, **options):
    with pytest.raises(InvalidInputError) as caught:
        build_partition(network, areas, **options)
    return caught.value.problems


def test_a_chain_of_areas_hands_its_boundary_buses_from_owner_to_child():
    partition = build_partition(row(7), {"a": [1, 2, 3], "b": [3, 4, 5], "c": [5, 6, 7]})
    assert partition.boundaries == {3: ("a", "b"), 5: ("b", "c")}
    assert partition.owner_of_bus == {1: "a", 2: "a", 3: "a", 4: "b", 5: "b", 6: "c", 7: "c"}
    middle = partition.area("b")
    assert [(n.area, n.bus, n.is_parent) for n in middle.neighbours] == [("a", 3, True), ("c", 5, False)]
    assert middle.boundary_buses == (3, 5)
    assert (middle.slack_bus, middle.slack_vm) == (3, None)
    assert partition.area("a").is_reference
    assert not middle.is_reference


def test_the_order_in_which_areas_are_listed_does_not_matter_to_the_tree():
    partition = build_partition(row(7), {"c": [5, 6, 7], "b": [3, 4, 5], "a": [1, 2, 3]})
    assert [area.name for area in partition.areas] == ["c", "b", "a"]
    assert partition.area("c").parent.area == "b"
    assert partition.boundaries == {3: ("a", "b"), 5: ("b", "c")}


def test_several_areas_meet_in_a_star_at_one_bus():
    network = grid((1, 2), (2, 3), (2, 4), (2, 5))
    partition = build_partition(network, {"a": [1, 2], "b": [2, 3], "c": [2, 4], "d": [2, 5]})
    assert partition.boundaries == {2: ("a", "b", "c", "d")}
    assert [n.area for n in partition.area("a").neighbours] == ["b", "c", "d"]
    assert [n.area for n in partition.area("c").neighbours] == ["a"]


def test_areas_may_meet_at_the_substation():
    network = grid((1, 2), (1, 3), (1, 4))
    partition = build_partition(network, {"a": [1, 2], "b": [1, 3], "c": [1, 4]})
    assert partition.boundaries == {1: ("a", "b", "c")}
    assert [area.is_reference for area in partition.areas] == [True, False, False]
    assert partition.area("b").network.generators == ()
    assert (partition.area("b").slack_bus, partition.area("b").slack_vm) == (1, None)


def test_one_area_may_hold_the_whole_network():
    partition = build_partition(row(3), {"all": [1, 2, 3]})
    assert partition.boundaries == {}
    assert partition.area("all").neighbours == ()
    assert scheduled_load_messages(partition) == {"all": {}}


def test_load_shunt_and_generator_of_a_boundary_bus_stand_with_its_owner_only():
    network = grid((1, 2), (2, 3), generators=(Generator(2, Control.POWER, p=0.1),))
    partition = build_partition(network, {"a": [1, 2], "b": [2, 3]})
    assert partition.area("a").network.bus(2) == network.bus(2)
    bare = partition.area("b").network.bus(2)
    assert (bare.p_load, bare.q_load, bare.g_shunt, bare.b_shunt) == (0, 0, 0, 0)
    assert [g.bus for g in partition.area("a").network.generators] == [1, 2]
    assert partition.area("b").network.generators == ()


def test_a_voltage_holding_generator_is_the_local_slack_and_a_chosen_slack_overrides_it():
    network = grid((1, 2), (2, 3), (3, 4), generators=(Generator(4, Control.VOLTAGE, vm=0.98),))
    areas = {"a": [1, 2], "b": [2, 3, 4]}
    area = build_partition(network, areas).area("b")
    assert (area.slack_bus, area.slack_vm) == (4, 0.98)
    area = build_partition(network, areas, {"b": (3, 0.97)}).area("b")
    assert (area.slack_bus, area.slack_vm) == (3, 0.97)


def test_every_meter_belongs_to_one_area():
    partition = build_partition(row(5), {"a": [1, 2, 3], "b": [3, 4, 5]})
    assert partition.area_of_meter(Meter(Kind.VM, 3)) == "a"
    assert partition.area_of_meter(Meter(Kind.P_FLOW, 3, "3-4")) == "b"
    assert partition.area_of_meter(Meter(Kind.Q_FLOW, 3, "2-3")) == "a"


def test_meters_are_grouped_by_area_in_their_order_and_no_area_is_missing():
    partition = build_partition(row(5), {"a": [1, 2], "b": [2, 3], "c": [3, 4, 5]})
    meters = [Meter(Kind.VM, 3), Meter(Kind.VM, 1), Meter(Kind.P_FLOW, 3, "2-3")]
    assert partition.meters_by_area(meters) == {"a": (meters[1],), "b": (meters[0], meters[2]), "c": ()}


def test_the_longest_path_runs_between_the_two_areas_farthest_apart():
    network = grid((1, 2), (2, 3), (2, 4), (4, 5), (3, 6))
    areas = {"a": [1, 2], "b": [2, 3], "c": [2, 4], "d": [4, 5], "e": [3, 6]}
    path = build_partition(network, areas).longest_path
    assert path in (("d", "c", "a", "b", "e"), ("e", "b", "a", "c", "d"))
    assert build_partition(row(3), {"all": [1, 2, 3]}).longest_path == ("all",)


def test_all_slips_in_the_lists_of_buses_are_reported_at_once():
    problems = problems_of(
        row(6),
        {"a": [1, 2, 2], "b": [2, 3, 99], "c": []},
        local_slack={"b": (1, 1.0), "nowhere": (1, 1.0), "a": (1, -0.5)},
    )
    text = "\n".join(problems)
    assert "area a: bus 2 is listed 2 times" in text
    assert "area b: bus 99 is not in the network" in text
    assert "area c lists no bus" in text
    for bus in (4, 5, 6):
        assert f"bus {bus} is in no area" in text
    assert "area b: slack_bus 1 is not one of its buses" in text
    assert "local slack of area nowhere, which is not one of the areas a, b, c" in text
    assert "area a: slack_vm is -0.5" in text


def test_a_branch_between_two_areas_is_reported_with_its_buses():
    (problem,) = problems_of(row(4), {"a": [1, 2], "b": [3, 4]})
    assert problem.startswith("branch 2-3 is in no area")
    assert "2 and 3" in problem


def test_an_area_in_pieces_is_reported_with_the_pieces():
    network = row(5)
    problems = problems_of(network, {"a": [1, 2, 4, 5], "b": [2, 3, 4]})
    assert problems == ("area a is not connected by its own branches: it falls into buses 1, 2 | 4, 5",)


def test_an_area_of_a_single_bus_has_no_branch():
    (problem,) = problems_of(row(3), {"a": [1, 2, 3], "b": [3]})
    assert "area b has a single bus" in problem


def test_no_area_at_all_is_reported():
    assert problems_of(row(2), {})[0].startswith("there is no area")


def test_buses_beyond_an_open_switch_are_reported():
    network = Network(
        "grid",
        1.0,
        (Bus(1, 10.0), Bus(2, 10.0), Bus(3, 10.0)),
        (Branch("1-2", 1, 2, 0.1, 0.1), Branch("2-3", 2, 3, 0.1, 0.1, in_service=False)),
        (Generator(1, Control.SLACK),),
    )
    assert "no path of branches in service joins bus 3 to the substation" in problems_of(network, {"a": [1, 2, 3]})


def test_a_network_without_substation_has_no_root():
    network = Network("grid", 1.0, (Bus(1, 10.0), Bus(2, 10.0)), (Branch("1-2", 1, 2, 0.1, 0.1),))
    assert any("no slack bus (substation)" in p for p in problems_of(network, {"a": [1, 2]}))


def test_a_branch_that_two_areas_list_is_named_and_they_are_not_also_called_disconnected():
    (problem,) = problems_of(row(4), {"a": [1, 2, 3], "b": [2, 3, 4]})
    assert problem == "areas a, b all list both ends of branch 2-3; leave bus 2 or 3 out of all but one of them"


def test_two_areas_may_meet_at_two_buses_which_the_parent_owns():
    network = grid((1, 2), (1, 3), (2, 4), (3, 4), loads={1: 0.1, 2: 0.2, 3: 0.3, 4: 0.4})
    partition = build_partition(network, {"a": [1, 2, 3], "b": [2, 3, 4]})
    a, b = partition.areas
    assert (a.neighbours, b.neighbours) == (
        (Neighbour("b", 2, False, ("s@2>b", "s@3>b", "v@2", "v@3")),),
        (Neighbour("a", 2, True, ("s@2>b", "s@3>b", "v@2", "v@3")),),
    )
    assert (a.not_owned, b.not_owned) == ((), (2, 3))
    assert [bus.p_load for bus in b.network.buses] == [0.0, 0.0, 0.4]
    assert [(power.kind, power.bus, power.area) for power in a.powers_into_children] == [
        *[("p", 2, "b"), ("q", 2, "b"), ("p", 3, "b"), ("q", 3, "b")]
    ]
    assert partition.owner_of_bus == {1: "a", 2: "a", 3: "a", 4: "b"}
    assert a.boundary_buses == (2, 3)


def test_areas_know_the_voltages_of_the_unloaded_ring_that_passes_through_them():
    """A tap in one half of a ring: each half by itself would find another voltage at the second bus."""
    network = grid((1, 2), (1, 3), (2, 4), (3, 4))
    branches = (replace(network.branches[0], tap=1.05, shift=0.1), *network.branches[1:])
    network = replace(network, branches=branches)
    partition = build_partition(network, {"a": [1, 2, 3], "b": [2, 3, 4]})
    whole = np.array(find_no_load(network, 1))
    assert abs(whole[0] - 1).max() > 0.01
    for area in partition.areas:
        np.testing.assert_allclose(area.find_no_load(), whole[:, partition.rows_of_buses[area.name]], atol=1e-12)


def test_a_ring_of_three_areas_is_named_in_order():
    network = grid((1, 2), (2, 3), (3, 4), (4, 1))
    (problem,) = problems_of(network, {"a": [4, 1, 2], "b": [2, 3], "c": [3, 4]})
    assert "areas form a loop: a - b - c - a" in problem
    assert "closed at bus 3" in problem


def test_a_ring_away_from_the_substation_does_not_blame_the_areas_on_the_way():
    network = grid((1, 2), (2, 3), (2, 4), (3, 5), (4, 5))
    (problem,) = problems_of(network, {"root": [1, 2], "mid": [2, 3, 4], "x": [3, 5], "y": [4, 5]})
    assert "areas form a loop: mid - x - y - mid, closed at bus 5" in problem


def test_a_ring_through_a_shared_bus_names_only_the_areas_of_the_ring():
    """b and c branch off at bus 2 and meet again at bus 5; a only touches bus 2."""
    network = grid((1, 2), (2, 3), (3, 5), (2, 4), (4, 5))
    (problem,) = problems_of(network, {"a": [1, 2], "b": [2, 3, 5], "c": [2, 4, 5]})
    assert "areas form a loop: b - c - b, closed at bus 5" in problem


@st.composite
def divided_trees(draw):
    """A random tree rooted at bus 1; at every bus a branch outward continues its area or starts a new one."""
    n = draw(st.integers(2, 20))
    parents = {i: draw(st.integers(1, i - 1)) for i in range(2, n + 1)}
    loads = {i: draw(st.floats(-2, 2)) for i in range(1, n + 1)}
    sources = tuple(
        Generator(i, Control.POWER, p=draw(st.floats(0, 1)), q=0.1) for i in range(2, n + 1) if draw(st.booleans())
    )
    area_of_branch, areas = {}, {"area1": {1}}
    for bus, parent in parents.items():
        here = area_of_branch.get(parent, "area1")
        if len(area_of_branch) and draw(st.booleans()):
            here = f"area{len(areas) + 1}"
        area_of_branch[bus] = here
        areas.setdefault(here, set()).update((parent, bus))
    network = grid(*((p, b) for b, p in parents.items()), loads=loads, generators=sources)
    order = draw(st.permutations(sorted(areas)))
    return network, {name: sorted(areas[name]) for name in order}


def total_of(*sides: Loads) -> complex:
    return sum((load.s for loads in sides for load in loads), 0j)


def test_load_messages_of_many_areas_in_a_row_add_up():
    n = 1001
    partition = build_partition(row(n), {f"a{k}": [k, k + 1] for k in range(1, n)})
    received = scheduled_load_messages(partition)
    for area in (partition.areas[0], partition.areas[n // 2], partition.areas[-1]):
        everything = total_of(own_net_loads(area), *received[area.name].values())
        assert everything == pytest.approx(total_of(*(own_net_loads(one) for one in partition.areas)))


@settings(max_examples=150, deadline=None)
@given(divided_trees())
def test_what_an_area_owns_and_receives_is_the_net_load_of_the_whole_grid(divided):
    network, areas = divided
    total = -sum((network.scheduled_injection(bus.id) for bus in network.buses), 0j)
    total -= 1j * sum(bus.b_shunt for bus in network.buses) + 1j * sum(branch.b for branch in network.branches)
    partition = build_partition(network, areas)
    received = scheduled_load_messages(partition)
    for area in partition.areas:
        assert set(received[area.name]) == {n.area for n in area.neighbours}
        everything = total_of(own_net_loads(area), *received[area.name].values())
        assert everything == pytest.approx(total, abs=1e-9)
        at_boundaries = boundary_loads(area, received[area.name], error=0.3 + 0.3j)
        assert set(at_boundaries) == set(area.boundary_buses)
        beyond = sum((load.s for load in at_boundaries.values()), 0j)
        expected = total - total_of(own_net_loads(area)) + (0.3 + 0.3j) * len(area.boundary_buses)
        assert beyond == pytest.approx(expected, abs=1e-9)


@settings(max_examples=100, deadline=None)
@given(divided_trees())
def test_every_bus_has_one_owner_every_branch_one_area_and_the_areas_are_a_tree(divided):
    network, areas = divided
    partition = build_partition(network, areas)
    assert set(partition.owner_of_bus) == set(network.row)
    branches = [b.id for area in partition.areas for b in area.network.branches]
    assert sorted(branches) == sorted(b.id for b in network.branches)
    links = {frozenset((area.name, n.area)) for area in partition.areas for n in area.neighbours}
    assert len(links) == len(partition.areas) - 1
    assert [area.is_reference for area in partition.areas].count(True) == 1
    for area in partition.areas:
        assert area.is_reference == (area.parent is None)
        assert sum(n.is_parent for n in area.neighbours) == (0 if area.is_reference else 1)
        assert math.isclose(sum(b.p_load for b in area.network.buses if b.id != (area.parent and area.parent.bus)),
                            sum(b.p_load for b in area.network.buses), abs_tol=1e-12)  # fmt: skip


def test_a_shunt_counts_as_the_load_that_it_is_at_nominal_voltage_also_where_the_injection_is_metered():
    """The capacitor of bus 2, 0.6 p.u., and its resistor: beyond bus 3 it is the same whether load or shunt."""
    network = row(5)
    source = Generator(2, Control.POWER, p=0.1)
    plain = replace(network.buses[1], b_shunt=0.0, g_shunt=0.0)
    as_shunt, as_load = (
        replace(network, buses=(network.buses[0], bus, *network.buses[2:]), generators=(*network.generators, source))
        for bus in (
            replace(plain, g_shunt=0.05, b_shunt=0.6),
            replace(plain, p_load=plain.p_load + 0.05, q_load=plain.q_load - 0.6),
        )
    )
    reported = [
        scheduled_load_messages(build_partition(n, {"a": [1, 2, 3], "b": [3, 4, 5]}))["b"]["a"][0].s
        for n in (as_shunt, as_load)
    ]
    assert reported[0] == pytest.approx(reported[1])

    area = build_partition(as_shunt, {"a": [1, 2, 3], "b": [3, 4, 5]}).area("a")
    read = NetLoad(-as_shunt.scheduled_injection(2), variance=1e-4)  # an injection meter does not see the shunt
    (load,) = own_net_loads(area, {area.network.node(2): read})
    assert load.s == pytest.approx(total_of(own_net_loads(area)))
    assert load.variance == 1e-4


def test_an_unacknowledged_neighbour_leaves_its_boundary_bus_out():
    partition = build_partition(row(7), {"a": [1, 2, 3], "b": [3, 4, 5], "c": [5, 6, 7]})
    area = partition.area("b")
    received = scheduled_load_messages(partition)["b"]
    assert set(boundary_loads(area, {"a": received["a"]})) == {3}
