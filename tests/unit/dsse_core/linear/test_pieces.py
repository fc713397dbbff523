"""An area eliminated in pieces along its tree is the area eliminated in one dense piece."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest

from dsse_core.grid.division import build_partition
from dsse_core.grid.network import Network
from dsse_core.linear import choose, pieces
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import EXACT_SIGMA, BoundaryInformation
from dsse_core.linear.dense import DenseRows
from dsse_core.linear.interface import NOT_YET, Received
from dsse_core.linear.pieces import divide_tree
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.reflections import turn_alone
from dsse_core.linear.sparse import SparseRows
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.centre import assert_goes_the_centres_way, assert_is_the_centres, trace_centre
from tests.support.grown_feeders import SOURCE, cut_at, cut_feeder, grow_feeder, read_feeder
from tests.support.ieee_feeders import load_feeder
from tests.support.levels import further
from tests.support.phases import DEEP, make_feeder, read_meters, run_rounds

SAME = 1e-10  # of steps, p.u. and rad
SIGMA = 1e-6  # relative
SENT = 1e-5  # sigmas of y; exact rows alone leave rounding of 1e-6


def areas_of(
    network: Network, areas: Mapping[str, Sequence[int]], seed: int, decades: float
) -> Iterator[tuple[AreaModel, np.ndarray, Received]]:
    """The areas of a feeder near its power flow, with all that they have received from each other."""
    readings, flow = read_feeder(network, seed, decades), solve_power_flow(network)
    partition, rng, found = build_partition(network, areas), np.random.default_rng(seed), {}
    by_area = partition.split_meters([m.meter for m in readings])
    for area in partition.areas:
        own = [readings[k] for k in by_area[area.name].tolist()]
        model = build_area_model(area, own, area.reference[0] if area.reference else None, backend="dense")
        rows = partition.rows_of_nodes[area.name]
        x = np.concatenate([flow.va[rows], flow.vm[rows], np.zeros(model.size - 2 * len(rows))])
        x += rng.normal(0, 1e-3, len(x))
        x[model.fixed] = flow.va[rows][model.fixed]
        found[area.name] = model, x
    received: dict[str, Received] = {name: {} for name in found}
    for _ in found:
        told: dict[str, dict[str, BoundaryInformation]] = {name: {} for name in found}
        for name, (model, x) in found.items():
            for n in model.area.neighbours:
                told[n.area][name] = model.linear.information(x, n, received[name])
        received = {**told}
    for name, (model, x) in found.items():
        yield model, x, received[name]


def assert_same(model: AreaModel, x: np.ndarray, received: Received) -> None:
    """All that an area's solver finds is the same in pieces as in one dense piece."""
    one, many = ReducedSolver(model, DenseRows(model), "one"), ReducedSolver(model, SparseRows(model), "many")
    step = one.step(x, received)
    np.testing.assert_allclose(many.step(x, received), step, rtol=0, atol=SAME * max(1.0, abs(step).max()))
    np.testing.assert_allclose(many.step(x, received, 1.0), one.step(x, received, 1.0), rtol=0, atol=SAME)
    (state, residual), (of_state, of_residual) = (by.variances(x, received) for by in (one, many))
    np.testing.assert_allclose(of_state, state, rtol=SIGMA, atol=EXACT_SIGMA**2)
    np.testing.assert_allclose(of_residual / model.sigma**2, residual / model.sigma**2, rtol=SIGMA, atol=SAME)
    B = np.random.default_rng(0).normal(size=(3, model.size))
    B[:, model.fixed] = 0.0
    np.testing.assert_allclose(many.covariance(x, received, B), one.covariance(x, received, B), rtol=SIGMA)
    for n in model.area.neighbours:
        sent, of_many = (by.information(x, n, received) for by in (one, many))
        (L, g), (of_L, of_g) = (_weigh(of, model.boundary_values(x, n)) for of in (sent, of_many))
        scale = 1 / np.sqrt(L.diagonal() + NOT_YET)
        np.testing.assert_allclose(np.outer(scale, scale) * of_L, np.outer(scale, scale) * L, rtol=0, atol=SIGMA)
        np.testing.assert_allclose(scale * of_g, scale * g, rtol=0, atol=SENT * max(1.0, abs(scale * g).max()))


