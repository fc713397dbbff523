"""Many scans at once: each row comes to what ``estimate_with_plan`` finds alone, or fails as it does."""

import re
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import DsseError, EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.batch import FailureCode, estimate_batch
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.grids import MeterShares, make_grid

Kind = MeasurementKind
CODE_OF = {
    InvalidInputError: FailureCode.INVALID,
    NotObservableError: FailureCode.UNOBSERVABLE,
    EstimationDivergedError: FailureCode.DIVERGED,
}


def scans_of(network, backend, n_row, seed=0, kinds=(Kind.VM, Kind.P_INJECTION, Kind.Q_INJECTION)):
    """A plan for meters at all buses and on all branches, and random readings, (n_row, n_meas)."""
    rng = np.random.default_rng(seed)
    meters = [Meter(kind, bus.id) for bus in network.buses for kind in kinds if not kind.of_branch]
    meters += [Meter(kind, b.from_bus, b.id) for b in network.active_branches for kind in (Kind.P_FLOW, Kind.Q_FLOW)]
    exact = solve_power_flow(network).read_all(meters)
    sigmas = np.array([0.002 if meter.kind is Kind.VM else 0.01 for meter in meters])
    values = exact + sigmas * rng.standard_normal((n_row, len(meters)))
    return build_estimation_plan(network, meters, backend=backend), values, sigmas


def scans_with_zero_injections(network, backend, zero_injections, n_row):
    """As ``scans_of``, with the zero injections of ``network`` known to be exact."""
    taken = {meter.id for meter in zero_injections(network)}
    plan, values, sigmas = scans_of(network, backend, n_row)
    meters = [replace(m, source=Source.VIRTUAL) if m.id in taken else m for m in plan.meters]
    plan = build_estimation_plan(network, meters, backend=backend)
    values[:, plan.virtual] = 0.0
    return plan, values, sigmas


def estimate_alone(plan, values, sigmas, start):
    """The single estimate, without the meters that are missing, or what it raises."""
    there = ~np.isnan(values)
    try:
        plan = plan if there.all() else plan.without(np.flatnonzero(~there).tolist())
        return estimate_with_plan(plan, values[there], sigmas[there], start=start)
    except DsseError as error:
        return error


def assert_rows_are_single_estimates(plan, batch, values, sigmas, start=None):
    for k in range(len(values)):
        begin = None if start is None else tuple(part if part.ndim == 1 else part[k] for part in start)
        alone = estimate_alone(plan, values[k], sigmas if sigmas.ndim == 1 else sigmas[k], begin)
        if isinstance(alone, DsseError):
            assert batch.failures[k].code is CODE_OF[type(alone)]
            assert batch.failures[k].text == str(alone)
            assert np.isnan(batch.vm[k]).all()
            assert np.isnan(batch.va[k]).all()
            assert np.isnan(batch.objective[k])
            assert batch.iterations[k] == 0
            continue
        assert k not in batch.failures
        np.testing.assert_allclose(batch.vm[k], alone.vm, rtol=0, atol=1e-12)
        np.testing.assert_allclose(batch.va[k], alone.va, rtol=0, atol=1e-12)
        assert batch.objective[k] == pytest.approx(alone.objective, rel=1e-9, abs=1e-9)
        assert batch.iterations[k] == alone.iterations
        assert batch.degrees_of_freedom[k] == alone.degrees_of_freedom


@pytest.mark.parametrize("threads", [1, 2])
def test_rows_of_a_batch_are_the_single_estimates(backend, case, threads):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 40)
    batch = estimate_batch(plan, values, sigmas, threads=threads)
    assert not batch.failures
    assert_rows_are_single_estimates(plan, batch, values, sigmas)


def test_rows_may_have_sigmas_and_starts_of_their_own(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 6)
    of_rows = sigmas * np.random.default_rng(1).uniform(0.5, 2.0, values.shape)
    first = estimate_batch(plan, values, sigmas)
    for start in ((first.vm[0], first.va[0]), (first.vm, first.va)):
        batch = estimate_batch(plan, values, of_rows, start=start)
        assert_rows_are_single_estimates(plan, batch, values, of_rows, start)


def test_rows_side_by_side_may_have_starts_of_their_own(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 16)
    first = estimate_batch(plan, values, sigmas)
    for start in ((first.vm[0], first.va[0]), (first.vm, first.va)):
        batch = estimate_batch(plan, values, sigmas, start=start)
        assert_rows_are_single_estimates(plan, batch, values, sigmas, start)


def test_a_row_unlike_the_others_is_estimated_beside_them(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 41)
    alike = estimate_batch(plan, values, sigmas)
    values[3, 0] = np.nan
    values[12, 2] = np.inf
    values[20, 0] = 0.0  # a dead voltmeter: the first step is shortened
    values[28] *= 30.0  # no state of any grid
    batch = estimate_batch(plan, values, sigmas)
    assert_rows_are_single_estimates(plan, batch, values, sigmas)
    others = np.delete(np.arange(41), [3, 12, 20, 28])
    np.testing.assert_allclose(batch.vm[others], alike.vm[others], rtol=0, atol=1e-12)


