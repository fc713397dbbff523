"""Messages of areas form a tree; every slip is reported; load messages add up to the load of the grid."""

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


def test_a_branch_between_two_areas_is_held_by_the_owner_of_its_from_bus_or_by_the_area_that_is_named():
    network, areas = row(4), {"a": [1, 2], "b": [3, 4]}
    a, b = build_partition(network, areas).areas
    assert (a.network.branch_ids, b.network.branch_ids) == (["1-2", "2-3"], ["3-4"])
    assert (a.not_owned, b.not_owned) == ((3,), ())
    (above,) = b.neighbours
    assert above == Neighbour("a", 3, True, ("s@3>a", "v@3"))
    assert a.network.bus(3).p_load == 0.0 < b.network.bus(3).p_load
    a, b = build_partition(network, areas, holders={"2-3": "b"}).areas
    assert (a.network.branch_ids, b.network.branch_ids) == (["1-2"], ["2-3", "3-4"])
    assert b.neighbours == (Neighbour("a", 2, True),)


def test_an_open_branch_is_in_the_area_of_both_its_buses_and_between_areas_in_the_one_that_holds_it():
    network = grid((1, 2), (2, 3), (3, 4), (4, 5), (1, 3), (2, 5))
    branches = (*network.branches[:4], *(replace(b, in_service=False) for b in network.branches[4:]))
    network, areas = replace(network, branches=branches), {"a": [1, 2, 3], "b": [3, 4, 5]}
    partition = build_partition(network, areas)
    assert partition.area("a").network.branch_ids == ["1-2", "2-3", "1-3"]
    assert partition.holder.tolist() == [0, 0, 1, 1, 0, -1]
    tied = build_partition(network, areas, holders={"2-5": ""})
    assert tied.holder.tolist() == [0, 0, 1, 1, 0, 0]
    assert carried(tied) == {("b", "a"): ("s@3>b", "s@5>a", "v@3", "v@5")}
    closed = replace(network, branches=tuple(replace(b, in_service=True) for b in branches))
    assert carried(build_partition(closed, areas)) == carried(tied)
    assert [a.find_no_load()[0].tolist() for a in tied.areas] == [[1.0] * 4, [1.0] * 3]


def test_all_slips_in_the_holders_of_branches_are_reported_at_once():
    holders = {"2-3": "nowhere", "3-4": "a", "7-8": "a"}
    assert list(problems_of(row(4), {"a": [1, 2], "b": [3, 4]}, holders=holders)) == [
        "branch 2-3 is to be held by nowhere, which is not one of the areas a, b",
        "area a lists neither bus of branch 3-4, 3 and 4; give it one",
        "branch 7-8 is to be held by an area, and is not in the network",
    ]


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


def carried(partition):
    """(lower area, the area above it) -> the variables of their edge."""
    return {(a.name, n.area): a.boundaries[n.area].names for a in partition.areas for n in a.neighbours if n.is_parent}


def test_around_a_ring_of_three_areas_one_edge_is_left_out_and_its_variables_pass_over_the_other_two():
    """The areas meet two by two at buses 2, 3 and 4; the third meeting, at bus 3 of b and c, is relayed by a."""
    network = grid((1, 2), (2, 3), (3, 4), (4, 1), (1, 5))
    partition = build_partition(network, {"a": [1, 2, 4, 5], "b": [2, 3], "c": [3, 4]})
    a, b, c = partition.areas
    assert carried(partition) == {
        ("b", "a"): ("s@2>b", "s@3>c", "v@2", "v@3"),
        ("c", "a"): ("s@3>c", "s@4>c", "v@3", "v@4"),
    }
    assert (a.not_owned, b.not_owned, c.not_owned) == ((3,), (2,), (3, 4))
    assert partition.owner_of_bus == {1: "a", 2: "a", 3: "b", 4: "a", 5: "a"}
    relayed = a.network.bus(3)
    assert (relayed.p_load, relayed.b_shunt, a.network.branches_at[3]) == (0.0, 0.0, ())
    assert sum(area.n_unknown for area in partition.areas) == 2 * 5 - 1
    assert [(power.bus, power.area) for power in a.powers_into_children[::2]] == [(2, "b"), (3, "c"), (4, "c")]