def _weigh(sent: BoundaryInformation, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The information matrix, and its gradient at y."""
    return sent.R.T @ sent.R, sent.R.T @ (sent.z - sent.R @ y)


@pytest.mark.parametrize("size", [6, *further(1, 3, 20, 60)])
@pytest.mark.random_cases(few=1, long=5, many=100)
def test_pieces_of_any_size_give_what_one_dense_piece_gives(
    random_seed: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pieces, "PIECE", size)
    network = grow_feeder(random_seed, 60)
    for of_area in areas_of(network, cut_feeder(network, 20), random_seed, decades=float(random_seed % 3)):
        assert_same(*of_area)


@pytest.mark.parametrize("size", [20, *further(10, 30, 60)])
@pytest.mark.parametrize("tops", [(), *further((60, 97))], ids=len)
def test_ieee123_in_pieces_is_what_it_is_in_one(
    size: int, tops: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pieces, "PIECE", size)
    network = load_feeder("ieee123")
    for of_area in areas_of(network, cut_at(network, tops), 1, decades=1.0):
        assert_same(*of_area)


@pytest.mark.random_cases(few=1, long=5, many=100)
def test_areas_in_pieces_go_the_centres_way_to_its_estimate(random_seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "PIECE", 6)
    monkeypatch.setattr(choose, "PIECES_FROM", 0)
    network = grow_feeder(random_seed, 60)
    partition, readings = build_partition(network, cut_feeder(network, 20)), read_feeder(network, random_seed, 1.0)
    report, verdicts, states = trace_centre(network, readings)
    rounds = run_rounds(partition, readings)
    assert {side.model.linear.name for side in rounds.estimations.values()} == {"pieces"}
    after = {k: state for k, state in enumerate(rounds.states) if rounds.verdicts[k] != "anew"}  # the centre's new plan
    assert [rounds.verdicts[k] for k in after] == verdicts
    assert_is_the_centres(rounds, partition, report)
    for of_areas, x in zip(after.values(), states, strict=True):
        for name, rows in partition.rows_of_nodes.items():
            assert abs(of_areas[name] - x[np.concatenate([rows, network.n_nodes + rows])]).max() < 1e-7


def test_areas_in_pieces_meet_at_buses_with_legs_between_phases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "PIECE", 3)
    monkeypatch.setattr(choose, "PIECES_FROM", 0)
    network = make_feeder(between={645: ("bc",), 671: ("ab", "bc", "ac"), 675: ("ab",), 692: ("ab", "bc", "ac")})
    for decades in (0.0, 3.0):
        readings = read_meters(network, 2, decades, is_rich=False)
        assert_goes_the_centres_way(build_partition(network, DEEP), readings)


@pytest.mark.parametrize("size", [6, *further(1, 20)])
def test_areas_in_pieces_name_the_buses_that_no_meter_determines_as_dense_ones_do(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = grow_feeder(3, 60)
    partition, lost = build_partition(network, cut_feeder(network, 20)), {b.id for b in network.buses[-2:]}
    readings = [m for m in read_feeder(network, 3) if m.meter.bus not in lost and m.meter.branch is None]
    found = []
    for smallest in (10**9, 0):
        monkeypatch.setattr(pieces, "PIECE", size)
        monkeypatch.setattr(choose, "PIECES_FROM", smallest)
        rounds = run_rounds(partition, readings)
        assert rounds.verdicts[-1] == "final unobservable"
        found.append({name: side.unobservable for name, side in rounds.estimations.items()})
    assert found[0] == found[1]
    assert lost <= {bus for buses in found[1].values() for bus in buses}


def test_the_division_of_a_tree_has_pieces_of_the_size_asked_for_and_none_above_a_piece_below_it() -> None:
    network = grow_feeder(1, 300)
    table = network.table
    piece = divide_tree(table, SOURCE)
    nodes = np.bincount(piece, np.bincount(table.nodes.item))
    assert (piece >= 0).all()
    assert 0.5 * pieces.PIECE < np.median(nodes) <= nodes.max() < 3 * pieces.PIECE
    assert (piece[table.f] >= piece[table.t]).all()  # branches of the feeder lead away from the source


def test_an_exact_row_without_variables_of_a_piece_keeps_none_by_rounding() -> None:
    rows = 1e9 * np.array([[1e3 / 3, 2e3 / 7, 0.1, 0.0], [1e3 / 9, 2e3 / 21, 0.7, 0.0]])
    rows[1, :2] *= 1 + 1e-16
    turned, above = turn_alone(rows, 2)
    assert above == 1
    assert not turned[1, :2].any()
    np.testing.assert_allclose(abs(turned[1, 2]), 1e9 * (0.7 - 0.1 / 3) / np.hypot(1.0, 1 / 3), rtol=1e-12)


def test_a_light_exact_row_is_told_from_heavy_ones_and_keeps_its_variable() -> None:
    turned, above = turn_alone(1e9 * np.array([[1e6, 0.0, 1.0, 0.0], [0.0, 1e-3, 1.0, 0.0]]), 2, pieces.LIGHT)
    assert above == 1
    np.testing.assert_allclose(abs(turned[1]), [0.0, 1e6, 1e9, 0.0])
