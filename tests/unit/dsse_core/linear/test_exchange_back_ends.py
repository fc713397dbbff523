"""The exact exchange on the tree of an area's buses, and dense, gives what the sparse path gives in every function."""

import importlib.util
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.partition import Neighbour
from dsse_core.linear import Backend, choose_backend, pieces
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import EXACT_SIGMA, BoundaryInformation
from dsse_core.linear.contributions import Contribution, CoupledRows, RowsAt, VoltageReadings
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.boundary_marginal import marginal_of
from tests.support.feeders import Feeder, make_feeder, make_star
from tests.support.grids import MeterShares, make_grid
from tests.support.levels import further

has_numba = importlib.util.find_spec("numba") is not None
needs_numba = pytest.mark.skipif(not has_numba, reason="the tree needs numba: pip install 'consensus-dsse[fast]'")
each_back_end = pytest.mark.parametrize(
    "backend",
    [pytest.param("radial", marks=needs_numba), "dense", pytest.param("pieces", marks=pytest.mark.long)],
)

CLOSE = 1e-9  # of a step or a variance; p.u., rad
ROUNDS = 12  # after which every area has received from all the others


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "PIECE", 6)


@dataclass(frozen=True)
class Case:
    """One area in some state, with what it has received, on two back ends."""

    sparse: AreaModel
    other: AreaModel
    x: np.ndarray
    received: Mapping[str, BoundaryInformation]


def cases_of(feeder: Feeder, rng: np.random.Generator, backend: Backend = "radial") -> Iterator[Case]:
    """All areas near the true state, after they have sent each other all they know."""
    truth, telemetry = solve_power_flow(feeder.network), feeder.telemetry()
    models, states = {}, {}
    for area in feeder.partition.areas:
        reference = area.reference[0] if area.reference else None
        model = build_area_model(area, telemetry[area.name], reference, backend="sparse")
        rows = [feeder.network.row[bus.id] for bus in area.network.buses]
        va, vm = truth.va[rows] + rng.normal(0, 1e-3, len(rows)), truth.vm[rows] + rng.normal(0, 1e-3, len(rows))
        if reference is not None:
            va[area.network.row[reference]] = truth.va[feeder.network.row[reference]]
        powers = rng.normal(0, 0.1, model.size - 2 * len(rows))
        models[area.name], states[area.name] = model, np.concatenate([va, vm, powers])
    received: dict[str, dict[str, BoundaryInformation]] = {name: {} for name in models}
    for _ in range(ROUNDS):
        sent = {name: dict(messages) for name, messages in received.items()}
        for name, model in models.items():
            for n in model.area.neighbours:
                sent[n.area][name] = model.linear.information(states[name], n, received[name])
        received = sent
    for name, model in models.items():
        yield Case(model, replace(model, backend=backend), states[name], received[name])


def assert_same(case: Case) -> int:
    """All functions agree; how many of them the tree left to the sparse path."""
    sparse, fast, x, received = case.sparse, case.other, case.x, case.received
    voltages = slice(0, 2 * len(sparse.area.network.buses))
    one, other = (m.linear.step(x, received)[voltages] for m in (sparse, fast))
    np.testing.assert_allclose(other, one, rtol=0, atol=CLOSE * max(abs(one).max(), 1e-3))
    one, other = (m.linear.variances(x, received)[0] for m in (sparse, fast))
    np.testing.assert_allclose(other, one, rtol=CLOSE, atol=1e-20)
    one, other = (m.linear.variances(x, received)[1] / sparse.sigma**2 for m in (sparse, fast))
    np.testing.assert_allclose(other, one, rtol=0, atol=CLOSE)
    for neighbour in sparse.area.neighbours:
        assert_same_information(case, neighbour)
    assert fast.linear.name == fast.backend
    return fast.linear.declined.total()


def assert_same_information(case: Case, neighbour: Neighbour) -> None:
    """What both sides together then know of the boundary is the same, and so is what a message tells alone."""
    one, other = (m.linear.information(case.x, neighbour, case.received) for m in (case.sparse, case.other))
    y, _ = case.sparse.boundary(case.x, neighbour)
    theirs = case.received[neighbour.area]
    (mean, sigma), (other_mean, other_sigma) = (marginal_of(y, sent, theirs) for sent in (one, other))
    assert sigma is not None
    assert other_sigma is not None
    np.testing.assert_allclose(other_sigma, sigma, rtol=1e-8)
    np.testing.assert_allclose(other_mean - y, mean - y, rtol=0, atol=CLOSE * max(abs(mean - y).max(), 1.0))


