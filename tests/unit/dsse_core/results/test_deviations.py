"""Standard deviations of flows, currents, losses and injections are those of dense linear algebra, and of samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.matrices import augmented
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.deviations.choose import Deviations, find_deviations
from dsse_core.results.flows import build_branch_model, find_flows, find_injections
from dsse_core.results.state import GridState, find_state
from dsse_core.results.totals import Division, find_totals
from tests.support.dense_rows import rows_of
from tests.support.grids import MeterShares, make_grid

Kind = MeasurementKind
POWERS = (Kind.P_INJECTION, Kind.Q_INJECTION)
OF_END = (Kind.P_FLOW, Kind.Q_FLOW, Kind.CURRENT)


def dense_covariance(result) -> np.ndarray:
    """Of x = [va; vm]: the inverse of the information in the null space of the constraints and the reference."""
    exact = result.sigmas == 0
    H = rows_of(result)
    basis = scipy.linalg.null_space(H[exact]) if exact.any() else np.eye(H.shape[1])
    weighted = H[~exact] @ basis / result.sigmas[~exact, None]
    root = np.linalg.qr(weighted, mode="r")
    half = scipy.linalg.solve_triangular(root, basis.T, trans="T")
    covariance = np.zeros((2 * len(result.vm), 2 * len(result.vm)))
    covariance[np.ix_(result.linear.model.free, result.linear.model.free)] = half.T @ half
    return covariance


def some_division(network, seed) -> Division:
    """Areas of any shape: totals hold for whatever buses and branches."""
    rng = np.random.default_rng(seed)
    n, m = len(network.buses), len(network.branches)
    return Division(("a", "b", "c"), rng.integers(0, 3, n), rng.integers(0, 3, m))


def dense_totals(result, division, rows_of, sigma_of) -> np.ndarray:
    """Sums of rows of H: of injections, of flows at both ends, and of shunts, which have a diagonal H of their own."""
    network, found = result.network, []
    active = [k for k, b in enumerate(network.branches) if b.in_service]
    state = find_state(network, result.vm, result.va)
    shunt = np.array([complex(bus.g_shunt, -bus.b_shunt) for bus in network.buses]) * 2 * result.vm
    n = len(network.buses)
    for flow, injected, part in zip(OF_END[:2], POWERS, (np.real, np.imag), strict=True):
        H = rows_of([Meter(injected, bus.id) for bus in network.buses])
        ends = [
            rows_of([Meter(flow, end(network.branches[k]), network.branches[k].id) for k in active]) for end in ENDS
        ]
        of_shunt = np.hstack([np.zeros((n, n)), np.diag(part(shunt))])
        produces, rows = part(state.injection) > 0, []
        for area in range(3):
            own = division.of_bus == area
            load, made = -H[own & ~produces].sum(axis=0), H[own & produces].sum(axis=0)
            loss = of_shunt[own].sum(axis=0)
            came = np.zeros(2 * n)
            for k, *at_ends in zip(active, *ends, strict=True):
                loss = loss + (division.of_branch[k] == area) * sum(at_ends)
                for end, h in zip(ENDS, at_ends, strict=True):
                    owner, holder = division.of_bus[network.row[end(network.branches[k])]], division.of_branch[k]
                    came = came + (owner != holder) * (int(holder == area) - int(owner == area)) * h
            rows.append(np.stack([load, made, loss, came]))
        found.append(sigma_of(np.concatenate(rows)).reshape(3, 4).T)
    return np.array(found)


def dense_deviations(result, division) -> Deviations:
    network, x = result.network, np.r_[result.va, result.vm]
    admittance, C = build_admittance(network), dense_covariance(result)

    def rows_of(meters):
        return build_measurement_model(network, admittance, meters).jacobian(x).toarray()

    def sigma_of(H):
        return np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", H, C, H), 0.0))

    active = network.active_branches
    ends = [[rows_of([Meter(k, bus(b), b.id) for b in active]) for k in OF_END] for bus in (from_of, to_of)]
    rows = [*ends[0], *ends[1], ends[0][0] + ends[1][0], ends[0][1] + ends[1][1]]
    branches = np.zeros((8, len(network.branches)))
    branches[:, [b.in_service for b in network.branches]] = [sigma_of(H) for H in rows]
    injections = [
        sigma_of(rows_of([Meter(k, bus.id) for bus in network.buses])) for k in (Kind.P_INJECTION, Kind.Q_INJECTION)
    ]
    va, vm = np.split(np.sqrt(np.diag(C)), 2)
    totals = dense_totals(result, division, rows_of, sigma_of)
    return Deviations(vm, va, branches, np.array(injections), lambda: totals)


def from_of(branch):
    return branch.from_bus


def to_of(branch):
    return branch.to_bus


ENDS = (from_of, to_of)


def assert_dense(result):
    """To 1e-6 of each deviation, or 1e-5 of the largest where it is exact: dense algebra leaves round-off there."""
    division = some_division(result.network, len(result.vm))
    found, expected = find_deviations(result, division), dense_deviations(result, division)
    for key in ("vm", "va", "branches", "injections", "totals"):
        ours, theirs = getattr(found, key), getattr(expected, key)
        ours = np.where(np.isnan(ours), theirs, ours)  # a current that does not flow
        np.testing.assert_allclose(ours**2, theirs**2, rtol=2e-6, atol=1e-10 * (theirs**2).max(), err_msg=key)


def readings_of(network, meters, rng, sigma=0.01, noise=1.0):
    truth = solve_power_flow(network)
    size = 0.1 * abs(truth.injection).max()
    found = []
    for meter, value in zip(meters, truth.read_all(meters), strict=True):
        if meter.source is Source.VIRTUAL:
            found.append(Measurement(meter, 0.0, 0.0))
        else:
            s = sigma * (size if meter.kind not in (Kind.VM, Kind.VA) else 0.2) * rng.uniform(0.5, 2)
            found.append(Measurement(meter, value + noise * s * rng.standard_normal(), s))
    return found


def some_meters(network, rng, injected=0.5):
    """Flows at one end of every branch, so that injections need no meter; some of P alone, or of Q, or exact."""
    meters = [Meter(Kind.VM, network.slack.bus)]
    for b in network.active_branches:
        end = b.from_bus if rng.random() < 0.5 else b.to_bus
        meters += [Meter(kind, end, b.id) for kind in OF_END[:2]]
        meters += [Meter(Kind.CURRENT, end, b.id)] if rng.random() < 0.2 else []
    for bus in network.buses:
        passive = network.scheduled_injection(bus.id) == 0 and bus.id != network.slack.bus
        for kind in (Kind.P_INJECTION, Kind.Q_INJECTION):
            if rng.random() < injected:
                meters.append(Meter(kind, bus.id, source=Source.VIRTUAL if passive else Source.PSEUDO))
        if rng.random() < 0.2 and bus.id != network.slack.bus:
            meters.append(Meter(Kind.VM, bus.id))
    return meters


@pytest.mark.random_cases(few=2, long=6, many=60)
def test_derived_deviations_are_the_dense_ones_on_random_grids(random_seed, backend):
    rng = np.random.default_rng(random_seed)
    loops = 0 if backend == "radial" else int(rng.integers(0, 6))
    n_bus = int(rng.integers(3, 60))
    network = make_grid(
        random_seed, n_bus, 1, rng.random(), 1.0, loops, 0.2, None, bool(rng.random() < 0.5), MeterShares()
    ).network
    meters = some_meters(network, rng)
    readings = readings_of(network, meters, rng, noise=0.0)  # with noise on small currents some do not converge
    assert_dense(estimate_state(network, readings, backend=backend))


def test_derived_deviations_are_the_dense_ones_where_branches_are_of_every_kind(rich, backend):
    rng = np.random.default_rng(5)
    for injected in (0.0, 0.5, 1.0):
        result = estimate_state(rich, readings_of(rich, some_meters(rich, rng, injected), rng), backend=backend)
        assert_dense(result)
        off = [not b.in_service for b in rich.branches]
        assert (find_deviations(result).branches[:, off] == 0).all()


@pytest.mark.parametrize("n", [250])
def test_many_buses_take_the_selected_inverse_and_agree(n, chain, backend):
    rng = np.random.default_rng(1)
    network = chain(n)
    assert_dense(estimate_state(network, readings_of(network, some_meters(network, rng), rng), backend=backend))


def test_a_short_branch_does_not_blow_up_its_deviations(chain, backend):
    """Flows through 1e-6 p.u. are differences of equal numbers where they come from voltages at both ends."""
    network = chain(12)
    branches = tuple(replace(b, r=1e-6, x=1e-6) if b.id == "6-7" else b for b in network.branches)
    short = replace(network, branches=branches)
    meters = [Meter(Kind.VM, 1), *(Meter(k, bus) for bus in range(2, 13) for k in (Kind.P_INJECTION, Kind.Q_INJECTION))]
    rng = np.random.default_rng(2)
    measurements = readings_of(short, meters, rng)
    deviations = find_deviations(estimate_state(short, measurements, backend=backend))
    sigma = {m.meter.id: m.sigma for m in measurements}
    loads = math.hypot(*(sigma[f"p_injection@{bus}"] for bus in range(7, 13)))
    at = [b.id for b in short.branches].index("6-7")
    assert deviations.branches[3, at] == pytest.approx(loads, rel=0.02)  # what goes on is the loads beyond, and losses
    neighbours = deviations.branches[:, [at - 1, at + 1]]
    assert (deviations.branches[:6, at] < 1.01 * neighbours[:6].max(axis=1)).all()


@pytest.mark.parametrize("sigma", [0.1, 1e2, 1e4, 1e6])
def test_a_meter_that_says_nothing_does_not_spoil_the_deviation_of_what_it_reads(chain, backend, sigma):
    """R - Omega of a reading far coarser than what others tell would be round-off."""
    network, flow = chain(6), solve_power_flow(chain(6))
    meters = [Meter(Kind.VM, 1), *(Meter(k, b.from_bus, b.id) for b in network.branches for k in OF_END[:2])]
    coarse = [Meter(kind, bus, source=Source.PSEUDO) for bus in (3, 6) for kind in POWERS]
    values = flow.read_all([*meters, *coarse])
    sigmas = [1e-4] * len(meters) + [sigma] * len(coarse)
    readings = [Measurement(*of) for of in zip([*meters, *coarse], values, sigmas, strict=True)]
    found = find_deviations(estimate_state(network, readings, backend=backend))
    without = find_deviations(estimate_state(network, readings[: len(meters)], backend=backend))
    np.testing.assert_allclose(found.injections, without.injections, rtol=(1e-4 / sigma) ** 2 + 1e-8)


def test_a_branch_that_carries_nothing_has_no_deviation_of_its_current(backend):
    buses = tuple(Bus(k, 10.0, p_load=0.1 * (k < 3)) for k in (1, 2, 3))
    branches = (Branch("1-2", 1, 2, 0.01, 0.02), Branch("2-3", 2, 3, 0.01, 0.02))
    network = Network("dead end", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    exact = [Meter(k, 3, source=Source.VIRTUAL) for k in (Kind.P_INJECTION, Kind.Q_INJECTION)]
    meters = [Meter(Kind.VM, 1), Meter(Kind.P_INJECTION, 2), Meter(Kind.Q_INJECTION, 2), *exact]
    result = estimate_state(network, readings_of(network, meters, np.random.default_rng(1)), backend=backend)
    found = find_deviations(result).branches[:, 1]
    assert np.isnan(found[[2, 5]]).all()
    np.testing.assert_allclose(found[[0, 1, 3, 4]], 0.0, atol=1e-9)


@pytest.mark.parametrize("backend", ["sparse"], indirect=True)  # by which it estimates
@pytest.mark.n_cases(few=2_000, long=10_000, many=10_000)
def test_deviations_agree_with_samples(rich, n_cases):
    """Linearised once: samples of the state are passed through the equations of the flows themselves."""
    rng = np.random.default_rng(3)
    result = estimate_state(rich, readings_of(rich, some_meters(rich, rng), rng, sigma=1e-4), backend="sparse")
    C = dense_covariance(result)
    x = rng.multivariate_normal(np.r_[result.va, result.vm], C, size=n_cases, method="svd")
    va, vm = np.split(x, 2, axis=1)
    model = build_branch_model(rich)
    v = vm * np.exp(1j * va)
    samples, division = [], some_division(rich, 1)
    estimated = find_state(rich, result.vm, result.va)
    for k in range(len(x)):
        flows = find_flows(model, v[k, rich.table.port_node])
        s = find_injections(rich, model, flows, vm[k], va[k])
        ends = [(q.real, q.imag, abs(i)) for q, i in ((flows.s_from, flows.i_from), (flows.s_to, flows.i_to))]
        derived = [*ends[0], *ends[1], flows.loss.real, flows.loss.imag, s.real, s.imag]
        totals = find_totals(GridState(rich, model, vm[k], va[k], flows, s), division, estimated.injection)
        samples.append(np.concatenate([*derived, totals.ravel()]))
    found = find_deviations(result, division)
    ours = np.concatenate([found.branches.ravel(), found.injections.ravel(), found.totals.ravel()])
    theirs = np.std(samples, axis=0)
    error = 5 / math.sqrt(2 * len(x))  # five standard deviations of a sampled one
    np.testing.assert_allclose(theirs, ours, rtol=error, atol=1e-8)


@pytest.mark.slow  # it compiles
@pytest.mark.parametrize("loops", [0, 6])
def test_compiled_elimination_alone_finds_deviations_of_flows(loops, monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr(augmented, "FEWEST_COMPILED", 0)
    monkeypatch.setattr(augmented, "find_inverse_entries", None)  # nothing is found anew from other factors
    network, rng = (
        make_grid(3, 80, 1, 0.6, 1.0, loops, 0.0, None, True, MeterShares()).network,
        np.random.default_rng(1),
    )
    assert (len(network.active_branches) >= len(network.buses)) == bool(loops)
    readings = readings_of(network, some_meters(network, rng), rng, noise=0.0)
    assert_dense(estimate_state(network, readings, backend="sparse"))


def test_what_would_take_too_long_is_unknown_and_the_rest_is_there(chain, monkeypatch):
    find = augmented.find_inverse_entries
    monkeypatch.setattr(augmented, "find_block_tree", lambda *_: None)
    monkeypatch.setattr(
        augmented, "find_inverse_entries", lambda A, lu, *at: find(A, lu, *at) if np.array_equal(*at) else None
    )
    network, rng = chain(120), np.random.default_rng(1)
    result = estimate_state(network, readings_of(network, some_meters(network, rng), rng), backend="sparse")
    assert_dense(result)  # by solves
    monkeypatch.setattr(augmented, "MOST_SOLVED", 1000)
    found = find_deviations(result)
    assert np.isnan(found.branches).all()
    assert not np.isnan(found.vm).any()
    metered = {m.meter.bus for m in result.measurements if m.meter.kind is Kind.P_INJECTION}
    known = {bus.id for bus, sigma in zip(network.buses, found.injections[0], strict=True) if not np.isnan(sigma)}
    assert known == metered
