"""One plan serves many scans on either back end; which one is chosen, why, and when an estimate counts as found."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.estimator import estimate_state, estimate_with_plan
from dsse_core.estimation.plan import FEWEST_BUSES_OF_RADIAL, build_estimation_plan
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.linear.whole_grid import GridSolver
from dsse_core.power_flow.newton_raphson import solve_power_flow

Kind = MeasurementKind
FLOWS = (Kind.P_FLOW, Kind.Q_FLOW)
POWERS = (Kind.P_INJECTION, Kind.Q_INJECTION, *FLOWS)


def arrays(measurements):
    return np.array([m.value for m in measurements]), np.array([m.sigma for m in measurements])


@pytest.fixture
def scan(case, meters_of, read):
    network = case("ieee33")
    meters = meters_of(network, Kind.VM, Kind.VA, *POWERS)
    truth = solve_power_flow(network)
    return lambda seed, sigma=0.01: read(truth, meters, sigma=sigma, noise=np.random.default_rng(seed))


def test_one_plan_serves_many_scans(case, scan, backend):
    network = case("ieee33")
    plan = build_estimation_plan(network, [m.meter for m in scan(0)], backend=backend)
    for seed in range(3):
        result = estimate_with_plan(plan, *arrays(scan(seed)))
        alone = estimate_state(network, scan(seed), backend="sparse")
        assert result.backend == plan.backend == backend
        assert result.measurements == tuple(scan(seed))
        np.testing.assert_allclose(result.vm, alone.vm, atol=1e-9)


def test_the_last_scan_is_a_start(case, scan, backend):
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in scan(0)], backend=backend)
    cold = estimate_with_plan(plan, *arrays(scan(1)))
    again = estimate_with_plan(plan, *arrays(scan(1)), start=(cold.vm, cold.va))
    assert again.iterations == 2  # one step, which is none, and the one that may then be the last
    np.testing.assert_allclose(again.vm, cold.vm, atol=1e-9)
    following = estimate_with_plan(plan, *arrays(scan(2)), start=(cold.vm, cold.va), tolerance=1e-8)
    np.testing.assert_allclose(following.vm, estimate_with_plan(plan, *arrays(scan(2)), tolerance=1e-8).vm, atol=1e-9)


@pytest.mark.parametrize("magnitude", [0.0, math.nan], ids=["of zeros", "of no numbers"])
def test_a_start_that_leads_nowhere_gives_way_to_the_flat_start(case, scan, backend, magnitude):
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in scan(0)], backend=backend)
    expected = estimate_with_plan(plan, *arrays(scan(1)))
    found = estimate_with_plan(plan, *arrays(scan(1)), start=(np.full(33, magnitude), np.zeros(33)))
    assert found.memory.from_flat_start
    np.testing.assert_array_equal(found.vm, expected.vm)


@pytest.mark.parametrize("fails", ["it is singular", "no numbers"])
def test_a_last_step_that_leads_nowhere_is_not_the_end_of_an_estimate(case, scan, monkeypatch, fails):
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in scan(0)], backend="sparse")
    expected = estimate_with_plan(plan, *arrays(scan(1)))
    step, calls = GridSolver.step, []

    def fail_once(linear, x, received, **options):
        calls.append(x)
        if len(calls) == expected.iterations and fails == "it is singular":
            raise RuntimeError("singular")
        return step(linear, x, received, **options) * (math.nan if len(calls) == expected.iterations else 1.0)

    monkeypatch.setattr(GridSolver, "step", fail_once)
    found = estimate_with_plan(plan, *arrays(scan(1)))
    assert found.memory.from_flat_start
    np.testing.assert_array_equal(found.vm, expected.vm)


@pytest.mark.parametrize("n", [3, 50])
def test_a_start_of_another_network_is_rejected(case, scan, backend, n):
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in scan(0)], backend=backend)
    with pytest.raises(InvalidInputError, match=rf"the start has shapes \({n},\)"):
        estimate_with_plan(plan, *arrays(scan(0)), start=(np.ones(n), np.zeros(n)))


@pytest.mark.parametrize("wrong", ["text", "complex"])
def test_readings_that_are_no_real_numbers_are_rejected(case, scan, wrong):
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in scan(0)], backend="sparse")
    values, sigmas = arrays(scan(0))
    with pytest.raises(InvalidInputError, match="give real numbers only"):
        estimate_with_plan(plan, ["high"] * len(values) if wrong == "text" else values + 0j, sigmas)


@pytest.mark.parametrize("kind", [Kind.VA, Kind.VM, Kind.P_FLOW])
def test_no_plan_takes_a_virtual_meter_of_anything_but_an_injection(case, scan, backend, kind):
    meters = [m.meter for m in scan(0)]
    k = next(k for k, meter in enumerate(meters) if meter.kind is kind)
    meters[k] = replace(meters[k], source=Source.VIRTUAL)
    with pytest.raises(InvalidInputError, match="only an injection of exactly 0 can be virtual"):
        build_estimation_plan(case("ieee33"), meters, backend=backend)


def test_what_is_kept_of_earlier_scans_changes_nothing(case, scan, backend):
    meters = [m.meter for m in scan(0)]
    plan = build_estimation_plan(case("ieee33"), meters, backend=backend)
    for seed, sigma in ((1, 0.01), (2, 0.01), (3, 0.02), (1, 0.01)):
        readings = arrays(scan(seed, sigma))
        kept = estimate_with_plan(plan, *readings)
        alone = estimate_with_plan(build_estimation_plan(case("ieee33"), meters, backend=backend), *readings)
        np.testing.assert_array_equal(kept.vm, alone.vm)
        np.testing.assert_array_equal(kept.va, alone.va)


def test_no_success_without_a_vanishing_gradient(case, scan, backend):
    """A step of 0.01 p.u. is small for the tolerance given, and far from the minimum for sigmas of 1e-6 p.u."""
    sharp = scan(4, sigma=1e-6)
    lax, strict = (estimate_state(case("ieee33"), sharp, tolerance=t, backend=backend) for t in (0.01, 1e-9))
    assert lax.objective == pytest.approx(strict.objective, rel=1e-5)


def test_no_success_on_a_step_that_was_shortened(chain, read, meters_of, backend):
    """Every step of 0.2 p.u. is below the tolerance, and the first that needs no shortening is the fifth."""
    network = chain(2)
    exact = read(solve_power_flow(network), meters_of(network, Kind.VM, *FLOWS))
    high = [replace(m, value=1.9) if m.meter.kind is Kind.VM else m for m in exact]
    assert estimate_state(network, high, tolerance=10.0, backend=backend).vm[1] > 1.85


def test_the_choice_is_reported_with_its_reason(case, meshed, meters_of):
    small = build_estimation_plan(case("ieee33"), meters_of(case("ieee33"), Kind.VM, *FLOWS))
    assert (small.backend, "33 buses" in str(small.radial)) == ("sparse", True)
    asked = build_estimation_plan(meshed, meters_of(meshed, Kind.VM, *FLOWS), backend="sparse")
    assert "asked for" in str(asked.radial)


def test_from_a_number_of_buses_on_the_tree_is_chosen_where_it_can_serve(chain, meters_of, monkeypatch):
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    monkeypatch.setattr("dsse_core.estimation.plan.FEWEST_BUSES_OF_RADIAL", 20)
    assert build_estimation_plan(chain(20), meters_of(chain(20), Kind.VM, *FLOWS)).backend == "radial"
    assert build_estimation_plan(chain(19), meters_of(chain(19), Kind.VM, *FLOWS)).backend == "sparse"
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    without = build_estimation_plan(chain(20), meters_of(chain(20), Kind.VM, *FLOWS))
    assert (without.backend, without.radial) == ("sparse", "numba is not installed")


def test_a_back_end_that_cannot_serve_or_does_not_exist_is_rejected_with_the_reason(meshed, meters_of):
    meters = meters_of(meshed, Kind.VM, *FLOWS)
    with pytest.raises(InvalidInputError, match=r"(?s)not radial.*'sparse'|numba is not installed"):
        build_estimation_plan(meshed, meters, backend="radial")
    with pytest.raises(InvalidInputError, match="choose one of auto, radial, sparse"):
        build_estimation_plan(meshed, meters, backend="dense")


def test_numba_is_not_imported_for_small_networks():
    code = (
        "import sys; from dsse_core.estimation.estimator import estimate_state;"
        "from scenarios.scenario import load_scenario;"
        "from scenarios.telemetry import make_telemetry; s = load_scenario('ieee33');"
        "estimate_state(s.network, make_telemetry(s).union); sys.exit('numba' in sys.modules)"
    )
    assert FEWEST_BUSES_OF_RADIAL > 33
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_readings_that_cannot_be_are_all_named(case, scan, backend):
    measurements = scan(3)
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in measurements], backend=backend)
    values, sigmas = arrays(measurements)
    values[0], sigmas[3] = math.nan, 0.0
    with pytest.raises(InvalidInputError) as rejection:
        estimate_with_plan(plan, values, sigmas)
    assert [m.meter.id in "".join(rejection.value.problems) for m in measurements[:4]] == [True, False, False, True]
    with pytest.raises(InvalidInputError, match="the plan has"):
        estimate_with_plan(plan, values[1:], sigmas[1:])


def test_an_estimate_that_does_not_converge_is_rejected_and_names_the_worst_meter(case, scan, backend):
    absurd = [replace(m, value=1e6, sigma=1e-3) if m.meter.id == "p_injection@18" else m for m in scan(5)]
    with pytest.raises(EstimationDivergedError, match="p_injection@18"):
        estimate_state(case("ieee33"), absurd, backend=backend)


def test_too_few_meters_are_rejected_with_the_buses_named(case, meters_of, backend):
    network = case("ieee33")
    with pytest.raises(NotObservableError, match="18"):
        build_estimation_plan(
            network, [m for m in meters_of(network, Kind.VM, *POWERS[:2]) if m.bus < 16], backend=backend
        )


def test_a_plan_without_some_meters_is_the_plan_of_the_others(case, scan, backend):
    measurements = scan(6)
    plan = build_estimation_plan(case("ieee33"), [m.meter for m in measurements], backend=backend)
    gone = [k for k, m in enumerate(measurements) if m.meter.kind is Kind.VA or m.meter.bus == 7]
    rest = [m for k, m in enumerate(measurements) if k not in gone]
    less = plan.without(gone)
    assert less.meters == tuple(m.meter for m in rest)
    result = estimate_with_plan(less, *arrays(rest))
    assert result.backend == backend
    np.testing.assert_allclose(result.vm, estimate_state(case("ieee33"), rest).vm, atol=1e-9)
    with pytest.raises(NotObservableError, match="bus 1, "):
        less.without([k for k, meter in enumerate(less.meters) if meter.kind is Kind.VM])


def test_where_the_tree_cannot_serve_after_a_removal_the_sparse_back_end_does(case, meters_of):
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    meters = [*meters_of(case("ieee33"), Kind.VM, *POWERS[:2])]
    plan = build_estimation_plan(case("ieee33"), meters, backend="radial")
    without = plan.without([k for k, meter in enumerate(meters) if meter.bus == 18])
    assert (without.backend, "above bus 18" in str(without.radial)) == ("sparse", True)


@pytest.mark.parametrize("meter", [Meter(Kind.VM, 99), Meter(Kind.VM, 1), Meter(Kind.P_FLOW, 1, "none")])
def test_meters_that_do_not_fit_are_rejected(meter, case, meters_of, backend):
    network = case("ieee33")
    with pytest.raises(InvalidInputError, match=r"1 problem"):
        build_estimation_plan(network, [*meters_of(network, Kind.VM, *POWERS), meter], backend=backend)