def test_an_area_that_does_not_determine_itself_tells_its_parent_the_same_at_all_states_within_rounding():
    """Its tableau is singular but for the damping, and rounding may hide that from the elimination."""
    shares = MeterShares(voltage=0.3, angle=0.3, flow=0.3, current=0.2, injection=0.9, boundary_injection=0.0)
    shape = {"chain": 0.6, "decades": 2.0, "loops": 0, "transformers": 0.15, "short": 1e-4, "slack_at_root": True}
    feeder = make_grid(24, n_bus=24, n_area=4, shares=shares, **shape)
    area = feeder.partition.area("area4")
    (parent,) = area.neighbours
    readings = [m for m in feeder.telemetry()["area4"] if m.meter.kind is not MeasurementKind.CURRENT]
    model, n = build_area_model(area, readings, None, backend="sparse"), len(area.network.buses)
    x, rng = np.repeat([0.0, 1.0], n), np.random.default_rng(0)
    largest = [
        np.linalg.norm(model.linear.information(x + 1e-14 * rng.standard_normal(2 * n), parent, {}).R)
        for _ in range(600)
    ]
    np.testing.assert_allclose(largest, np.median(largest), rtol=1e-6)


@pytest.mark.slow
@each_back_end
@pytest.mark.random_cases(few=2, long=12, many=200)
def test_random_feeders_agree(random_seed, backend):
    rng = np.random.default_rng(random_seed)
    size = {"n_bus": int(rng.integers(3, 60)), "n_area": int(rng.integers(2, 8))}
    feeder = make_feeder(random_seed, **size, decades=float(rng.choice([0, 1, 2])))
    for case in cases_of(feeder, rng, backend):
        assert_same(case)


@pytest.mark.slow
@each_back_end
@pytest.mark.random_cases(few=2, long=12, many=200)
def test_grids_with_transformers_shunts_angle_and_current_meters_agree(random_seed, backend):
    rng = np.random.default_rng([1, random_seed])
    shares = MeterShares(angle=float(rng.choice([0, 0.1])), current=float(rng.choice([0, 0.3])))
    n_bus, n_area = int(rng.integers(3, 40)), int(rng.integers(2, 9))
    short = [None, 1e-4, 1e-6][random_seed % 3]
    feeder = make_grid(random_seed, n_bus, n_area, 0.6, 1.0, 0, 0.15, short, bool(random_seed % 2), shares)
    for case in cases_of(feeder, rng, backend):
        assert_same(case)


@pytest.mark.slow
@needs_numba
@pytest.mark.random_cases(few=2, long=12, many=200)
def test_areas_with_a_prior_agree(random_seed):
    """Every voltage counts as measured, beside its own meter or alone, as while a neighbour is silent.

    Beside dense reflections: at an angle meter the sparse tableau keeps six digits of a sigma (seed 67).
    """
    rng = np.random.default_rng([2, random_seed])
    shares = MeterShares(angle=float(rng.choice([0, 0.3])), current=0.0)
    n_bus, n_area = int(rng.integers(3, 40)), int(rng.integers(2, 9))
    feeder = make_grid(random_seed, n_bus, n_area, 0.6, 1.0, 0, 0.15, None, True, shares)
    for case in cases_of(feeder, rng):
        prior = voltages_near(case.x + rng.normal(0, 0.05, len(case.x)), case.other)
        dense, radial = (replace(case.other, backend=backend, further=prior) for backend in ("dense", "radial"))
        assert_same(replace(case, sparse=dense, other=radial))


def voltages_near(x: np.ndarray, model: AreaModel) -> tuple[VoltageReadings]:
    return (VoltageReadings(x[: 2 * len(model.area.network.buses)]),)


def halve_outliers(residual: np.ndarray, sigma: np.ndarray) -> Contribution:
    """A second method: half the weight beyond three sigma, and there a tenth of the residual on top."""
    is_far = (abs(residual) > 3 * sigma) & (sigma > EXACT_SIGMA)
    return Contribution(residual, sigma**-2.0 / np.where(is_far, 2.0, 1.0), np.where(is_far, 0.1 * residual, 0.0))


def injections_of(model: AreaModel, rng: np.random.Generator) -> CoupledRows:
    """A prior on all injections of the area's own buses, with covariances between all of them."""
    own = [bus.id for bus in model.area.network.buses if bus.id not in model.area.not_owned]
    kinds = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    all_read = [Measurement(Meter(kind, bus), 0.0, 0.01) for kind in kinds for bus in own]
    injected = build_area_model(model.area, all_read, model.reference, backend="sparse")
    U = 50 * np.eye(len(all_read)) + rng.normal(0, 10, (len(all_read), len(all_read)))

    def find(x: np.ndarray) -> RowsAt:
        s, H = injected.predict(x), injected.jacobian(x)
        response = np.stack([2 * U @ s, np.zeros(len(s))], axis=1)
        return RowsAt(sp.csr_array(U @ H.toarray()), U @ (0.01 - s), np.ones(len(s)), response)

    return CoupledRows(find)


