"""The tableau of a network with loops, eliminated bus by bus: little is filled in, and any order gives the same."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.matrices import augmented, selected_inverse
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern

Kind = MeasurementKind


@pytest.fixture(params=[pytest.param("compiled", marks=pytest.mark.slow), "superlu"])
def numerics(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both by which a tableau in a given order is eliminated, for tableaus of any size."""
    if request.param == "compiled":
        pytest.importorskip("numba")
    monkeypatch.setattr(augmented, "FEWEST_COMPILED", 0 if request.param == "compiled" else 10**9)
    return str(request.param)


@pytest.fixture
def superlu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(augmented, "FEWEST_COMPILED", 10**9)


def looped(seed: int, n: int, ties: int, farthest: int = 20) -> Network:
    rng = np.random.default_rng(seed)
    tree = [(int(rng.integers(max(1, k - 8), k + 1)), k + 1) for k in range(1, n)]
    near = [(int(k), int(k + rng.integers(2, farthest))) for k in rng.integers(1, n - farthest, ties)]
    pairs = [*tree, *(pair for pair in near if pair not in tree)]
    branches = tuple(Branch(f"{k}", *pair, *rng.uniform(0.001, 0.03, 2)) for k, pair in enumerate(pairs))
    buses = tuple(Bus(k + 1, 20.0, p_load=0.01 * (k % 7 > 0)) for k in range(n))
    return Network("looped", 10.0, buses, branches, (Generator(1, Control.SLACK),))


def system_of(network: Network, seed: int) -> tuple[sp.csr_array, np.ndarray, AugmentedPattern]:
    """H at the flat start, sigmas and the pattern of its free columns; every seventh bus injects exactly nothing."""
    injected = (Kind.P_INJECTION, Kind.Q_INJECTION)
    meters = [Meter(Kind.VM, bus.id) for bus in network.buses[::10]]
    for bus in network.buses:
        source = Source.TELEMETERED if bus.p_load else Source.VIRTUAL
        meters += [Meter(kind, bus.id, source=source) for kind in injected]
    flows = (Kind.P_FLOW, Kind.Q_FLOW)
    meters += [Meter(kind, branch.from_bus, branch.id) for branch in network.branches[::3] for kind in flows]
    plan = build_estimation_plan(network, meters, backend="sparse")
    sigma = np.where(plan.virtual, 0.0, 10.0 ** np.random.default_rng(seed).uniform(-4, -2, len(meters)))
    linear = plan.sparse
    H = linear.rows.jacobian(linear.flat)
    pattern = linear.rows.pattern(H, linear.model.free)
    assert pattern.is_compiled == linear.is_compiled  # decided before the first estimate
    return H, sigma, pattern


@pytest.mark.usefixtures("numerics")
@pytest.mark.parametrize("seed", range(12))
def test_steps_of_looped_networks_do_not_depend_on_the_order_of_elimination(seed: int) -> None:
    network = looped(seed, 120, 12)
    H, sigma, pattern = system_of(network, seed)
    factor, plain = AugmentedFactor(H, sigma, pattern=pattern), AugmentedFactor(H[:, pattern.columns], sigma)
    r, nothing = np.random.default_rng(seed).standard_normal(H.shape[0]) * 0.01, np.zeros(len(pattern.columns))
    for ours, others in zip(factor.solve(r, nothing), plain.solve(r, nothing), strict=True):
        np.testing.assert_allclose(ours, others, rtol=0, atol=1e-9 * abs(others).max())


@pytest.mark.usefixtures("superlu")
def test_loops_that_join_neighbours_do_not_fill_the_factor() -> None:
    open_ring = looped(1, 600, 40)
    tree = replace(open_ring, branches=open_ring.branches[:599])
    systems = [system_of(network, 1) for network in (open_ring, tree)]
    entries = [AugmentedFactor(H, sigma, pattern=pattern)._lu.L.nnz for H, sigma, pattern in systems]
    assert entries[0] < 2 * entries[1]


