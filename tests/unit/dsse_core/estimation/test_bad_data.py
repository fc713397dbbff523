"""Detection, identification and removal of gross errors; critical measurements are reported, not divided by zero."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammainc

from dsse_core.errors import NotObservableError
from dsse_core.estimation.bad_data import find_critical, normalized_residuals
from dsse_core.estimation.decision import IterationLostError
from dsse_core.estimation.estimator import iterate_with_plan
from dsse_core.estimation.residuals import chi_square_limit, keep_tied
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Control, Generator
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

Kind = MeasurementKind
FLOWS = (Kind.P_FLOW, Kind.Q_FLOW)
INJECTIONS = (Kind.P_INJECTION, Kind.Q_INJECTION)


def with_errors(measurements, sigmas_by_id):
    return [replace(m, value=m.value + sigmas_by_id.get(m.meter.id, 0.0) * m.sigma) for m in measurements]


@pytest.fixture
def noisy33(case, meters_of, read):
    network = case("ieee33")
    meters = [m for m in meters_of(network, Kind.VM, *FLOWS, *INJECTIONS) if not m.branch or m.bus != 1]
    return network, read(solve_power_flow(network), meters, noise=np.random.default_rng(2))


@pytest.mark.parametrize("dof", [1, 7, 99])
@pytest.mark.parametrize("confidence", [0.95, 0.99])
def test_the_limit_is_the_quantile_of_the_chi_square_distribution(dof, confidence):
    assert gammainc(dof / 2, chi_square_limit(dof, confidence) / 2) == pytest.approx(confidence, abs=1e-12)


def test_without_redundancy_nothing_is_ever_detected(chain, read, process):
    network = chain(2)
    meters = [Meter(Kind.VM, 1), Meter(Kind.P_FLOW, 1, "1-2"), Meter(Kind.Q_FLOW, 1, "1-2")]
    wrong = with_errors(read(solve_power_flow(network), meters), {"p_flow@1:1-2": 10})
    report = process(network, wrong)
    assert not report.detected
    assert report.degrees_of_freedom == 0
    assert report.chi_square_limit == float("inf")
    assert report.critical == tuple(m.id for m in meters)


def test_clean_measurements_are_left_alone(noisy33, process):
    network, noisy = noisy33
    report = process(network, noisy)
    assert report.removed == ()
    assert not report.detected
    assert report.objective < report.chi_square_limit
    assert report.objective == report.result.objective


@pytest.mark.parametrize("wrong", ["p_flow@3:3-4", "q_injection@14", "vm@25", "q_flow@33:32-33"])
def test_a_single_gross_error_is_found_and_removed(noisy33, wrong, process):
    network, noisy = noisy33
    report = process(network, with_errors(noisy, {wrong: 25}))
    assert [r.measurement.meter.id for r in report.removed] == [wrong]
    assert report.removed[0].normalized_residual > 10
    assert not report.detected
    assert wrong not in {m.meter.id for m in report.result.measurements}


def test_several_gross_errors_are_found_one_at_a_time_the_largest_first(noisy33, process):
    network, noisy = noisy33
    wrong = {"p_flow@3:3-4": 60, "vm@25": -30, "q_injection@9": 20}
    report = process(network, with_errors(noisy, wrong))
    assert {r.measurement.meter.id for r in report.removed} == set(wrong)
    residuals = [r.normalized_residual for r in report.removed]
    assert residuals == sorted(residuals, reverse=True)
    assert not report.detected


def test_removing_the_error_brings_back_the_estimate(noisy33, estimate, process):
    network, noisy = noisy33
    clean = estimate(network, [m for m in noisy if m.meter.id != "p_flow@3:3-4"])
    report = process(network, with_errors(noisy, {"p_flow@3:3-4": 50}))
    np.testing.assert_allclose(report.result.vm, clean.vm, atol=1e-9)


def test_the_normalised_residual_is_the_error_itself_in_units_of_what_redundancy_leaves(
    rich, meters_of, read, estimate
):
    """For one error e among exact readings |r_k| / sqrt(Omega_kk) = e sqrt(Omega_kk) / R_kk, and it is the largest."""
    exact = read(solve_power_flow(rich), meters_of(rich, Kind.VM, *FLOWS), sigma=1e-4)
    result = estimate(rich, with_errors(exact, {"p_flow@3:3-4": 1.0}), tolerance=1e-10)
    k = [m.meter.id for m in result.measurements].index("p_flow@3:3-4")
    expected = np.sqrt(result.residual_variance[k]) / 1e-4
    normalized = normalized_residuals(result)
    assert normalized[k] == pytest.approx(expected, rel=1e-3)
    assert normalized.argmax() == k


def test_critical_measurements_are_reported_and_never_blamed(chain, meters_of, read, process):
    """Bus 6 hangs on one flow measurement; the rest of the chain is redundant."""
    network = chain(6)
    meters = [m for m in meters_of(network, Kind.VM, *FLOWS) if m.bus != 6 and m.branch != "5-6"]
    hanging = [Meter(kind, 5, "5-6") for kind in FLOWS]
    readings = with_errors(
        read(solve_power_flow(network), meters + hanging, noise=np.random.default_rng(0)),
        {"p_flow@5:5-6": 40, "p_flow@2:2-3": 40},
    )
    with np.errstate(all="raise"):
        report = process(network, readings)
    assert set(report.critical) == {"p_flow@5:5-6", "q_flow@5:5-6"}
    assert [r.measurement.meter.id for r in report.removed] == ["p_flow@2:2-3"]
    assert not report.detected


def test_measurements_become_critical_when_the_last_redundant_one_is_removed(chain, read, estimate, process):
    network = chain(2)
    meters = [Meter(Kind.VM, 1), *(Meter(Kind.P_FLOW, b, "1-2") for b in (1, 2)), Meter(Kind.Q_FLOW, 1, "1-2")]
    exact = read(solve_power_flow(network), meters)
    assert not {m.id for m in meters[1:3]} & set(find_critical(estimate(network, exact)))
    report = process(network, with_errors(exact, {"p_flow@2:1-2": 100}))
    assert len(report.removed) == 1
    assert set(report.critical) == {m.meter.id for m in report.result.measurements}


@pytest.fixture
def with_an_ammeter(chain, read):
    """Flows alone determine the chain; the ammeter checks them, but without load it could replace none."""
    network = chain(3)
    meters = [Meter(Kind.VM, 1), *(Meter(k, b, f"{b}-{b + 1}") for b in (1, 2) for k in FLOWS)]
    return network, read(solve_power_flow(network), [*meters, Meter(Kind.CURRENT, 2, "2-3")], sigma=1e-3)


@pytest.mark.parametrize("wrong", ["p_flow@2:2-3", "current@2:2-3"])
def test_a_meter_that_only_an_ammeter_checks_is_critical_and_stays(with_an_ammeter, wrong, process):
    network, exact = with_an_ammeter
    report = process(network, with_errors(exact, {wrong: 30}))
    (removed,) = report.removed
    assert removed.measurement.meter.id == "current@2:2-3"
    assert set(report.critical) == {m.meter.id for m in exact if m.meter.kind is not Kind.CURRENT}
    assert wrong in report.undecided[0]  # the ammeter goes, though the wrong one may be a critical one that it checks


def test_the_only_voltmeter_is_critical_though_losses_check_it_and_is_kept_however_wrong(
    case, meters_of, read, estimate, process
):
    network = case("ieee33")
    meters = [Meter(Kind.VM, 1), *meters_of(network, *FLOWS, *INJECTIONS)]
    readings = read(solve_power_flow(network), meters, sigma=0.002)
    result = estimate(network, readings)
    assert result.residual_variance[0] > 1e-6 * 0.002**2
    assert find_critical(result) == ("vm@1",)
    report = process(network, [replace(readings[0], value=0.5, sigma=0.01), *readings[1:]])
    assert report.critical == ("vm@1",)
    assert "vm@1" in {m.meter.id for m in report.result.measurements}


def test_several_voltmeters_are_not_critical(case, meters_of, read, estimate):
    network = case("ieee33")
    meters = [Meter(Kind.VM, 1), Meter(Kind.VM, 18), *meters_of(network, *FLOWS)]
    assert find_critical(estimate(network, read(solve_power_flow(network), meters))) == ()


def with_a_sharp_and_a_rough_voltmeter(chain, read, rough):
    network = chain(3)
    truth = solve_power_flow(network)
    flows = [Meter(k, b, f"{b}-{b + 1}") for b in (1, 2) for k in FLOWS]
    sharp = read(truth, [Meter(Kind.VM, 1)], sigma=1e-6) + read(truth, [Meter(Kind.VM, 2)], sigma=rough)
    return network, sharp + read(truth, flows, sigma=1e-3)


def test_a_precise_meter_that_only_much_coarser_ones_check_is_not_critical(chain, read, estimate):
    network, exact = with_a_sharp_and_a_rough_voltmeter(chain, read, 0.02)
    wrong = [replace(exact[0], value=exact[0].value + 0.1), *exact[1:]]
    result = estimate(network, wrong)
    assert "vm@1" not in find_critical(result)
    assert normalized_residuals(result)[0] == pytest.approx(5.0, rel=0.1)


def test_where_a_removal_makes_the_estimation_diverge_the_last_good_estimate_stands(
    chain, read, estimate, process, monkeypatch
):
    network, exact = with_a_sharp_and_a_rough_voltmeter(chain, read, 0.02)
    wrong = [replace(exact[0], value=exact[0].value + 0.1), *exact[1:]]
    complete = estimate(network, wrong)

    def diverge_after_a_removal(plan, values, sigmas, **options):
        if len(values) < len(wrong):
            raise IterationLostError(50, 1.0, np.zeros(len(values)))
        return iterate_with_plan(plan, values, sigmas, **options)

    monkeypatch.setattr("dsse_core.estimation.bad_data.iterate_with_plan", diverge_after_a_removal)
    report = process(network, wrong)
    assert report.detected
    assert report.removed == ()
    assert report.objective == complete.objective
    assert report.suspect.reason == "diverges"
    equal = keep_tied(dict(zip((m.id for m in complete.plan.meters), normalized_residuals(complete), strict=True)))
    assert report.suspect.meter.id == min(equal)
    assert report.suspect.normalized_residual == equal[min(equal)] > 3
    assert [m.meter.id for m in report.result.measurements] == [m.meter.id for m in wrong]


@pytest.mark.parametrize(
    ("name", "dead"), [("industrial13", "vm@1"), ("industrial13", "vm@4"), ("ieee33", "vm@1"), ("ieee33", "vm@16")]
)
@pytest.mark.parametrize("reading", [0.0, 0.05, 0.3])
def test_a_dead_voltmeter_is_identified(name, dead, reading, process):
    scenario = load_scenario(name)
    telemetry = make_telemetry(scenario)
    readings = [replace(m, value=reading) if m.meter.id == dead else m for m in telemetry.union]
    with np.errstate(divide="raise", invalid="raise"):
        report = process(scenario.network, readings)
    assert [r.measurement.meter.id for r in report.removed] == [dead]
    assert report.removed[0].normalized_residual > 100
    assert not report.detected
    np.testing.assert_allclose(report.result.vm, telemetry.truth.vm, atol=0.01)


@pytest.mark.parametrize("reading", [0.0, 0.05, 0.3, 0.45])
def test_a_dead_only_voltmeter_is_not_believed_and_takes_no_good_meter_with_it(reading, process):
    scenario = load_scenario("ieee33")
    union = [m for m in make_telemetry(scenario).union if m.meter.kind is not Kind.VM or m.meter.id == "vm@1"]
    readings = [replace(m, value=reading) if m.meter.id == "vm@1" else m for m in union]
    with pytest.raises(NotObservableError) as caught:
        process(scenario.network, readings)
    assert caught.value.left_out == (f"vm@1 (vm of bus 1) reads {reading:g} p.u., below 0.5",)
    assert set(caught.value.buses) == {bus.id for bus in scenario.network.buses}
    assert str(caught.value).startswith("vm@1 (vm of bus 1) reads")


def test_two_dead_voltmeters_do_not_confirm_each_other(process):
    scenario = load_scenario("ieee33")
    chosen = {"vm@1", "vm@18"}
    union = make_telemetry(scenario).union
    sigma = next(m.sigma for m in union if m.meter.id == "vm@1")
    readings = [m for m in union if m.meter.kind is not Kind.VM]
    readings += [Measurement(Meter(Kind.VM, bus), 0.3, sigma) for bus in (1, 18)]
    with pytest.raises(NotObservableError) as caught:
        process(scenario.network, readings)
    assert {text.split()[0] for text in caught.value.left_out} == chosen


def test_a_voltmeter_below_half_of_nominal_voltage_is_left_out_and_changes_nothing_where_it_was_right(
    chain, meters_of, read, process
):
    network = replace(chain(3), generators=(Generator(1, Control.SLACK, vm=0.51),))
    light = replace(network, buses=tuple(replace(b, p_load=0.05, q_load=0.05) for b in network.buses))
    truth = solve_power_flow(light)
    report = process(light, read(truth, meters_of(light, Kind.VM, *FLOWS), sigma=1e-3))
    assert [r.measurement.meter.id for r in report.removed] == ["vm@2", "vm@3"]
    assert all(r.normalized_residual < 0.1 for r in report.removed)
    np.testing.assert_allclose(report.result.vm, truth.vm, atol=1e-6)


def test_voltmeters_that_are_all_below_half_of_nominal_voltage_do_not_confirm_each_other(
    chain, meters_of, read, process
):
    """As with a wrong base: which of two such cases it is, two dead meters or a low voltage, no reading tells."""
    network = replace(chain(3), generators=(Generator(1, Control.SLACK, vm=0.4),))
    light = replace(network, buses=tuple(replace(b, p_load=0.05, q_load=0.05) for b in network.buses))
    readings = read(solve_power_flow(light), meters_of(light, Kind.VM, *FLOWS), sigma=1e-3)
    with pytest.raises(NotObservableError) as caught:
        process(light, readings)
    assert [text.split()[0] for text in caught.value.left_out] == ["vm@1", "vm@2", "vm@3"]


def test_several_dead_voltmeters_are_left_out_where_the_rest_determines_the_state(noisy33, process):
    network, noisy = noisy33
    dead = {"vm@1": 0.0, "vm@18": 0.3, "vm@33": 0.499}
    report = process(network, [replace(m, value=dead.get(m.meter.id, m.value)) for m in noisy])
    assert [r.measurement.meter.id for r in report.removed] == list(dead)
    without = process(network, [m for m in noisy if m.meter.id not in dead])
    np.testing.assert_array_equal(report.result.vm, without.result.vm)


def test_a_nearly_critical_pair_is_distinguished_by_its_residuals_and_not_by_its_ids(chain, read, estimate, process):
    """A rough third voltmeter makes the residuals of the pair differ by less than a percent: that decides."""
    network = chain(3)
    truth = solve_power_flow(network)
    flows = [Meter(k, b, f"{b}-{b + 1}") for b in (1, 2) for k in FLOWS]
    pair = read(truth, [Meter(Kind.VM, 1), Meter(Kind.VM, 2), *flows], sigma=0.001)
    third = read(truth, [Meter(Kind.VM, 3)], sigma=0.02)
    wrong = with_errors(pair + third, {"vm@2": 30})
    normalized = normalized_residuals(estimate(network, wrong))
    assert 0.99 < normalized[0] / normalized[1] < 0.9999
    (removed,) = process(network, wrong).removed
    assert removed.measurement.meter.id == "vm@2"
    assert removed.indistinguishable_from == ()


def test_a_critical_pair_cannot_be_distinguished_so_the_id_decides_and_the_other_is_named(chain, read, process):
    network = chain(3)
    meters = [Meter(Kind.VM, 1), Meter(Kind.VM, 2), *(Meter(k, 2, "2-3") for k in FLOWS)]
    meters += [Meter(k, 1, "1-2") for k in FLOWS]
    exact = read(solve_power_flow(network), meters, sigma=0.001)
    for wrong in ("vm@1", "vm@2"):
        for order in (exact, exact[::-1]):
            report = process(network, with_errors(order, {wrong: 30}))
            assert len(report.removed) == 1
            removed = report.removed[0]
            tie = {removed.measurement.meter.id, *removed.indistinguishable_from}
            assert {"vm@1", "vm@2"} <= tie
            assert removed.measurement.meter.id == min(tie)


def test_many_small_deviations_are_detected_but_nothing_is_removed(noisy33, process):
    """J exceeds the limit though no normalised residual exceeds the threshold: wrong sigmas, not bad data."""
    network, noisy = noisy33
    truth = solve_power_flow(network)
    rng = np.random.default_rng(4)
    moved = [replace(m, value=truth.read(m.meter) + 1.5 * m.sigma * rng.choice([-1, 1])) for m in noisy]
    report = process(network, moved, threshold=3.5)
    assert report.detected
    assert report.suspect is None
    assert report.removed == ()
    assert report.objective >= report.chi_square_limit


def test_virtual_measurements_are_never_blamed(rich, meters_of, read, zero_injections, estimate, process):
    virtual = zero_injections(rich)
    meters = [m for m in meters_of(rich, Kind.VM, *FLOWS, *INJECTIONS) if m.bus != 7 or not m.kind.of_injection]
    exact = read(solve_power_flow(rich), meters + virtual)
    result = estimate(rich, with_errors(exact, {"p_flow@7:4-7": 50}))
    is_virtual = np.array([m.meter.source is Source.VIRTUAL for m in result.measurements])
    assert (normalized_residuals(result)[is_virtual] == 0).all()
    report = process(rich, with_errors(exact, {"p_flow@7:4-7": 50}))
    assert [r.measurement.meter.id for r in report.removed] == ["p_flow@7:4-7"]
    assert not any(m.id in report.critical for m in virtual)


def test_the_order_of_the_measurements_does_not_matter(noisy33, process):
    network, noisy = noisy33
    wrong = with_errors(noisy, {"p_flow@3:3-4": 40, "q_flow@30:30-31": 40})
    forward, backward = process(network, wrong), process(network, wrong[::-1])
    assert [r.measurement for r in forward.removed] == [r.measurement for r in backward.removed]