def full(C: sp.csr_array | np.ndarray) -> np.ndarray:
    return np.asarray(C.toarray() if sp.issparse(C) else C)


def reference_of(
    model: AreaModel, x: np.ndarray, received: Mapping[str, BoundaryInformation]
) -> tuple[np.ndarray, ...]:
    """Step and covariance from one dense factor of all weighted rows, heavy ones first and columns pivoted."""
    own = model.contribution(model.predict(x))
    H, r, root = [full(model.jacobian(x))], [own.residual + own.shift], [own.weight**0.5]
    for further_rows in (rows.at(x) for rows in model.further):
        H, r, root = [*H, further_rows.H.toarray()], [*r, further_rows.residual], [*root, 1 / further_rows.sigma]
    for neighbour in model.area.neighbours:
        y, T = model.boundary(x, neighbour)
        R, z = received[neighbour.area].rows
        H, r, root = [*H, R @ full(T)], [*r, z - R @ y], [*root, np.ones(len(z))]
    rows = np.concatenate(root)[:, None] * np.column_stack([np.concatenate(H)[:, model.free], np.concatenate(r)])
    rows = rows[np.argsort(-abs(rows[:, :-1]).max(axis=1))]
    Q, triangle, order = scipy.linalg.qr(rows[:, :-1], mode="economic", pivoting=True)
    inverse, dx, F = scipy.linalg.inv(triangle), np.zeros(model.size), np.zeros((model.size, len(model.free)))
    dx[model.free[order]], F[model.free[order]] = inverse @ (Q.T @ rows[:, -1]), inverse
    return dx, F @ F.T


@needs_numba
@pytest.mark.parametrize("seed", [2, 3])
def test_a_second_method_and_further_rows_are_those_of_the_dense_reference_on_all_back_ends(seed):
    rng = np.random.default_rng(seed)
    for case in cases_of(make_feeder(seed, n_bus=24, n_area=3, decades=1.0), rng):
        x = case.x + rng.normal(0, 0.01, len(case.x)) * (
            np.arange(len(case.x)) < 2 * len(case.sparse.area.network.buses)
        )
        x[case.sparse.fixed] = case.x[case.sparse.fixed]
        prior = voltages_near(case.x, case.sparse)
        for further_rows in ((), prior, (*prior, injections_of(case.sparse, rng))):
            asked = replace(case.sparse, method=halve_outliers, further=further_rows)
            assert asked.contribution(asked.predict(x)).shift.any()
            dx, covariance = reference_of(asked, x, case.received)
            variance = covariance.diagonal()
            for backend in ("sparse", "dense", "pieces", "radial"):
                model = replace(asked, backend=backend)
                n = 2 * len(model.area.network.buses)
                assert model.linear.name.startswith("dense" if len(further_rows) == 2 else backend)
                found = model.linear.step(x, case.received)
                np.testing.assert_allclose(found[:n], dx[:n], rtol=0, atol=1e-7 * abs(dx[:n]).max())
                found, _ = model.linear.variances(x, case.received)
                np.testing.assert_allclose(found[:n], variance[:n], rtol=1e-6, atol=1e-17)
                B = rng.normal(size=(3, n)) @ np.eye(n, model.size)
                found, expected = model.linear.covariance(x, case.received, B), B @ covariance @ B.T
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.diagonal().max())
                for neighbour in model.area.neighbours:
                    assert_same_information(Case(asked, model, x, case.received), neighbour)


@needs_numba
def test_a_model_read_anew_has_the_prior_of_now_and_forgets_the_former_one():
    case = next(cases_of(make_feeder(5, n_bus=60, n_area=6, decades=1.0), np.random.default_rng(5)))
    readings = [Measurement(m, z, s) for m, z, s in zip(case.other.meters, case.other.z, case.other.sigma, strict=True)]
    plain = case.other.linear.step(case.x, case.received)
    prior = voltages_near(case.x + 0.1, case.other)
    with_prior = case.other.with_readings(readings, prior)
    expected = replace(case.sparse, further=prior).linear.step(case.x, case.received)
    step = with_prior.linear.step(case.x, case.received)
    np.testing.assert_allclose(step, expected, rtol=0, atol=CLOSE)
    assert abs(step - plain).max() > 1e-6
    np.testing.assert_array_equal(with_prior.with_readings(readings).linear.step(case.x, case.received), plain)


@pytest.mark.slow
@each_back_end
@pytest.mark.parametrize("busbar", [False, *further(True)])
def test_fifteen_areas_at_one_bus_agree(busbar, backend):
    for case in cases_of(make_star(3, busbar=busbar), np.random.default_rng(3), backend):
        assert_same(case)


