"""h(x) against the branch equations, H(x) against finite differences."""

import cmath
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.grid.admittance import build_admittance, find_no_load, flat_start
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Network

Kind = MeasurementKind


def random_state(network, seed):
    rng = np.random.default_rng(seed)
    n = len(network.buses)
    return np.r_[rng.uniform(-1.0, 1.0, n), rng.uniform(0.85, 1.15, n)]


def model_of(network, meters):
    return build_measurement_model(network, build_admittance(network), meters)


@pytest.mark.parametrize("kind", list(Kind))
@pytest.mark.parametrize("seed", range(3))
def test_every_derivative_agrees_with_central_differences(meshed, meters_of, kind, seed):
    model, x, step = model_of(meshed, meters_of(meshed, kind)), random_state(meshed, seed), 1e-6
    numerical = np.column_stack(
        [(model.predict(x + step * e) - model.predict(x - step * e)) / (2 * step) for e in np.eye(len(x))]
    )
    np.testing.assert_allclose(model.jacobian(x).toarray(), numerical, atol=2e-8)


def test_derivatives_by_estimated_taps_agree_with_central_differences(meshed, meters_of):
    network = replace(meshed, branches=tuple(replace(b, estimate_tap=True) for b in meshed.branches))
    admittance, meters, first = build_admittance(network), meters_of(network, *Kind), 2 * len(network.buses)
    model, step = build_measurement_model(network, admittance, meters, first_tap=first), 1e-6
    taps = network.taps * np.random.default_rng(0).uniform(0.9, 1.1, len(network.taps))
    x = np.r_[random_state(network, 0), taps]
    numerical = np.column_stack(
        [(model.predict(x + step * e) - model.predict(x - step * e)) / (2 * step) for e in np.eye(len(x))]
    )
    np.testing.assert_allclose(model.jacobian(x).toarray(), numerical, atol=2e-8)
    moved = network.with_taps(dict(zip(network.estimated_taps, taps.tolist(), strict=True)))
    np.testing.assert_allclose(model.predict(x), model_of(moved, meters).predict(x[:first]), atol=1e-12)


@pytest.mark.parametrize("kind", [Kind.VM, Kind.VA])
def test_a_row_of_voltage_has_no_entries_of_other_nodes_that_would_fill_in_the_tableau(meshed, meters_of, kind):
    meters = meters_of(meshed, kind)
    H, n, row = model_of(meshed, meters).jacobian(random_state(meshed, 0)), len(meshed.buses), meshed.row
    for k, meter in enumerate(meters):
        assert H.indices[H.indptr[k] : H.indptr[k + 1]].tolist() == [row[meter.bus], n + row[meter.bus]]


