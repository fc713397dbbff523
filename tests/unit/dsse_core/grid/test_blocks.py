"""Blocks are what no single bus can part: compared with networkx on random grids with loops and parallel branches."""

import networkx as nx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsse_core.errors import InvalidInputError
from dsse_core.grid.biconnected import find_blocks
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network


def grid(*ends, slack=1, open_branches=()):
    """A network with branches between the given bus pairs; those whose position is in ``open_branches`` are open."""
    buses = sorted({bus for pair in ends for bus in pair} | {slack})
    branches = tuple(
        Branch(f"b{k}", *pair, 0.01, 0.01, in_service=k not in open_branches) for k, pair in enumerate(ends)
    )
    return Network("grid", 1.0, tuple(Bus(b, 10.0) for b in buses), branches, (Generator(slack, Control.SLACK),))


@st.composite
def connected_grids(draw, largest=14):
    """A random tree with chords, some of them parallel to branches of the tree."""
    n = draw(st.integers(2, largest))
    ends = [(draw(st.integers(1, k - 1)), k) for k in range(2, n + 1)]
    for _ in range(draw(st.integers(0, 5))):
        a, b = draw(st.integers(1, n)), draw(st.integers(1, n))
        if a != b:
            ends.append((a, b))
    return grid(*draw(st.permutations(ends)), slack=draw(st.integers(1, n)))


@settings(max_examples=200, deadline=None)
@given(connected_grids())
def test_blocks_are_the_biconnected_components(network):
    simple = nx.Graph((b.from_bus, b.to_bus) for b in network.branches)
    expected = {frozenset(component) for component in nx.biconnected_components(simple)}
    blocks = find_blocks(network)
    assert {frozenset((block.top, *block.buses)) for block in blocks} == expected
    assert sorted(b for block in blocks for b in block.branches) == sorted(b.id for b in network.branches)


@settings(max_examples=100, deadline=None)
@given(connected_grids())
def test_every_bus_but_the_substation_is_below_one_block_and_blocks_come_before_the_one_above(network):
    blocks = find_blocks(network)
    below = [bus for block in blocks for bus in block.buses]
    assert sorted([*below, network.slack.bus]) == sorted(network.row)
    position = {bus: i for i, block in enumerate(blocks) for bus in block.buses}
    for i, block in enumerate(blocks):
        assert block.top == network.slack.bus or position[block.top] > i


def test_parallel_branches_are_a_loop_and_open_ones_are_not_there():
    (double, single) = find_blocks(grid((1, 2), (2, 3), (2, 3), (3, 1), open_branches=(3,)))
    assert double.branches == ("b1", "b2")
    assert single.branches == ("b0",)


def test_a_chain_of_thousands_of_buses_needs_no_recursion():
    assert len(find_blocks(grid(*((k, k + 1) for k in range(1, 5000))))) == 4999


def test_a_grid_without_substation_or_with_unreached_buses_has_no_blocks():
    with pytest.raises(InvalidInputError, match="no path of branches in service joins bus 3"):
        find_blocks(grid((1, 2), (2, 3), open_branches=(1,)))
    bare = Network("bare", 1.0, (Bus(1, 10.0), Bus(2, 10.0)), (Branch("1-2", 1, 2, 0.1, 0.1),))
    with pytest.raises(InvalidInputError, match="no slack bus"):
        find_blocks(bare)