def test_injections_that_hold_exactly_do_so_in_rows_side_by_side(backend, case, zero_injections):
    plan, values, sigmas = scans_with_zero_injections(case("industrial13"), backend, zero_injections, 24)
    values[9, np.flatnonzero(plan.virtual)[0]] = 0.5
    batch = estimate_batch(plan, values, sigmas)
    assert list(batch.failures) == [9]
    assert_rows_are_single_estimates(plan, batch, values, sigmas)


def test_a_row_that_fails_does_not_disturb_its_neighbours(backend, case):
    network = case("ieee33")
    plan, values, sigmas = scans_of(network, backend, 12)
    of_rows = np.tile(sigmas, (12, 1))
    values[1, 3] = np.inf
    of_rows[3, 5] = 0.0
    values[5, 0] = 1e9
    of_last_bus = [k for k, m in enumerate(plan.meters) if m.bus in (17, 18) or m.branch == "17-18"]
    values[7, of_last_bus] = np.nan
    values[9, [0, 40, 77]] = np.nan
    values[11] = np.nan
    batch = estimate_batch(plan, values, of_rows, threads=2)
    assert_rows_are_single_estimates(plan, batch, values, of_rows)
    assert {k: failure.code for k, failure in batch.failures.items() if k != 5} == {
        1: FailureCode.INVALID,
        3: FailureCode.INVALID,
        7: FailureCode.UNOBSERVABLE,
        11: FailureCode.UNOBSERVABLE,
    }
    assert plan.meters[3].id in batch.failures[1].text
    assert "bus 18" in batch.failures[7].text


def test_a_missing_reading_does_not_fall_back_to_that_of_the_row_before(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 3)
    values[1] = values[2] = values[0]
    values[1, 0] = np.nan
    batch = estimate_batch(plan, values, sigmas, threads=1)
    assert abs(batch.vm[1] - batch.vm[0]).max() > 1e-7
    np.testing.assert_array_equal(batch.vm[2], batch.vm[0])


def test_a_virtual_reading_other_than_zero_fails_its_row(backend, case, zero_injections):
    plan, values, sigmas = scans_with_zero_injections(case("industrial13"), backend, zero_injections, 3)
    values[1, np.flatnonzero(plan.virtual)[0]] = 0.5
    batch = estimate_batch(plan, values, sigmas)
    assert list(batch.failures) == [1]
    assert_rows_are_single_estimates(plan, batch, values, sigmas)


def test_the_numbers_do_not_depend_on_the_threads(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 50)
    one, two = (estimate_batch(plan, values, sigmas, threads=threads) for threads in (1, 2))
    for name in ("vm", "va", "objective", "iterations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_no_rows_give_no_estimates(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 1)
    batch = estimate_batch(plan, values[:0], sigmas)
    assert batch.vm.shape == (0, 33)
    assert not batch.failures


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda values, sigmas: (values[:, :-1], sigmas, None), "values have shape"),
        (lambda values, sigmas: (values[0], sigmas, None), "values have shape"),
        (lambda values, sigmas: (values, sigmas[:-1], None), "sigmas have shape"),
        (lambda values, sigmas: (values, sigmas, (np.ones(3), np.zeros(3))), "the start has shapes"),
        (lambda values, sigmas: (values, 0 * sigmas, None), "sigma is 0.0"),
    ],
    ids=["few values", "one row", "few sigmas", "short start", "sigmas of zero"],
)
def test_a_batch_that_does_not_fit_its_plan_is_rejected(case, change, named):
    plan, values, sigmas = scans_of(case("ieee33"), "sparse", 2)
    values, sigmas, start = change(values, sigmas)
    with pytest.raises(InvalidInputError, match=named):
        estimate_batch(plan, values, sigmas, start=start)


@pytest.mark.parametrize("threads", [0, -1, 1.5, "2"])
def test_a_number_of_threads_that_cannot_be_is_rejected(case, threads):
    plan, values, sigmas = scans_of(case("ieee33"), "sparse", 1)
    with pytest.raises(InvalidInputError, match="threads"):
        estimate_batch(plan, values, sigmas, threads=threads)


@pytest.mark.parametrize("sigma", [5e-324, 1e-160, 1e160])
def test_no_estimate_rests_on_a_sigma_whose_square_is_no_number(backend, case, sigma):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 9)
    of_rows = np.tile(sigmas, (9, 1))
    sigmas[4] = of_rows[2, 4] = sigma
    with pytest.raises(InvalidInputError, match=re.escape(f"sigma is {sigma}")):
        estimate_with_plan(plan, values[0], sigmas)
    with pytest.raises(InvalidInputError, match=re.escape(f"sigma is {sigma}")):
        estimate_batch(plan, values, sigmas)
    assert list(estimate_batch(plan, values, of_rows).failures) == [2]