@pytest.mark.parametrize("kind", [Kind.P_FLOW, Kind.Q_INJECTION, Kind.VM])
def test_the_derivatives_hold_also_where_newton_has_passed_through_a_negative_magnitude(meshed, meters_of, kind):
    model, x, step = model_of(meshed, meters_of(meshed, kind)), random_state(meshed, 5), 1e-6
    x[-1] = -0.4
    numerical = np.column_stack(
        [(model.predict(x + step * e) - model.predict(x - step * e)) / (2 * step) for e in np.eye(len(x))]
    )
    np.testing.assert_allclose(model.jacobian(x).toarray(), numerical, atol=2e-8)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_code_finds_the_same_derivatives(meshed, meters_of, seed):
    """Of every kind of meter, also where a magnitude is negative or 0."""
    pytest.importorskip("numba")
    model, x = model_of(meshed, meters_of(meshed, *Kind)), random_state(meshed, seed)
    x[-1], x[-2] = -0.4, 0.0
    h, H = model.linearize(x)
    found, entries = model.linearize_compiled(x)
    np.testing.assert_allclose(found, h, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(entries, H.data, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(model.linearize_compiled(x, with_H=False)[0], found)


def test_the_derivatives_of_mixed_meters_stand_in_the_order_of_the_meters(meshed, meters_of):
    meters = meters_of(meshed, *Kind)
    np.random.default_rng(0).shuffle(meters)
    x = random_state(meshed, 9)
    H = model_of(meshed, meters).jacobian(x).toarray()
    for row in (0, 7, len(meters) // 2, len(meters) - 1):
        np.testing.assert_array_equal(H[row], model_of(meshed, [meters[row]]).jacobian(x).toarray()[0])


def branch_current(branch, v_from, v_to, at_from):
    """Textbook pi-equivalent behind an ideal transformer at the from side; current into the branch."""
    ratio = cmath.rect(branch.tap, branch.shift)
    behind = v_from / ratio
    series = (behind - v_to) / complex(branch.r, branch.x)
    charging = 0.5j * branch.b
    if at_from:
        return (series + charging * behind) / ratio.conjugate()
    return -series + charging * v_to


@pytest.mark.parametrize("seed", range(3))
def test_flows_and_currents_at_both_ends_follow_from_the_branch_equations(meshed, meters_of, seed):
    x = random_state(meshed, seed)
    va, vm = np.split(x, 2)
    v = dict(zip(meshed.row, vm * np.exp(1j * va), strict=True))
    for kind, value_of in ((Kind.P_FLOW, lambda s, i: s.real), (Kind.Q_FLOW, lambda s, i: s.imag),
                           (Kind.CURRENT, lambda s, i: abs(i))):  # fmt: skip
        meters = meters_of(meshed, kind)
        for meter, found in zip(meters, model_of(meshed, meters).predict(x), strict=True):
            branch = meshed.branch(meter.branch)
            i = branch_current(branch, v[branch.from_bus], v[branch.to_bus], meter.bus == branch.from_bus)
            assert found == pytest.approx(value_of(v[meter.bus] * i.conjugate(), i), abs=1e-13)


def test_injections_are_the_flows_that_leave_the_bus_plus_what_its_shunt_draws(meshed, meters_of):
    x = random_state(meshed, 4)
    va, vm = np.split(x, 2)
    v = dict(zip(meshed.row, vm * np.exp(1j * va), strict=True))
    p = model_of(meshed, meters_of(meshed, Kind.P_INJECTION)).predict(x)
    q = model_of(meshed, meters_of(meshed, Kind.Q_INJECTION)).predict(x)
    for row, bus in enumerate(meshed.buses):
        i = complex(bus.g_shunt, bus.b_shunt) * v[bus.id]
        for b in meshed.branches_at[bus.id]:
            i += branch_current(b, v[b.from_bus], v[b.to_bus], b.from_bus == bus.id)
        assert complex(p[row], q[row]) == pytest.approx(v[bus.id] * i.conjugate(), abs=1e-13)


def test_voltages_read_as_they_are(meshed, meters_of):
    x = random_state(meshed, 1)
    n = len(meshed.buses)
    np.testing.assert_allclose(model_of(meshed, meters_of(meshed, Kind.VA)).predict(x), x[:n], atol=1e-15)
    np.testing.assert_allclose(model_of(meshed, meters_of(meshed, Kind.VM)).predict(x), x[n:], atol=1e-15)


def test_the_flat_start_carries_no_current_through_a_radial_network_without_shunts(case, meters_of):
    network = case("industrial13")
    vm, va = flat_start(network, 1)
    currents = model_of(network, meters_of(network, Kind.CURRENT)).predict(np.r_[va, vm])
    assert currents.max() < 1e-12


def test_the_flat_start_follows_phase_shifts_and_taps_in_both_directions(meshed):
    vm, va = flat_start(meshed, 10)
    angle = dict(zip(meshed.row, np.degrees(va), strict=True))
    magnitude = dict(zip(meshed.row, vm, strict=True))
    assert angle[2] == pytest.approx(-150)
    assert (angle[5] - angle[4] + 180) % 360 - 180 == pytest.approx(-30)
    assert magnitude[2] == pytest.approx(1 / 1.03)
    assert magnitude[5] == pytest.approx(0.97 / 1.03)


def walk_by_hand(network, reference):
    """Voltage and angle of each bus that is reached, branch by branch."""
    reached, queue = {reference: (1.0, 0.0)}, [reference]
    for here in queue:  # which grows
        vm, va = reached[here]
        for branch in network.branches_at[here]:
            if (there := branch.other_end(here)) not in reached:
                forward = here == branch.from_bus
                reached[there] = (
                    vm / branch.tap if forward else vm * branch.tap,
                    va - branch.shift if forward else va + branch.shift,
                )
                queue.append(there)
    return reached


@pytest.mark.parametrize("seed", range(20))
def test_the_unloaded_voltages_are_those_of_a_walk_bus_by_bus(seed):
    rng = np.random.default_rng(seed)
    ids = rng.permutation(1000)[:30].tolist()
    tree = [(ids[k], ids[int(rng.integers(k))]) for k in range(1, 28)]  # two buses are out of reach
    ends = [pair if rng.random() < 0.5 else pair[::-1] for pair in tree]
    branches = tuple(
        Branch(f"{k}", *pair, 0.01, 0.02, tap=1 + 0.1 * rng.random(), shift=rng.normal()) for k, pair in enumerate(ends)
    )
    extra = Branch("loop", ids[3], ids[20], 0.01, 0.02, in_service=False)
    network = Network("x", 1.0, tuple(Bus(bus, 20.0) for bus in ids), (*branches, extra))
    vm, va = find_no_load(network, ids[5])
    expected = walk_by_hand(network, ids[5])
    assert network.find_unreached_buses(ids[5]) == tuple(bus for bus in ids if bus not in expected)
    for bus, row in network.row.items():
        assert (vm[row], va[row]) == pytest.approx(expected.get(bus, (1.0, 0.0)), rel=1e-14, abs=1e-14)


def test_a_current_magnitude_without_current_has_derivative_zero_and_not_nan(chain):
    network = chain(3)
    vm, va = flat_start(network, 1)
    H = model_of(network, [Meter(Kind.CURRENT, 1, "1-2")]).jacobian(np.r_[va, vm])
    assert (H.toarray() == 0).all()


def test_at_zero_voltage_the_derivatives_of_a_voltmeter_are_zero_and_not_infinite(meshed, meters_of):
    model = build_measurement_model(meshed, build_admittance(meshed), meters_of(meshed, *Kind))
    with np.errstate(all="raise"):
        H = model.jacobian(np.zeros(2 * len(meshed.buses)))
    assert np.isfinite(H.data).all()


def ring_of_transformers(taps):
    """Buses 1, 2, ... in a ring of branches from each to the next, and bus 9 behind bus 2."""
    n = len(taps)
    ring = [Branch(f"{k}", k, k % n + 1, 0.001, 0.02 * k, tap=taps[k - 1]) for k in range(1, n + 1)]
    spur = Branch("spur", 2, 9, 0.0, 0.01, tap=1.05)
    return Network("ring", 1.0, tuple(Bus(k, 20.0) for k in (*range(1, n + 1), 9)), (*ring, spur))


def test_taps_that_do_not_cancel_around_a_loop_are_balanced_between_its_branches():
    network = ring_of_transformers([1.1, 1.1, 1.1, 1.0])
    vm, va = find_no_load(network, 1)
    into = dict.fromkeys(network.row, 0.0)
    for b in network.active_branches:
        i = (vm[network.row[b.from_bus]] / b.tap - vm[network.row[b.to_bus]]) / abs(complex(b.r, b.x))
        into[b.from_bus] -= i / b.tap
        into[b.to_bus] += i
    assert [into[bus] for bus in (2, 3, 4, 9)] == pytest.approx([0.0] * 4, abs=1e-12)
    assert vm[network.row[1]] == 1.0
    assert vm[network.row[9]] == pytest.approx(vm[network.row[2]] / 1.05)
    assert (va == 0).all()


def test_taps_that_cancel_around_a_loop_give_the_voltages_of_the_walk():
    network = ring_of_transformers([1.1, 1 / 1.1, 1.25, 0.8])
    vm, _ = find_no_load(network, 1)
    assert vm == pytest.approx([1.0, 1 / 1.1, 1.0, 0.8, 1 / 1.1 / 1.05])


def test_a_held_magnitude_draws_the_unloaded_voltages_beside_it():
    vm, _ = find_no_load(ring_of_transformers([1.0, 1.0, 1.0, 1.0]), 1, {1: 1.02, 3: 0.98})
    assert (vm[0], vm[2]) == (1.02, 0.98)
    assert (vm[[1, 3]] > 0.98).all()
    assert (vm[[1, 3]] < 1.02).all()