def test_an_area_that_only_relays_the_substation_knows_its_angle_and_is_no_reference():
    """Areas o and x meet at bus 1, and each meets r at three buses: the edge between o and x is left out."""
    near, far = (11, 12, 13), (21, 22, 23)
    ends = [*((1, k) for k in near), *((k, 30) for k in (*near, *far)), *((k, 40) for k in (1, *far))]
    areas = {"o": [1, *near], "r": [*near, 30, *far], "x": [1, *far, 40]}
    o, r, x = build_partition(grid(*ends), areas).areas
    assert ({n.area for n in r.neighbours}, [n.area for n in x.neighbours]) == ({"o", "x"}, ["r"])
    assert {area.reference for area in (o, r, x)} == {(1, 0.0)}
    assert [area.is_at_reference for area in (o, r, x)] == [True, False, True]


def test_an_edge_of_too_many_variables_is_refused_with_the_branches_that_cause_it():
    middle = range(2, 19)
    network = grid(*((1, k) for k in middle), *((k, 20) for k in middle))
    (problem,) = problems_of(network, {"near": [1, *middle], "far": [*middle, 20]})
    assert problem.startswith(
        "near and far would exchange 68 variables, of at most 64, as rings pass between them over"
    )
    assert "2-20 of far at bus 2" in problem


@st.composite
def meshed_areas(draw):
    """A random tree with further branches, whose branches are divided among areas at random; each area in one piece."""
    n = draw(st.integers(4, 12))
    ends = {(draw(st.integers(1, i - 1)), i) for i in range(2, n + 1)}
    others = st.tuples(st.integers(1, n), st.integers(1, n)).map(lambda pair: tuple(sorted(pair)))
    ends |= set(draw(st.lists(others.filter(lambda pair: pair[0] != pair[1]), max_size=4)))
    return grid(*sorted(ends)), draw(st.integers(0, 2**16))


@settings(max_examples=60, deadline=None)
@given(meshed_areas())
def test_every_area_between_two_that_use_a_variable_has_it(drawn):
    """The running intersection: along the tree of messages a variable is carried from each user to all others."""
    network, seed = drawn
    partition = build_partition(network, one_area_a_branch(network, seed))
    users: dict[object, set[str]] = {}
    for bus, (owner, *others) in partition.boundaries.items():
        there = [name for name in others if partition.area(name).network.branches_at[bus]]
        for name in there:
            users[Kind.P_INJECTION, bus, name] = {owner, name}
        users[Kind.VM, bus] = {owner, *there}
    for area in partition.areas:
        for n in area.neighbours:
            behind = beyond(partition, area.name, n.area)
            crossing = {what for what, names in users.items() if names & behind and names - behind}
            boundary = area.boundaries[n.area]
            found = {(Kind.P_INJECTION, v.bus, v.area) if v.area else (Kind.VM, v.bus) for v in boundary.variables}
            assert found == crossing


def one_area_a_branch(network, seed):
    """An area for each branch, or for two that meet."""
    rng, areas, taken = np.random.default_rng(seed), {}, set()
    for k, branch in enumerate(network.branches):
        if k in taken:
            continue
        buses = {branch.from_bus, branch.to_bus}
        for other in range(k + 1, len(network.branches)):
            there = {network.branches[other].from_bus, network.branches[other].to_bus}
            if other not in taken and buses & there and rng.random() < 0.3 and len(buses | there) == 3:
                wider = buses | there
                inside = [b for b in network.branches if {b.from_bus, b.to_bus} <= wider]
                if len(inside) == 2:
                    taken.add(other)
                    buses = wider
                    break
        areas[f"x{k}"] = sorted(buses)
    return areas


def beyond(partition, one, other):
    """The areas behind ``other``, seen from its neighbour ``one``."""
    found, queue = {other}, [other]
    for name in queue:  # the queue grows
        for n in partition.area(name).neighbours:
            if n.area not in found and n.area != one:
                found.add(n.area)
                queue.append(n.area)
    return found


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
