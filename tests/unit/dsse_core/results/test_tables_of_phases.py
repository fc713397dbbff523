"""Tables of networks with phases: rows of nodes and conductors, standard deviations as of dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.division import build_partition
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Network
from dsse_core.grid.nodes import PHASES, Primitive, list_phases
from dsse_core.grid.primitives import build_bank, connect
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.buses import make_bus_table
from dsse_core.results.deviations.choose import find_deviations
from dsse_core.results.flows import find_shunt_powers
from dsse_core.results.results import results_of_estimate, results_of_power_flow
from dsse_core.results.scans import make_scan_table, name_lowest
from dsse_core.results.state import AreaVoltages, find_state, join_states, read_state
from dsse_core.results.totals import division_of, find_totals
from tests.support.ieee_feeders import load_feeder
from tests.support.ieee_feeders.placing import place_meters
from tests.support.phases import DEEP, KIND, TIE, make_feeder, read_meters, solve
from tests.unit.dsse_core.results.test_deviations import dense_covariance

KW, KV = 5000.0 / 3, 4.16 / 3**0.5  # of a phase of the feeder
POWERS = (KIND.P_INJECTION, KIND.Q_INJECTION)
OF_END = (KIND.P_FLOW, KIND.Q_FLOW, KIND.CURRENT)


@pytest.fixture(scope="module")
def feeder() -> Network:
    return make_feeder(TIE)


@pytest.fixture(scope="module")
def estimate(feeder: Network) -> EstimationResult:
    return estimate_state(feeder, read_meters(feeder, 3, 1.0, is_rich=True))


def split_phases(network: Network) -> Network:
    """``network`` with a centre-tapped transformer at phase a of bus 684, and an open line."""
    y = np.array([[4.0, -4.0, 4.0], [-4.0, 8.0, 0.0], [4.0, 0.0, 8.0]]) * (1 - 2j)
    tapped = Branch("684-1", 684, 1, 0.1, 0.2, primitive=Primitive("a", "s1s2", y, np.zeros((3, 3))))
    buses = (*network.buses, Bus(1, 0.208, phases="s1s2"))
    lines = [replace(branch, in_service=branch.id != TIE.id) for branch in network.branches]
    return replace(network, buses=buses, branches=(*lines, tapped))


def test_rows_of_buses_are_nodes_in_kv_to_ground_and_kw_of_a_phase(feeder: Network, estimate: EstimationResult) -> None:
    buses = results_of_estimate(estimate).buses
    places = list(zip(buses.bus.tolist(), buses.phase, strict=True))
    assert places == [(bus.id, phase) for bus in feeder.buses for phase in bus.phases]
    np.testing.assert_allclose(buses.vm_kv, estimate.vm * KV)
    np.testing.assert_allclose(buses.va_deg, np.degrees(estimate.va))
    v = estimate.vm * np.exp(1j * estimate.va)
    s = v * (build_admittance(feeder).ybus @ v).conj()
    np.testing.assert_allclose(buses.p_kw + 1j * buses.q_kvar, KW * s, rtol=0, atol=1e-8)


def test_unbalance_is_the_negative_by_the_positive_sequence_of_the_bus(
    feeder: Network, estimate: EstimationResult
) -> None:
    buses = results_of_estimate(estimate).buses
    a = np.exp(2j * np.pi / 3)
    for bus in feeder.buses:
        here = buses.unbalance_percent[buses.bus == bus.id]
        if bus.phases != "abc":
            assert np.isnan(here).all()
            continue
        v = (estimate.vm * np.exp(1j * estimate.va))[feeder.nodes_at(bus.id)]
        _, positive, negative = np.array([[1, 1, 1], [1, a, a**2], [1, a**2, a]]) @ v
        np.testing.assert_allclose(here, 100 * abs(negative) / abs(positive))


def test_rows_of_branches_are_conductors_whose_powers_add_up_to_the_injections(
    feeder: Network, estimate: EstimationResult
) -> None:
    tables = results_of_estimate(estimate)
    buses, branches = tables.buses, tables.branches
    phases = {branch.id: branch.primitive.from_phases for branch in feeder.branches if branch.primitive}
    expected = [(branch, phase) for branch, found in phases.items() for phase in found]
    assert list(zip(branches.branch, branches.phase, strict=True)) == expected
    into_branches = buses.p_kw - KW * find_shunt_powers(feeder, estimate.vm, estimate.va).real
    for bus, phase, injected in zip(buses.bus, buses.phase, into_branches, strict=True):
        of_phase = np.array(branches.phase) == phase
        away = branches.p_from_kw[of_phase & (branches.from_bus == bus)].sum()
        assert away + branches.p_to_kw[of_phase & (branches.to_bus == bus)].sum() == pytest.approx(injected, abs=1e-8)
    assert branches.loss_kw.sum() == pytest.approx(into_branches.sum())
    at_632 = (branches.from_bus == 632) & (np.array(branches.branch) == "632-671")
    u = buses.vm_kv[feeder.nodes_at(632)]
    s = branches.p_from_kw + 1j * branches.q_from_kvar
    np.testing.assert_allclose(branches.i_from_a[at_632], abs(s[at_632]) / u)


def test_the_neutral_current_is_the_magnitude_of_the_sum_of_all_phases(
    feeder: Network, estimate: EstimationResult
) -> None:
    branches, v = results_of_estimate(estimate).branches, estimate.vm * np.exp(1j * estimate.va)
    i = build_admittance(feeder).stacked @ v
    for branch in feeder.branches:
        meters = [
            Meter(KIND.CURRENT, branch.from_bus, branch.id, phases=phase) for phase in branch.primitive.from_phases
        ]
        model = build_measurement_model(feeder, build_admittance(feeder), meters)
        base = 5000.0 / (3**0.5 * 4.16)
        expected = abs((model.y @ v).sum()) * base
        here = np.array(branches.branch) == branch.id
        np.testing.assert_allclose(branches.neutral_a[here], expected, rtol=0, atol=1e-9)
    assert len(i) == feeder.n_nodes + len(feeder.table.ports)


def test_meters_of_every_kind_read_in_the_table_what_the_model_predicts(feeder: Network) -> None:
    x = solve(feeder)
    meters = [m.meter for m in read_meters(feeder, 3, 1.0, is_rich=True)]
    meters += [
        Meter(KIND.P_INJECTION, 646, phases="bc"),
        Meter(KIND.VA, 671, phases="ab"),
        Meter(KIND.VA, 611, phases="c"),
        Meter(KIND.P_INJECTION, 671),
        Meter(KIND.Q_FLOW, 645, "645-632"),
        Meter(KIND.I_REAL, 671),
        Meter(KIND.I_IMAG, 646),
    ]
    va, vm = np.split(x, 2)
    expected = build_measurement_model(feeder, build_admittance(feeder), meters).predict(x)
    np.testing.assert_allclose(read_state(find_state(feeder, vm, va), meters), expected, rtol=0, atol=1e-12)


def test_the_table_of_meters_names_the_phases_and_counts_powers_of_a_third_of_the_base(
    feeder: Network, estimate: EstimationResult
) -> None:
    meters = results_of_estimate(estimate).meters
    row = meters.meter.index("p_flow@632.b:645-632")
    assert (meters.bus[row], meters.branch[row], meters.phase[row]) == (632, "645-632", "b")
    assert meters.value_kw[row] == pytest.approx(estimate.values[row] * KW)
    assert meters.phase[meters.meter.index("vm@671.bc")] == "bc"


def assert_dense(result: EstimationResult) -> None:
    """To 2e-6 of each variance, beside the rounding of dense algebra in differences of large numbers."""
    network, x = result.network, np.concatenate([result.va, result.vm])
    admittance, C = build_admittance(network), dense_covariance(result)
    division = division_of(build_partition(network, {"all": [bus.id for bus in network.buses]}))
    found = find_deviations(result, division)

    def rows(meters: list[Meter]) -> np.ndarray:
        return build_measurement_model(network, admittance, meters).jacobian(x).toarray()

    def variance(H: np.ndarray) -> np.ndarray:
        return np.einsum("ki,ij,kj->k", H, C, H)

    def check(ours: np.ndarray, H: np.ndarray, what: str) -> None:
        theirs, round_off = variance(H), 1e-13 * (abs(H) @ np.sqrt(np.diag(C))) ** 2
        wrong = abs(ours**2 - theirs) > 2e-6 * theirs + round_off
        assert not wrong.any(), (what, ours[wrong] ** 2, theirs[wrong], round_off[wrong])

    check(np.concatenate([found.va, found.vm]), np.eye(len(x)), "voltages")
    places = [(bus.id, phase) for bus in network.buses for phase in list_phases(bus.phases)]
    for k, kind in enumerate(POWERS):
        check(found.injections[k], rows([Meter(kind, bus, phases=p) for bus, p in places]), kind)
    model = find_state(network, result.vm, result.va).branches
    at_ends = []
    for end, of_end in enumerate((model.f, model.t)):
        here = np.flatnonzero(model.in_service & (of_end >= 0))
        at_ends.append(np.zeros((2, len(of_end), len(x))))
        for k, kind in enumerate(OF_END):
            branches = [network.branches[model.branch[row]] for row in here]
            buses = [(b.from_bus, b.to_bus)[end] for b in branches]
            named = zip(buses, branches, model.phase[here].tolist(), strict=True)
            H = rows([Meter(kind, bus, b.id, phases=PHASES[phase]) for bus, b, phase in named])
            check(found.branches[3 * end + k, here], H, f"{kind} at end {end}")
            if kind is not KIND.CURRENT:
                at_ends[end][k, here] = H
    for k in (0, 1):
        check(found.branches[6 + k], at_ends[0][k] + at_ends[1][k], "losses")
    loss, n = (at_ends[0] + at_ends[1]).sum(axis=1), network.n_nodes
    steps = 1e-6 * np.eye(2 * n)
    drawn = [
        [find_shunt_powers(network, *np.split(x + sign * step, 2)[::-1]).sum() for sign in (1, -1)] for step in steps
    ]
    of_shunts = -np.diff(drawn, axis=1).ravel() / 2e-6
    for k, of_shunt in enumerate((np.real, np.imag)):
        loss[k] += of_shunt(of_shunts)
    check(found.totals[:, 2, 0], loss, "total loss")


@pytest.mark.parametrize("seed", [1, 2])
def test_standard_deviations_are_those_of_dense_linear_algebra(feeder: Network, seed: int) -> None:
    buses = tuple(replace(bus, b_shunt=0.02, g_shunt=0.01) if bus.id == 675 else bus for bus in feeder.buses)
    for network, is_rich in ((feeder, False), (replace(feeder, buses=buses), True)):
        assert_dense(estimate_state(network, read_meters(network, seed, 1.0, is_rich=is_rich)))


@pytest.mark.parametrize("name", ["ieee13", "4bus-yd"])
def test_standard_deviations_of_feeders_with_capacitors_and_delta_windings_are_dense_ones(name: str) -> None:
    network = load_feeder(name)
    assert_dense(estimate_state(network, place_meters(network, 1, None, is_rich=False)))


def test_a_conductor_without_one_of_its_ends_is_empty_there_and_losses_add_up(feeder: Network) -> None:
    network = split_phases(feeder)
    readings = read_meters(network, 1, 0.5, is_rich=True)
    result = estimate_state(network, readings)
    branches = results_of_estimate(result).branches
    here = [branches.branch.index("684-1") + k for k in range(3)]
    assert [branches.phase[k] for k in here] == ["a", "s1", "s2"]
    for column in (branches.p_from_kw, branches.sigma_p_from_kw):
        np.testing.assert_array_equal(np.isnan(column[here]), [False, True, True])
    for column in (branches.i_to_a, branches.sigma_p_to_kw):
        np.testing.assert_array_equal(np.isnan(column[here]), [True, False, False])
    drawn = KW * find_shunt_powers(network, result.vm, result.va).real.sum()
    assert branches.loss_kw.sum() + drawn == pytest.approx(results_of_estimate(result).buses.p_kw.sum())
    opened = np.array([branch == TIE.id for branch in branches.branch])
    assert not branches.in_service[opened].any()
    np.testing.assert_array_equal(branches.p_from_kw[opened], 0.0)
    assert_dense(result)


def test_areas_join_to_the_state_of_the_whole_network_and_their_totals_balance() -> None:
    network = make_feeder()
    partition, x = build_partition(network, DEEP), solve(make_feeder())
    va, vm = np.split(x, 2)
    by_area = {name: AreaVoltages(vm[rows], va[rows], True, 7) for name, rows in partition.rows_of_nodes.items()}
    joined, whole = join_states(partition, by_area), find_state(network, vm, va)
    np.testing.assert_allclose(joined.injection, whole.injection, rtol=0, atol=1e-12)
    np.testing.assert_allclose(joined.flows.s_to, whole.flows.s_to, rtol=0, atol=1e-12)
    load, generation, loss, came = find_totals(joined, division_of(partition)).transpose(1, 0, 2)
    np.testing.assert_allclose(generation + came, load + loss, rtol=0, atol=1e-12)
    assert came.sum() == pytest.approx(0, abs=1e-12)
    later = join_states(partition, by_area | {"west": replace(by_area["west"], scan=8)})
    unknown = np.flatnonzero(np.isnan(later.injection))
    np.testing.assert_array_equal(unknown, sorted([*network.nodes_at(671), *network.nodes_at(684)]))


def test_meters_between_phases_of_an_area_without_estimate_read_nothing_known() -> None:
    network = make_feeder()
    partition, (va, vm) = build_partition(network, DEEP), np.split(solve(network), 2)
    rows = partition.rows_of_nodes["head"]
    joined = join_states(partition, {"head": AreaVoltages(vm[rows], va[rows], True, 7)})
    known = Meter(KIND.VM, 632, phases="ab")
    unknown = [Meter(KIND.P_INJECTION, 646, phases="bc"), Meter(KIND.I_REAL, 646), Meter(KIND.VM, 646, phases="bc")]
    np.testing.assert_array_equal(np.isnan(read_state(joined, [known, *unknown])), [False, True, True, True])


def test_a_short_line_has_the_deviations_of_dense_algebra(feeder: Network) -> None:
    """Branches a thousand times shorter than the others: their losses are a difference of nearly equal powers."""
    short = [
        replace(
            b, primitive=replace(b.primitive, y=(b.primitive.y - b.primitive.charging) * 1e3 + b.primitive.charging)
        )
        if b.id in ("645-646", "671-692") and b.primitive
        else b
        for b in feeder.branches
    ]
    network = replace(feeder, branches=tuple(short))
    readings: list[Measurement] = read_meters(network, 1, 0.0, is_rich=True)
    assert_dense(estimate_state(network, readings))


def test_rows_of_a_part_without_ground_say_so_and_promise_no_voltages_to_ground(feeder: Network) -> None:
    delta = Primitive(
        "abc", "abc", build_bank(connect("abc", "grounded"), connect("abc", "delta"), 1 - 6j).y, np.zeros((6, 6))
    )
    loose = [replace(b, primitive=delta) if b.id == "692-675" else b for b in feeder.branches if b.id != TIE.id]
    loads = tuple(
        Load(load.bus, load.phases + "bca"["abc".index(load.phases)], load.s) if load.bus == 675 else load
        for load in feeder.loads
    )
    buses = tuple(replace(bus, b_shunt=1e-5) if bus.id == 675 else bus for bus in feeder.buses)
    network = replace(feeder, buses=buses, branches=tuple(loose), loads=loads, shunts=())
    result = solve_power_flow(network)
    tables = results_of_power_flow(result, meters=[Meter(KIND.P_INJECTION, 675), Meter(KIND.VM, 675, phases="ab")])
    buses, at = tables.buses, network.nodes_at(675)
    np.testing.assert_array_equal(buses.grounded, buses.bus != 675)
    drawn = sum(load.s for load in loads if load.bus == 675)
    assert buses.p_kw[at].sum() == pytest.approx(-drawn.real * KW)
    assert tables.meters.estimate_kw[0] == pytest.approx(-drawn.real * KW)
    v = buses.vm_pu[at] * np.exp(1j * np.radians(buses.va_deg[at]))
    assert tables.meters.estimate_pu[1] == pytest.approx(abs(v[0] - v[1]))
    sigma = np.ones(len(buses))
    made = make_bus_table(
        find_state(network, result.vm, result.va), [""] * len(buses), {}, sigma, sigma, np.ones((2, len(buses)))
    )
    np.testing.assert_array_equal(np.isnan(made.sigma_vm_kv), ~buses.grounded)


def test_the_table_of_many_scans_names_the_phases_of_its_extreme_voltages(feeder: Network) -> None:
    readings = read_meters(feeder, 3, 1.0, is_rich=True)
    plan = build_estimation_plan(feeder, [m.meter for m in readings])
    values = np.array([[m.value for m in readings], [np.nan] * len(readings)])
    sigmas = np.tile([m.sigma for m in readings], (2, 1))
    batch, none = estimate_batch(plan, values, sigmas), np.zeros(2)
    scans = make_scan_table(("one", "two"), none, batch, none, none, {}, {}, {}, none > 0)
    lowest = int(np.argmin(batch.vm[0]))
    assert name_lowest(scans, 0) == feeder.node_names[lowest]
    assert (name_lowest(scans, 1), scans.highest_vm_phase[1]) == ("", "")
    assert scans.columns.index("lowest_vm_phase") == scans.columns.index("lowest_vm_bus") + 1