def test_what_is_behind_a_mask_is_missing_and_no_reading(backend, case):
    plan, values, sigmas = scans_of(case("ieee33"), backend, 9)
    masked = np.ma.masked_array(values.copy(), mask=np.zeros(values.shape, dtype=bool))
    masked.data[4, 0], masked.mask[4, 0] = 17.0, True
    values[4, 0] = np.nan
    found, expected = (estimate_batch(plan, readings, sigmas) for readings in (masked, values))
    assert not found.failures
    np.testing.assert_array_equal(found.vm, expected.vm)
    with pytest.raises(InvalidInputError, match="the value is nan"):
        estimate_with_plan(plan, masked[4], sigmas)


def test_rows_that_lack_all_current_magnitudes_are_estimated_as_without_these_meters(case):
    network = case("ieee33")
    plan, values, sigmas = scans_of(network, "radial", 9)
    currents = [Meter(Kind.CURRENT, b.from_bus, b.id) for b in network.active_branches[:5]]
    read = solve_power_flow(network).read_all(currents)
    plan = build_estimation_plan(network, [*plan.meters, *currents], backend="radial")
    values = np.hstack([values, np.tile(read, (9, 1))])
    sigmas = np.append(sigmas, np.full(5, 0.01))
    values[2:4, -5:] = np.nan
    values[5, -1] = np.nan
    assert_rows_are_single_estimates(plan, estimate_batch(plan, values, sigmas), values, sigmas)


@pytest.mark.random_cases(few=5, long=15, many=500)
def test_batches_of_any_grid_are_the_single_estimates(random_seed):
    rng = np.random.default_rng([random_seed, 77])
    backend = "radial" if random_seed % 3 else "sparse"
    if backend == "radial":
        pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    shares = MeterShares(voltage=0.5, angle=0.2, flow=0.8, current=float(rng.choice([0, 0.3])))
    grid = make_grid(
        random_seed, n_bus=int(rng.integers(2, 40)), n_area=1, chain=rng.random(), decades=0.0,
        loops=0 if backend == "radial" else 2, transformers=0.2, short=None, slack_at_root=True, shares=shares,
    )  # fmt: skip
    meters = [m.meter for m in grid.measurements]
    plan = build_estimation_plan(grid.network, meters, backend=backend)
    z, sigmas = np.array([(m.value, m.sigma) for m in grid.measurements]).T
    values = z + 0.3 * sigmas * rng.standard_normal((19, len(z)))  # of which 8 to 15 are done side by side
    values[2, rng.integers(len(z))] = np.nan
    values[4, rng.random(len(z)) < 0.2] = np.nan
    values[5, ~plan.virtual] += rng.choice([0, 1e3]) * rng.standard_normal((~plan.virtual).sum())
    batch = estimate_batch(plan, values, sigmas, threads=2)
    has_currents = any(meter.kind is Kind.CURRENT for meter in meters)
    for k in (0, 1, 3) if has_currents else range(19):  # without its last current another rule ends the iteration
        only = replace(
            batch, vm=batch.vm[k : k + 1], va=batch.va[k : k + 1], objective=batch.objective[k : k + 1],
            iterations=batch.iterations[k : k + 1], degrees_of_freedom=batch.degrees_of_freedom[k : k + 1],
            failures={0: batch.failures[k]} if k in batch.failures else {},
        )  # fmt: skip
        assert_rows_are_single_estimates(plan, only, values[k : k + 1], sigmas)


def test_rows_side_by_side_go_to_as_many_threads_as_have_room_in_the_cache(case, monkeypatch):
    pytest.importorskip("numba")
    from dsse_core.estimation import batch as batch_module
    from dsse_core.radial.together import count_bytes

    plan, values, sigmas = scans_of(case("case33bw"), "radial", 16)
    asked = []
    monkeypatch.setattr(batch_module, "share_out", lambda n_row, threads, *_, **__: asked.append(threads))
    monkeypatch.setattr(batch_module, "CACHE_BYTES", 2 * count_bytes(33))
    estimate_batch(plan, values, sigmas, threads=4)
    monkeypatch.setattr(batch_module, "CACHE_BYTES", 1)
    estimate_batch(plan, values, sigmas, threads=4)
    estimate_batch(plan, values, np.tile(sigmas, (16, 1)), threads=4)  # row by row
    assert asked == [2, 1, 4]


@pytest.mark.parametrize("threads", [1, 2])
def test_memory_of_the_tree_goes_back_to_the_plan_for_the_next_scan(case, threads):
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    plan, values, sigmas = scans_of(case("ieee33"), "radial", 16)
    alone = estimate_with_plan(plan, values[0], sigmas)
    (kept,) = plan.radial.spaces
    estimate_batch(plan, values, sigmas, threads=threads)
    assert len(plan.radial.spaces) in range(1, threads + 1)
    assert any(space is kept for space in plan.radial.spaces)
    number = len(plan.radial.spaces)
    with pytest.raises(InvalidInputError):
        estimate_with_plan(plan, np.full_like(values[0], np.nan), sigmas)
    assert len(plan.radial.spaces) == number
    again = estimate_with_plan(plan, values[0], sigmas)
    np.testing.assert_array_equal(again.vm, alone.vm)
