"""The estimate on the tree is that of the sparse back end: state, variances, rejections, for every kind of meter."""

import math
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError
from dsse_core.estimation.estimator import estimate_state, estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.radial.plan import build_radial_plan
from scenarios.generate.feeder import generate_feeder
from tests.support.grids import MeterShares, make_grid

pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")

Kind = MeasurementKind
POWERS = (Kind.P_INJECTION, Kind.Q_INJECTION, Kind.P_FLOW, Kind.Q_FLOW)
METERED = tuple(kind for kind in Kind if not kind.is_virtual)


def on_tree(network, measurements, **options) -> EstimationResult:
    return estimate_state(network, measurements, backend="radial", **options)


def on_sparse(network, measurements, **options) -> EstimationResult:
    return estimate_state(network, measurements, backend="sparse", **options)


def assert_same(network, measurements, *, decades=0.0, tolerance=1e-8, **options):
    """Both estimates agree to 1e-9 p.u. and rad, their variances to 1e-7 of themselves, or of sigma^2."""
    sparse = on_sparse(network, measurements, tolerance=tolerance, **options)
    tree = on_tree(network, measurements, tolerance=tolerance, **options)
    np.testing.assert_allclose(tree.vm, sparse.vm, rtol=0, atol=1e-9)
    np.testing.assert_allclose((tree.va - sparse.va + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-9)
    assert tree.degrees_of_freedom == sparse.degrees_of_freedom
    for ours, theirs in zip(tree.state_sigma(), sparse.state_sigma(), strict=True):
        np.testing.assert_allclose(ours**2, theirs**2, rtol=1e-7, atol=1e-28 + 1e-9 * float(max(theirs) ** 2))
    sigma = np.array([m.sigma if m.sigma > 0 else 1.0 for m in measurements])
    np.testing.assert_allclose(
        tree.residual_variance / sigma**2, sparse.residual_variance / sigma**2, rtol=0, atol=1e-7
    )
    assert (tree.residual_variance[[m.meter.source is Source.VIRTUAL for m in measurements]] == 0).all()
    # what the sparse estimate is itself uncertain by at impedances and sigmas over many decades
    resolution = 1e-6 * 10 ** (2 * decades)
    np.testing.assert_allclose(tree.residual / sigma, sparse.residual / sigma, rtol=0, atol=resolution)
    assert tree.objective == pytest.approx(sparse.objective, rel=resolution, abs=1e-9)


def noisy(network, meters, rng):
    truth = solve_power_flow(network)
    floor = 0.01 * abs(truth.injection).max()
    measurements = []
    for meter, value in zip(meters, truth.read_all(meters), strict=True):
        if meter.source is Source.VIRTUAL:
            measurements.append(Measurement(meter, 0.0, 0.0))
            continue
        sigma = 0.05 * (abs(value) + floor) if meter.kind in (*POWERS, Kind.CURRENT) else 0.002
        measurements.append(Measurement(meter, value + sigma * rng.standard_normal(), sigma))
    return measurements


@pytest.mark.parametrize("name", ["ieee33", "industrial13"])
@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize(
    "kinds", [(Kind.VM, *POWERS[:2]), (Kind.VM, *POWERS[2:]), (Kind.VM, Kind.VA, *POWERS), METERED], ids=len
)
def test_the_tree_agrees_with_the_sparse_estimate_on_the_cases(
    name, kinds, constrained, case, meters_of, zero_injections
):
    network = case(name)
    virtual = zero_injections(network) if constrained else []
    taken = {meter.id for meter in virtual}
    meters = [m for m in meters_of(network, *kinds) if m.id not in taken] + virtual
    assert_same(network, noisy(network, meters, np.random.default_rng(1)))


@pytest.mark.slow
@pytest.mark.parametrize("n_bus", [300, 3000])
def test_the_tree_agrees_with_the_sparse_estimate_on_generated_feeders(n_bus):
    rng = np.random.default_rng(n_bus)
    network, _ = generate_feeder(n_bus, rng, n_pv=10)
    meters = [Meter(Kind.VM, 1)]
    for bus in network.buses[1:]:
        source = Source.VIRTUAL if network.scheduled_injection(bus.id) == 0 else Source.PSEUDO
        meters += [Meter(kind, bus.id, source=source) for kind in POWERS[:2]]
        if rng.random() < 0.05:
            meters.append(Meter(Kind.VM, bus.id))
    for branch in network.branches:
        if rng.random() < 0.1:
            meters += [Meter(kind, branch.from_bus, branch.id) for kind in POWERS[2:]]
    measurements = noisy(network, meters, rng)
    if n_bus < 1000:
        assert_same(network, measurements)
        return
    sparse, tree = on_sparse(network, measurements), on_tree(network, measurements)
    np.testing.assert_allclose(tree.vm, sparse.vm, rtol=0, atol=1e-9)
    np.testing.assert_allclose(tree.va, sparse.va, rtol=0, atol=1e-9)
    assert tree.iterations == sparse.iterations
    rows = [0, 1, 1500, 3000, 3001, 4500, 5999]
    variance = np.concatenate([sigma**2 for sigma in tree.state_sigma()[::-1]])[rows]
    np.testing.assert_allclose(variance, np.diag(sparse.state_covariance(rows)), rtol=1e-7, atol=1e-20)


def test_an_estimate_without_an_end_leaves_nothing_to_the_next_one():
    """They have the same memory, in which nothing is a number by then."""
    network, _ = generate_feeder(40, rng := np.random.default_rng(3))
    meters = [Meter(Kind.VM, 1), *(Meter(kind, bus.id) for bus in network.buses[1:] for kind in POWERS[:2])]
    measurements = noisy(network, meters, rng)
    plan = build_estimation_plan(network, meters, backend="radial")
    values, sigmas = np.array([m.value for m in measurements]), np.array([m.sigma for m in measurements])
    first = estimate_with_plan(plan, values, sigmas)
    with pytest.raises(EstimationDivergedError):
        estimate_with_plan(plan, 1e200 * values, sigmas)
    again = estimate_with_plan(plan, values, sigmas)
    assert len(plan.radial.spaces) == 1
    np.testing.assert_array_equal(again.vm, first.vm)
    assert (again.objective, again.iterations) == (first.objective, first.iterations)


def test_other_threads_go_on_while_the_tree_computes():
    """Such as those of the bus: a link whose messages nobody takes in is lost."""
    rng = np.random.default_rng(1)
    network, _ = generate_feeder(150, rng)  # numpy lets others go on where arrays have 500 numbers
    meters = [Meter(Kind.VM, 1), *(Meter(kind, bus.id) for bus in network.buses for kind in POWERS[:2])]
    measurements = noisy(network, meters, rng)
    plan = build_estimation_plan(network, meters, backend="radial")
    values, sigmas = np.array([m.value for m in measurements]), np.array([m.sigma for m in measurements])
    begin, went_on = threading.Event(), threading.Event()
    other = threading.Thread(target=lambda: begin.wait() and went_on.set())
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1000.0)  # only who lets others go on does so
    try:
        other.start()
        estimate_with_plan(plan, values, sigmas)  # compiled
        begin.set()
        deadline = time.monotonic() + 180.0
        while not went_on.is_set() and time.monotonic() < deadline:
            estimate_with_plan(plan, values, sigmas)
        assert went_on.is_set()
    finally:
        sys.setswitchinterval(interval)
        begin.set()
        other.join()