@pytest.mark.usefixtures("superlu")
def test_residual_variances_of_2000_buses_and_100_ties_take_few_products(monkeypatch: pytest.MonkeyPatch) -> None:
    H, sigma, pattern = system_of(looped(1, 2000, 100), 1)
    n = H.shape[0] + len(pattern.columns)
    monkeypatch.setattr(selected_inverse, "MOST_PRODUCTS", int(10 * n * np.log2(n)))
    monkeypatch.setattr(augmented, "BLOCK", 0)  # no solves
    assert not np.isnan(AugmentedFactor(H, sigma, pattern=pattern).residual_variance()).any()


@pytest.mark.usefixtures("superlu")
def test_variances_that_would_take_too_long_are_unknown_but_of_the_rows_wanted_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    H, sigma, pattern = system_of(looped(1, 300, 15), 1)
    expected = AugmentedFactor(H, sigma, pattern=pattern).residual_variance()
    monkeypatch.setattr(selected_inverse, "MOST_PRODUCTS", 100)
    monkeypatch.setattr(augmented, "MOST_SOLVED", 100)
    monkeypatch.setattr(augmented, "FEW_SOLVED", 7)
    factor, wanted = AugmentedFactor(H, sigma, pattern=pattern), np.random.default_rng(1).permutation(len(sigma))
    found = factor.residual_variance(wanted)
    np.testing.assert_allclose(found[wanted[:7]], expected[wanted[:7]], rtol=1e-7, atol=1e-20)
    assert np.isnan(found[wanted[7:]]).all()
    assert np.isnan(factor.state_variance(limited=True)).all()
    assert not np.isnan(factor.state_variance()).any()


@pytest.mark.usefixtures("superlu")
def test_a_factor_that_is_too_full_with_full_pivoting_gives_way_to_that_of_the_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    H, sigma, pattern = system_of(looped(1, 600, 40), 1)
    expected = AugmentedFactor(H, sigma, pattern=pattern).residual_variance()
    find = augmented.find_inverse_entries
    calls = []
    monkeypatch.setattr(
        augmented,
        "find_inverse_entries",
        lambda A, lu, *at: calls.append(lu) or (find(A, lu, *at) if calls[1:] else None),
    )
    monkeypatch.setattr(augmented, "BLOCK", 0)  # no solves
    found = AugmentedFactor(H, sigma, pattern=pattern).residual_variance()
    assert len(calls) == 2
    np.testing.assert_allclose(found / np.maximum(sigma, 1e-9) ** 2, expected / np.maximum(sigma, 1e-9) ** 2, atol=1e-7)


@pytest.mark.slow  # it compiles
@pytest.mark.parametrize("seed", range(4))
def test_no_variance_of_a_network_with_long_loops_is_unknown_and_all_are_those_of_solutions(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr(augmented, "FEWEST_COMPILED", 0)
    H, sigma, pattern = system_of(looped(seed, 300, 60, 280), seed)
    assert pattern.is_compiled
    plain = AugmentedFactor(H[:, pattern.columns], sigma)
    with monkeypatch.context() as patch:
        patch.setattr(augmented, "FEWEST_SELECTED", 10**9)
        expected = plain.state_variance(), plain.residual_variance()
    monkeypatch.setattr(augmented, "MOST_SOLVED", 100)
    factor = AugmentedFactor(H, sigma, pattern=pattern)
    found = factor.state_variance(limited=True), factor.residual_variance(np.arange(len(sigma)))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-8)
    real = sigma > 0
    ratios = [part[real] / sigma[real] ** 2 for part in (found[1], expected[1])]
    np.testing.assert_allclose(*ratios, rtol=0, atol=1e-10)


@pytest.mark.slow  # it compiles
def test_what_compiled_elimination_is_not_sure_of_is_solved_for(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled_factor = pytest.importorskip("dsse_core.matrices.compiled_factor", exc_type=ImportError)
    monkeypatch.setattr(augmented, "FEWEST_COMPILED", 0)
    H, sigma, pattern = system_of(looped(1, 300, 20), 1)
    expected = AugmentedFactor(H, sigma, pattern=pattern).residual_variance()
    monkeypatch.setattr(compiled_factor, "WRONG", -1.0)
    found = AugmentedFactor(H, sigma, pattern=pattern).residual_variance()
    np.testing.assert_allclose(found / np.maximum(sigma, 1e-9) ** 2, expected / np.maximum(sigma, 1e-9) ** 2, atol=1e-9)
