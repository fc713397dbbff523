"""Cuts at articulation points: areas that are a tree, sizes within the documented rule, and every wrong cut named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsse_core.errors import InvalidInputError
from dsse_core.grid.biconnected import Block, find_blocks
from dsse_core.grid.columns import Records
from dsse_core.grid.division import build_partition
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from scenarios.generate.cutting import cut_at, cut_into


def grid(*ends: tuple[int, int], slack: int = 1, open_ids: Sequence[str] = ()) -> Network:
    """A network with branches ``from-to`` between the given bus pairs."""
    buses = sorted({bus for pair in ends for bus in pair})
    branches = [Branch(f"{a}-{b}", a, b, 0.01, 0.01, in_service=f"{a}-{b}" not in open_ids) for a, b in ends]
    sources = (Generator(slack, Control.SLACK),)
    return Network("grid", 1.0, tuple(Bus(b, 10.0) for b in buses), tuple(branches), sources)


def row(n: int) -> Network:
    return grid(*((k, k + 1) for k in range(1, n)))


def star(n: int) -> Network:
    return grid(*((1, k) for k in range(2, n + 1)))


def sizes(areas: dict[str, list[int]]) -> list[int]:
    """Buses that each area owns, the substation not counted: all but the one towards the substation."""
    return [len(buses) - 1 for buses in areas.values()]


def problems_of(cut: object, *arguments: object) -> tuple[str, ...]:
    with pytest.raises(InvalidInputError) as caught:
        cut(*arguments)  # type: ignore[operator]
    return caught.value.problems


@st.composite
def networks(draw: st.DrawFn, largest: int = 25, chords: int = 4) -> Network:
    """A random tree with some chords, the substation anywhere."""
    n = draw(st.integers(2, largest))
    ends = {(draw(st.integers(1, k - 1)), k) for k in range(2, n + 1)}
    for _ in range(draw(st.integers(0, chords))):
        a, b = sorted((draw(st.integers(1, n)), draw(st.integers(1, n))))
        if a != b:
            ends.add((a, b))
    return grid(*draw(st.permutations(sorted(ends))), slack=draw(st.integers(1, n)))


@settings(max_examples=200, deadline=None)
@given(networks(), st.data())
def test_areas_by_count_are_as_many_as_asked_and_a_partition(network: Network, data: st.DataObject) -> None:
    """build_partition checks that they are connected, cover every bus and branch once and form a tree."""
    count = data.draw(st.integers(1, len(find_blocks(network))))
    areas = cut_into(network, count)
    assert list(areas) == [f"area{k}" for k in range(1, count + 1)]
    partition = build_partition(network, areas)
    assert all(area.network.branches for area in partition.areas)
    assert partition.areas[0].is_reference
    assert all(buses == [b.id for b in network.buses if b.id in set(buses)] for buses in areas.values())
    assert sum(sizes(areas)) == len(network.buses) - 1


@settings(max_examples=100, deadline=None)
@given(networks(largest=60, chords=0), st.data())
def test_in_a_radial_network_no_area_has_more_than_twice_the_mean_size(network: Network, data: st.DataObject) -> None:
    n_branch = len(network.branches)
    count = data.draw(st.integers(1, n_branch))
    assert max(sizes(cut_into(network, count))) <= max(1, 2 * n_branch / count)


@settings(max_examples=100, deadline=None)
@given(networks(largest=8), st.data())
def test_the_largest_area_has_at_most_twice_the_smallest_possible_size(network: Network, data: st.DataObject) -> None:
    blocks = find_blocks(network)
    count = data.draw(st.integers(1, len(blocks)))
    best = min(max(map(weight, areas)) for areas in all_divisions(blocks, count))
    assert max(sizes(cut_into(network, count))) <= 2 * best


def weight(blocks: Sequence[Block]) -> int:
    return sum(len(block.buses) for block in blocks)


def all_divisions(blocks: Sequence[Block], count: int) -> Iterator[list[list[Block]]]:
    """Every division of ``blocks`` into ``count`` connected areas."""

    def divide(k: int, areas: list[list[Block]]) -> Iterator[list[list[Block]]]:
        if k == len(blocks):
            if len(areas) == count and all(map(is_connected, areas)):
                yield areas
            return
        for i in range(len(areas)):
            yield from divide(k + 1, [*areas[:i], [*areas[i], blocks[k]], *areas[i + 1 :]])
        if len(areas) < count:
            yield from divide(k + 1, [*areas, [blocks[k]]])

    yield from divide(0, [])


def is_connected(blocks: Sequence[Block]) -> bool:
    reached, left = {blocks[0].top, *blocks[0].buses}, list(blocks[1:])
    while touching := [block for block in left if reached & {block.top, *block.buses}]:
        reached.update(bus for block in touching for bus in (block.top, *block.buses))
        left = [block for block in left if block not in touching]
    return not left


def test_a_row_is_cut_into_equal_parts() -> None:
    assert sizes(cut_into(row(101), 4)) == [25, 25, 25, 25]


def test_the_laterals_of_one_bus_are_gathered_into_areas_that_all_meet_there() -> None:
    areas = cut_into(star(31), 3)
    assert sizes(areas) == [10, 10, 10]
    partition = build_partition(star(31), areas)
    assert partition.boundaries == {1: ("area1", "area2", "area3")}


def test_of_two_laterals_the_lighter_stays_with_the_trunk() -> None:
    """Three buses of trunk, then laterals of five and of three at its end."""
    trunk, five, three = [(1, 2), (2, 3), (3, 4)], [(4, 5), *((k, k + 1) for k in range(5, 9))], [(4, 10), (10, 11)]
    assert sizes(cut_into(grid(*trunk, *five, *three, (11, 12)), 2)) == [6, 5]


def test_of_the_laterals_of_a_loop_the_heaviest_is_cut_off() -> None:
    """A loop of buses 1 to 4, a lateral of four buses at bus 2, single ones at 3 and 4."""
    loop, four = [(1, 2), (2, 3), (3, 4), (4, 1)], [(2, 5), (5, 6), (6, 7), (7, 8)]
    assert sizes(cut_into(grid(*loop, *four, (3, 9), (4, 10)), 2)) == [5, 4]


def test_loops_stay_inside_an_area() -> None:
    network = grid((1, 2), (2, 3), (3, 4), (4, 2), (4, 5), (5, 6))
    assert cut_into(network, 4) == {"area1": [1, 2], "area2": [2, 3, 4], "area3": [4, 5], "area4": [5, 6]}


def test_more_areas_than_pieces_are_rejected_with_the_largest_number() -> None:
    network = grid((1, 2), (2, 3), (3, 4), (4, 2), (4, 5))
    (problem,) = problems_of(cut_into, network, 4)
    assert "falls into 3 pieces at most" in problem
    assert "give a count of at most 3" in problem


def test_areas_are_numbered_outwards_from_the_substation() -> None:
    areas = cut_into(grid(*((k + 1, k) for k in range(1, 9)), slack=9), 4)
    assert areas == {"area1": [7, 8, 9], "area2": [5, 6, 7], "area3": [3, 4, 5], "area4": [1, 2, 3]}


def test_the_same_network_is_always_cut_the_same_way() -> None:
    network = grid((1, 2), (2, 3), (2, 4), (4, 5), (4, 6), (6, 7), (3, 8), (8, 9))
    assert cut_into(network, 3) == cut_into(network, 3)


def test_a_switch_belongs_to_the_area_beyond_it_and_its_nearer_end_is_the_boundary_bus() -> None:
    network = grid((1, 2), (3, 2), (3, 4), (2, 5), slack=1)
    assert cut_at(network, ["3-2"]) == {"area1": [1, 2, 5], "area2": [2, 3, 4]}


def test_switches_at_one_bus_make_a_star_and_switches_in_a_row_a_chain() -> None:
    network = grid((1, 2), (2, 3), (2, 4), (3, 5), (5, 6))
    assert cut_at(network, ["2-3", "2-4", "5-6"]) == {
        "area1": [1, 2],
        "area2": [2, 3, 5],
        "area3": [2, 4],
        "area4": [5, 6],
    }


def test_a_switch_on_every_branch_at_the_busbar_leaves_one_area_for_each() -> None:
    assert cut_at(star(4), ["1-2", "1-3", "1-4"]) == {"area1": [1, 2], "area2": [1, 3], "area3": [1, 4]}


@settings(max_examples=100, deadline=None)
@given(networks(), st.data())
def test_areas_by_switches_are_a_partition_in_which_every_switch_begins_an_area(
    network: Network, data: st.DataObject
) -> None:
    bridges = [block for block in find_blocks(network) if len(block.branches) == 1]
    chosen = data.draw(st.lists(st.sampled_from(bridges), unique_by=id)) if bridges else []
    at_busbar = [block for block in find_blocks(network) if block.top == network.slack.bus]  # type: ignore[union-attr]
    if not chosen or (len(at_busbar) == 1 and chosen == at_busbar):
        return
    areas = cut_at(network, [block.branches[0] for block in chosen])
    partition = build_partition(network, areas)
    assert len(areas) == len(chosen) + any(block not in chosen for block in at_busbar)
    for block in chosen:
        (home,) = [a for a in partition.areas if block.branches[0] in a.network.branch_ids]
        assert home.parent is None or home.parent.bus == block.top


def test_all_wrong_switches_are_reported_at_once() -> None:
    network = grid((1, 2), (2, 3), (3, 4), (4, 2), (4, 5), (5, 6), (6, 1), open_ids=["6-1"])
    problems = problems_of(cut_at, network, ["2-3", "4-6", "6-1", "4-5", "4-5"])
    text = "\n".join(problems)
    assert len(problems) == 4
    assert "branch 2-3 lies in a loop with 3-4, 4-2," in text or "branch 2-3 lies in a loop with 4-2, 3-4," in text
    assert "there is no branch '4-6'; did you mean" in text
    assert "branch 6-1 is out of service" in text
    assert "branch 4-5 is named 2 times" in text


def test_a_long_loop_is_not_listed_whole() -> None:
    ring = grid((1, 2), *((k, k + 1) for k in range(2, 30)), (30, 2))
    (problem,) = problems_of(cut_at, ring, ["2-3"])
    assert "and 20 more" in problem


def test_a_switch_that_cuts_nothing_off_is_rejected() -> None:
    (problem,) = problems_of(cut_at, row(4), ["1-2"])
    assert "branch 1-2 is the only branch at the substation" in problem


def test_buses_beyond_an_open_branch_are_reported_before_any_cut() -> None:
    network = grid((1, 2), (2, 3), open_ids=["2-3"])
    for problems in (problems_of(cut_into, network, 2), problems_of(cut_at, network, ["1-2"])):
        assert problems == ("no path of branches in service joins bus 3 to the substation",)


def test_no_branch_or_bus_becomes_an_object_where_a_network_of_columns_is_cut() -> None:
    n, ones = 40, np.ones(39)
    loads = {key: np.zeros(n) for key in ("p_load", "q_load", "g_shunt", "b_shunt")}
    ends = {"from_bus": np.arange(1, n) // 2 + 1, "to_bus": np.arange(2, n + 1)}
    impedances = {"r": 0.01 * ones, "x": 0.01 * ones, "b": 0 * ones, "tap": ones, "shift": 0 * ones, "g": 0 * ones}
    buses = Records(Bus, {"id": np.arange(1, n + 1), "base_kv": np.full(n, 20.0), **loads})
    columns = {"id": [f"b{k}" for k in range(n - 1)], **ends, **impedances, "in_service": ones == 1}
    branches = Records(Branch, columns)
    network = Network("columns", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    areas = cut_into(network, 4)
    assert cut_at(network, ["b3"]).keys() == {"area1", "area2"}
    assert "objects" not in vars(buses) | vars(branches)
    assert areas == cut_into(Network("objects", 1.0, tuple(buses), tuple(branches), network.generators), 4)