@pytest.mark.slow
@pytest.mark.random_cases(few=10, long=40, many=1000)
def test_the_tree_agrees_with_the_sparse_estimate_on_any_radial_grid(random_seed):
    rng = np.random.default_rng([random_seed, 31])
    decades = float(rng.choice([0, 1, 2]))
    shares = MeterShares(
        voltage=float(rng.choice([0.1, 0.5])),
        angle=float(rng.choice([0, 0.3])),
        flow=1.0 if (some_unmetered := rng.random() < 0.3) else rng.random(),
        current=float(rng.choice([0, 0.3])),
        injection=0.7 if some_unmetered else 1.0,
        boundary_injection=0.7 if some_unmetered else 1.0,
    )
    grid = make_grid(
        random_seed,
        n_bus=int(rng.integers(2, 60)),
        n_area=1,
        chain=rng.random(),
        decades=decades,
        loops=0,
        transformers=float(rng.choice([0, 0.3])),
        short=None,
        slack_at_root=bool(rng.random() < 0.5),
        shares=shares,
    )
    try:
        on_sparse(grid.network, grid.measurements, tolerance=1e-8)
    except EstimationDivergedError:  # seed 493: current magnitudes without the flows that would choose among minima
        with pytest.raises(EstimationDivergedError):
            on_tree(grid.network, grid.measurements, tolerance=1e-8)
    else:
        assert_same(grid.network, grid.measurements, decades=decades)
    meters = [m.meter for m in grid.measurements]
    plans = [build_estimation_plan(grid.network, meters, backend=backend) for backend in ("radial", "sparse")]
    np.testing.assert_array_equal(*(plan.indispensable for plan in plans))


@pytest.mark.parametrize("decades", [1, 2, 3, 4])
def test_sigmas_over_decades_cost_no_digits(decades, case, meters_of):
    network, rng = case("ieee33"), np.random.default_rng(decades)
    readings = noisy(network, meters_of(network, Kind.VM, *POWERS), rng)
    sigmas = [m.sigma * 10 ** rng.uniform(-decades, 0) for m in readings]
    exact = solve_power_flow(network).read_all([m.meter for m in readings])
    drawn = [
        Measurement(m.meter, value + sigma * rng.standard_normal(), sigma)
        for m, value, sigma in zip(readings, exact, sigmas, strict=True)
    ]
    assert_same(network, drawn, decades=decades)


