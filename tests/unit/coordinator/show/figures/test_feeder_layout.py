"""The one-line diagram of a feeder: every bus has a place of its own, one column further out, and no lines cross."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.show.figures.feeder_layout import find_places, lay_out
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network


def grid(upstream: list[int]) -> Network:
    """A tree: bus k + 2 hangs at bus ``upstream[k]``; bus 1 is the substation."""
    branches = tuple(Branch(f"b{k}", up, k, 0.1, 0.1) for k, up in enumerate(upstream, 2))
    buses = tuple(Bus(k, 10.0) for k in range(1, len(upstream) + 2))
    return Network("tree", 1.0, buses, branches, (Generator(1, Control.SLACK),))


trees = st.integers(1, 30).flatmap(lambda n: st.tuples(*(st.integers(1, k) for k in range(1, n + 1)))).map(list)


@settings(max_examples=200, deadline=None)
@given(trees)
def test_every_bus_has_a_place_of_its_own_one_column_beyond_the_one_before_it(upstream: list[int]) -> None:
    network = grid(upstream)
    layout = lay_out(network)
    assert len({tuple(place) for place in layout.place}) == len(network.buses)
    for bus, before in enumerate(upstream, 2):
        assert layout.upstream[bus] == before
        assert layout.place[bus - 1][0] == layout.place[before - 1][0] + 1


@settings(max_examples=200, deadline=None)
@given(trees)
def test_lines_meet_only_where_they_leave_the_same_bus(upstream: list[int]) -> None:
    """A line runs along the column of one bus, then along the row of the next."""
    place = lay_out(grid(upstream)).place
    points: dict[int, set[tuple[float, float]]] = {}
    for bus, before in enumerate(upstream, 2):
        (x0, y0), (x1, y1) = place[before - 1], place[bus - 1]
        line = points.setdefault(before, set())
        line |= {(x0, float(y)) for y in np.arange(min(y0, y1), max(y0, y1) + 1)} | {(x0 + 0.5, y1), (x1, y1)}
    for (one, of_one), (other, of_other) in combinations(points.items(), 2):
        ends = {tuple(place[bus - 1]) for bus in (one, other)}
        assert of_one & of_other <= ends


def test_the_longest_way_out_is_one_row_and_laterals_turn_off_to_both_sides() -> None:
    layout = lay_out(grid([1, 2, 3, 4, 2, 3]))
    rows = layout.place[:, 1].tolist()
    assert rows[:5] == [0, 0, 0, 0, 0]
    assert {rows[5], rows[6]} == {-1, 1}


def test_a_branch_that_closes_a_loop_moves_no_bus() -> None:
    tree = grid([1, 2, 3])
    ring = Network(tree.name, 1.0, tree.buses, (*tree.branches, Branch("tie", 2, 4, 0.1, 0.1)), tree.generators)
    layout = lay_out(ring)
    assert layout.upstream == {1: 1, 2: 1, 3: 2, 4: 2}
    assert len({tuple(place) for place in layout.place}) == 4


def test_a_network_is_a_map_only_if_each_bus_has_both_coordinates() -> None:
    bare = grid([1, 1])
    buses = [replace(bus, x=8.5 + bus.id, y=47.0) for bus in bare.buses]
    found = find_places(replace(bare, buses=tuple(buses)))
    assert found is not None
    np.testing.assert_array_equal(found, [[9.5, 47.0], [10.5, 47.0], [11.5, 47.0]])
    buses[1] = replace(buses[1], y=None)
    assert find_places(replace(bare, buses=tuple(buses))) is None
    assert find_places(bare) is None


def test_a_section_without_supply_hangs_at_an_open_branch_that_would_feed_it() -> None:
    whole = grid([1, 2, 3, 4])
    last, tie = whole.branches[2], replace(whole.branches[0], id="tie", from_bus=5, to_bus=2, in_service=False)
    opened = tuple(replace(b, in_service=b is not last) for b in whole.branches)
    layout = lay_out(replace(whole, branches=(*opened, tie)))
    assert layout.upstream == {1: 1, 2: 1, 3: 2, 4: 3, 5: 4}
    np.testing.assert_array_equal(layout.place, lay_out(whole).place)