@needs_numba
def test_where_injections_are_measured_the_tree_answers_all_those_of_the_substations_area_with_a_prior_included():
    for case in cases_of(make_feeder(5, n_bus=60, n_area=6, decades=1.0), np.random.default_rng(5)):
        assert assert_same(case) == 0
        if case.other.reference is not None:
            assert case.other.reference not in case.other.area.boundary_buses
            prior = voltages_near(case.x + 0.01, case.other)
            dense, radial = (replace(case.other, backend=backend, further=prior) for backend in ("dense", "radial"))
            assert assert_same(replace(case, sparse=dense, other=radial)) == 0


@needs_numba
def test_an_unmetered_bus_is_left_to_the_sparse_path_where_digits_would_be_lost_and_that_is_counted():
    feeder = make_grid(3, 30, 4, 0.6, 1.0, 0, 0.0, None, True, MeterShares(injection=0.8))
    declined = sum(assert_same(case) for case in cases_of(feeder, np.random.default_rng(4)))
    assert declined > 0


@needs_numba
def test_the_back_end_is_the_tree_for_large_radial_areas_only():
    small = make_feeder(1, n_bus=20, n_area=1).partition.areas[0]
    large = make_feeder(1, n_bus=80, n_area=1).partition.areas[0]
    assert [choose_backend(small), choose_backend(small, "radial")] == ["dense", "radial"]
    assert [choose_backend(large), choose_backend(large, "sparse")] == ["radial", "sparse"]
    meshed = make_grid(2, 30, 1, 0.3, 0.0, 3, 0.0, None, True, MeterShares()).partition.areas[0]
    assert len(meshed.network.active_branches) >= len(meshed.network.buses)
    assert choose_backend(meshed, "radial") == "sparse"


def test_small_areas_are_dense_unless_asked_otherwise():
    small, large = (make_feeder(1, n_bus=n_bus, n_area=1).partition.areas[0] for n_bus in (20, 80))
    assert build_area_model(small, (), None).linear.name == "dense"
    assert build_area_model(small, (), None, backend="sparse").linear.name == "sparse"
    assert build_area_model(large, (), None).linear.name != "dense"


@pytest.mark.parametrize("backend", [pytest.param("radial", marks=needs_numba), "sparse", "dense", "pieces"])
def test_the_same_meters_read_anew_give_what_a_new_model_gives(backend):
    feeder = make_feeder(7, n_bus=20, n_area=1)
    (area,) = feeder.partition.areas
    first = feeder.telemetry()[area.name]
    second = [replace(m, value=m.value + 0.01, sigma=2 * m.sigma) for m in first]
    reference = area.reference[0]
    built, old = (build_area_model(area, readings, reference, backend=backend) for readings in (second, first))
    x = np.r_[np.zeros(20), np.ones(20)]
    before = old.linear.step(x, {})
    np.testing.assert_array_equal(old.with_readings(second).linear.step(x, {}), built.linear.step(x, {}))
    np.testing.assert_array_equal(old.linear.step(x, {}), before)
    assert abs(built.linear.step(x, {}) - before).max() > 1e-6


@pytest.mark.parametrize("backend", ["sparse", "dense"])
def test_rows_are_found_once_for_a_state_and_never_those_of_another(backend: Backend):
    feeder = make_feeder(1, n_bus=12, n_area=3)
    case = next(case for case in cases_of(feeder, np.random.default_rng(0), "dense") if case.sparse.area.parent)
    model, x, parent = replace(case.sparse, backend=backend), case.x.copy(), case.sparse.area.parent
    assert np.shares_memory(
        *(H if backend == "dense" else H.data for H in (model.jacobian(x), model.jacobian(x.copy())))
    )
    before = model.predict(x).copy(), model.boundary(x, parent)[0].copy()
    x += 1e-3
    fresh = replace(model)
    assert abs(model.predict(x) - before[0]).max() > 1e-6
    assert abs(model.boundary(x, parent)[0] - before[1]).max() > 1e-6
    np.testing.assert_array_equal(model.predict(x), fresh.predict(x))
    np.testing.assert_array_equal(model.boundary(x, parent)[0], fresh.boundary(x, parent)[0])


def test_the_factor_of_an_area_on_a_tree_is_hardly_fuller_than_its_rows():
    feeder = make_feeder(2, n_bus=400, n_area=1, decades=1.0)
    (area,) = feeder.partition.areas
    model = build_area_model(area, feeder.telemetry()[area.name], area.reference[0], backend="sparse")
    x = np.concatenate([np.zeros(400), np.ones(400)])
    H, _, sigma = model.linear.stack(x, {})
    factor = model.linear.factor(H, sigma, model.free)
    entries = factor._lu.L.nnz + factor._lu.U.nnz
    assert entries < 1.8 * (2 * H[:, model.free].nnz + 2 * (len(sigma) + len(model.free)))