def test_exact_injections_hold_exactly(case, meters_of, zero_injections):
    network = case("industrial13")
    virtual = zero_injections(network)
    taken = {meter.id for meter in virtual}
    meters = [m for m in meters_of(network, Kind.VM, *POWERS) if m.id not in taken] + virtual
    tree = on_tree(network, noisy(network, meters, np.random.default_rng(3)))
    assert abs(tree.residual[-len(virtual) :]).max() < 1e-12
    assert tree.objective > 1.0


def test_any_bus_can_be_the_reference(case, meters_of):
    network = case("ieee33")
    assert_same(network, noisy(network, meters_of(network, Kind.VM, *POWERS), np.random.default_rng(6)), reference=18)


def test_a_dead_voltmeter_does_not_throw_all_voltages_to_zero(case, meters_of):
    network = case("ieee33")
    measurements = noisy(network, meters_of(network, Kind.VM, *POWERS), np.random.default_rng(7))
    assert_same(network, [replace(m, value=0.0) if m.meter.id == "vm@18" else m for m in measurements])


def test_a_meshed_network_is_declined_with_the_reason(meshed, meters_of):
    assert "not radial" in str(build_radial_plan(meshed, meters_of(meshed)))


def test_a_bus_known_only_through_its_parents_balance_is_declined(case, meters_of):
    network = case("ieee33")
    meters = [m for m in meters_of(network, Kind.VM, *POWERS[:2]) if m.bus != 18]
    assert "above bus 18" in str(build_radial_plan(network, meters))


def test_a_network_of_one_bus_and_one_of_two_are_trees():
    one = Network("one", 1.0, (Bus(1, 20.0),), (), (Generator(1, Control.SLACK, va=0.3),))
    assert_same(one, [Measurement(Meter(Kind.VM, 1), 1.02, 0.01)])
    two = Network("two", 1.0, (Bus(1, 20.0), Bus(2, 20.0)), (Branch("b", 2, 1, 0.01, 0.02),), one.generators)
    meters = [Meter(Kind.VM, 2), *(Meter(kind, 2) for kind in POWERS[:2])]
    assert_same(two, [Measurement(m, z, 0.01) for m, z in zip(meters, (0.98, -0.5, -0.1), strict=True)])


def test_without_numba_the_reason_is_given(monkeypatch, case, meters_of):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    assert "numba is not installed" in str(build_radial_plan(case("ieee33"), meters_of(case("ieee33"))))


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{"NUMBA_CACHE_DIR": "/proc/nowhere"}, {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}]
)
def test_what_is_compiled_is_of_use_where_nothing_can_be_written_to_keep_it(settings: dict[str, str]):
    nowhere = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | settings
    command = [sys.executable, "-c", "from dsse_core.radial import block as t; print(t.wrap(7.0))"]
    done = subprocess.run(command, env=nowhere, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(7.0 - 2 * math.pi, rel=1e-15)


@pytest.mark.parametrize("random_seed", range(10))
def test_the_residuals_of_an_estimate_are_those_of_its_state(random_seed):
    """Found bus by bus and from memory that other scans have used, they are z - h(x) of every kind of meter."""
    rng = np.random.default_rng([57, random_seed])
    shares = MeterShares(voltage=0.5, angle=0.3, flow=1.0, current=0.3, injection=0.9, boundary_injection=0.9)
    grid = make_grid(
        random_seed, n_bus=40, n_area=1, chain=0.6, decades=0.0, loops=0, transformers=0.3, short=None,
        slack_at_root=True, shares=shares,
    )  # fmt: skip
    values, sigmas = np.array([(m.value, m.sigma) for m in grid.measurements]).T
    plan = build_estimation_plan(grid.network, [m.meter for m in grid.measurements], backend="radial")
    for _ in range(2):
        found = estimate_with_plan(plan, values + rng.normal(0, 0.1 * sigmas), sigmas)
        model = plan.sparse.model.model
        r = model.subtract(found.values, model.predict(np.concatenate([found.va, found.vm])))
        np.testing.assert_allclose(found.residual, r, rtol=0, atol=1e-11)
        weighted = r[found.sigmas > 0] / found.sigmas[found.sigmas > 0]
        assert found.objective == pytest.approx(weighted @ weighted, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("turn", [0.05, 0.3, 2.0])
def test_steps_of_any_length_lead_to_one_estimate(case, meters_of, turn):
    """Also those for which sines are computed, and those that are shortened after they have been found."""
    network = case("ieee33")
    measurements = noisy(network, meters_of(network, Kind.VM, *POWERS), np.random.default_rng(58))
    there = on_tree(network, measurements)
    again = on_tree(network, measurements, start=(there.vm, there.va + turn * np.linspace(0.0, 1.0, len(there.va))))
    np.testing.assert_allclose(again.vm, there.vm, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.va, there.va, rtol=0, atol=1e-9)
