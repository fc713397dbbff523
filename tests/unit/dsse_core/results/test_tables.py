"""The tables of an estimate: residuals, statuses, loading, shunts, open branches, totals of areas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Bus, Control, Generator, Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.deviations import choose as deviations
from dsse_core.results.meters import UNITS, make_meter_table, read_in_own_units
from dsse_core.results.results import Results, results_of_estimate, results_of_power_flow
from dsse_core.results.state import AreaVoltages, find_state, join_states, read_state
from dsse_core.results.table import Table
from scenarios.scenario import load_scenario
from tests.support.dense_rows import rows_of

Kind = MeasurementKind
POWERS = (Kind.P_INJECTION, Kind.Q_INJECTION)


def row_of(table: Table, column: str, value: object) -> dict[str, object]:
    return dict(zip(table.columns, list(table.rows())[list(table[column]).index(value)], strict=True))


@pytest.fixture
def solved(meshed) -> Results:
    return results_of_power_flow(solve_power_flow(meshed))


def test_what_meters_read_in_a_state_is_what_the_measurement_model_predicts(meshed, meters_of):
    truth, meters = solve_power_flow(meshed), meters_of(meshed)
    state = find_state(meshed, truth.vm, truth.va)
    np.testing.assert_allclose(read_state(state, meters), truth.read_all(meters), rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.injection, truth.injection, rtol=0, atol=1e-12)


def test_an_injection_is_not_added_up_from_states_of_different_scans():
    scenario = load_scenario("ieee33")
    truth, partition = solve_power_flow(scenario.network), scenario.partition
    rows_of_areas = partition.rows_of_buses.items()
    states = {name: AreaVoltages(truth.vm[rows], truth.va[rows], True, scan=7) for name, rows in rows_of_areas}
    np.testing.assert_allclose(join_states(partition, states).injection, truth.injection, rtol=0, atol=1e-12)
    later = join_states(partition, states | {"area2": replace(states["area2"], scan=8)})
    ids = scenario.network.table.bus_id
    assert ids[np.isnan(later.injection)].tolist() == [
        b for b, names in partition.boundaries.items() if "area2" in names
    ]
    assert not np.isnan(later.vm).any()


def test_normalised_residuals_are_those_of_dense_algebra(meters_of, read, backend, rich):
    meters = meters_of(rich, Kind.VM, Kind.VA, *POWERS, Kind.P_FLOW, Kind.Q_FLOW)
    result = estimate_state(rich, read(solve_power_flow(rich), meters, noise=np.random.default_rng(1)), backend=backend)
    H, R = rows_of(result), np.diag(result.sigmas**2)
    omega = np.diag(R - H @ np.linalg.inv(H.T @ np.linalg.inv(R) @ H) @ H.T)
    table = results_of_estimate(result).meters
    np.testing.assert_allclose(table.normalised_residual, abs(result.residual) / np.sqrt(omega), rtol=1e-6)
    own = read_in_own_units(table)
    np.testing.assert_allclose(own["value"] - own["estimate"], own["residual"], atol=1e-9)
    of_power = ~np.isnan(table.value_kw) | ~np.isnan(table.value_kvar)
    assert of_power.any()
    np.testing.assert_allclose(own["residual"][of_power], result.residual[of_power] * rich.base_mva * 1e3, atol=1e-7)
    columns = [table[f"value_{unit}"] for unit in UNITS]
    assert ((~np.isnan(columns)).sum(axis=0) == 1).all(), "a reading stands in the column of its unit alone"
    assert set(table.status) == {"used"}


def test_totals_of_areas_are_not_derived_before_they_are_asked_for(meters_of, read, backend, rich, monkeypatch):
    readings = read(solve_power_flow(rich), meters_of(rich, Kind.VM, *POWERS, Kind.P_FLOW, Kind.Q_FLOW))
    result, asked = estimate_state(rich, readings, backend=backend), []
    find = deviations.find_total_gradients
    monkeypatch.setattr(deviations, "find_total_gradients", lambda *given: asked.append(given) or find(*given))
    tables = results_of_estimate(result)
    assert len(tables.buses) == len(rich.buses)
    assert asked == []
    assert (tables.areas.sigma_loss_kw > 0).all()
    assert len(asked) == 1


def test_every_meter_says_what_became_of_it(meshed, meters_of, read):
    meters = meters_of(meshed, Kind.VM, *POWERS, Kind.P_FLOW, Kind.Q_FLOW)
    readings = read(solve_power_flow(meshed), meters, sigma=0.001, noise=np.random.default_rng(4))
    at = next(k for k, m in enumerate(readings) if m.meter.id == "p_injection@3")
    readings[at] = replace(readings[at], value=readings[at].value + 0.05)
    silent = Meter(Kind.CURRENT, 2, "2-3")
    report = process_bad_data(meshed, readings)
    table = results_of_estimate(report, meters=[silent, *meters]).meters
    assert table.meter[0] == silent.id
    assert table.status[0] == "silent"
    assert math.isnan(table.value_a[0])
    assert table.estimate_a[0] > 0
    gone = row_of(table, "meter", "p_injection@3")
    assert gone["status"] == "removed"
    assert gone["normalised_residual"] == report.removed[0].normalized_residual
    assert gone["residual_kw"] == pytest.approx(0.05 * meshed.base_mva * 1e3, rel=0.1)
    assert set(results_of_estimate(report).meters.meter) == {m.id for m in meters}


def test_a_meter_that_cannot_be_spared_is_critical_and_has_no_normalised_residual(chain, read):
    network = chain(4)
    meters = [Meter(Kind.VM, 1), *(Meter(k, bus) for bus in (2, 3, 4) for k in POWERS)]
    report = process_bad_data(network, read(solve_power_flow(network), meters))
    table = results_of_estimate(report).meters
    assert set(table.status) == {"critical"}
    assert np.isnan(table.normalised_residual).all()


def test_a_residual_of_angles_is_wrapped(chain):
    state = find_state(chain(2), np.ones(2), np.array([0.0, math.radians(-179.0)]))
    one = np.full(1, 0.01)
    table = make_meter_table(state, [Meter(Kind.VA, 2)], np.radians([179.0]), one, one**2, {}, ())
    assert table.residual_deg.tolist() == pytest.approx([-2.0])
    assert table.normalised_residual.tolist() == pytest.approx([math.radians(2.0) / 0.01])


def test_angles_are_shown_between_minus_and_plus_a_half_turn(solved, meshed):
    whole_turns = 2 * math.pi * np.resize([-1, 0, 2], len(meshed.buses))
    state = solve_power_flow(meshed)
    turned = results_of_power_flow(replace(state, va=state.va + whole_turns)).buses.va_deg
    np.testing.assert_allclose(turned, solved.buses.va_deg, rtol=0, atol=1e-12)


def test_a_network_of_one_bus_has_tables(backend):
    network = Network("one", 1.0, (Bus(1, 10.0),), (), (Generator(1, Control.SLACK),))
    measurements = [Measurement(Meter(Kind.VM, 1), 1.0, 0.01), Measurement(Meter(Kind.P_INJECTION, 1), 0.0, 0.01)]
    results = results_of_estimate(process_bad_data(network, measurements, backend=backend))
    assert read_in_own_units(results.meters)["estimate"].tolist() == pytest.approx([1.0, 0.0])
    assert results.buses.vm_pu.tolist() == pytest.approx([1.0])


def test_an_open_branch_carries_nothing_and_stays_in_the_table(solved, meshed):
    row = row_of(solved.branches, "branch", "6-2")
    assert row["in_service"] is False
    assert [row[key] for key in ("p_from_kw", "q_to_kvar", "i_from_a", "loss_kw")] == [0.0] * 4
    assert len(solved.branches) == len(meshed.branches)


def test_losses_of_branches_and_shunts_are_what_is_injected_and_not_taken_out(solved, meshed):
    y = np.array([complex(bus.g_shunt, -bus.b_shunt) for bus in meshed.buses])
    shunts = (y * solved.buses.vm_pu**2).sum() * 1e3 * meshed.base_mva
    assert solved.buses.p_kw.sum() == pytest.approx(solved.branches.loss_kw.sum() + shunts.real, abs=1e-6)
    assert solved.buses.q_kvar.sum() == pytest.approx(solved.branches.loss_kvar.sum() + shunts.imag, abs=1e-6)
    assert solved.areas.loss_kw.tolist() == pytest.approx([solved.buses.p_kw.sum()])


def test_currents_are_in_the_amperes_of_each_end(solved):
    """Across 10-2, 110 to 20 kV with a tap of 1.03, the ampere-turns are equal."""
    row = row_of(solved.branches, "branch", "10-2")
    assert row["i_to_a"] / row["i_from_a"] == pytest.approx(110 / 20 * 1.03, rel=1e-9)
    s = math.hypot(row["p_from_kw"], row["q_from_kvar"])
    vm_kv = row_of(solved.buses, "bus", 10)["vm_kv"]
    assert row["i_from_a"] == pytest.approx(s / (math.sqrt(3) * vm_kv), rel=1e-9)


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_loading_is_the_larger_end_by_the_rating(meshed, share):
    plain = results_of_power_flow(solve_power_flow(meshed)).branches
    k, base_a = plain.branch.index("2-3"), 1e3 * meshed.base_mva / (math.sqrt(3) * 20.0)
    i_max = max(plain.i_from_a[k], plain.i_to_a[k]) / base_a / share
    s = max(math.hypot(plain.p_from_kw[0], plain.q_from_kvar[0]), math.hypot(plain.p_to_kw[0], plain.q_to_kvar[0]))
    rated = {"2-3": {"i_max": i_max}, "10-2": {"s_max": s / (1e3 * meshed.base_mva) / share}}
    branches = tuple(replace(b, **rated.get(b.id, {})) for b in meshed.branches)
    loading = results_of_power_flow(solve_power_flow(replace(meshed, branches=branches))).branches.loading_percent
    assert loading[k] == pytest.approx(100 * share, rel=1e-9)
    assert loading[0] == pytest.approx(100 * share, rel=1e-9)
    assert np.isnan(np.delete(loading, [0, k])).all()


@pytest.mark.parametrize("rating", [0.0, -1.0, math.nan, math.inf])
def test_a_rating_that_is_none_is_rejected(meshed, rating):
    first, *others = meshed.branches
    with pytest.raises(InvalidInputError, match="a rating is positive"):
        replace(meshed, branches=(replace(first, i_max=rating), *others))


def test_a_power_flow_has_no_deviations_and_no_readings(meshed, meters_of):
    tables = results_of_power_flow(solve_power_flow(meshed), meters=meters_of(meshed, Kind.VM))
    for table in (tables.buses, tables.branches):
        for column in (c for c in table.columns if c.startswith("sigma_")):
            assert np.isnan(table[column]).all()
    assert set(tables.meters.status) == {"silent"}
    assert tables.buses.true_vm_pu.tolist() == tables.buses.vm_pu.tolist()


def test_areas_add_up_their_own_and_exchange_the_rest(chain):
    network = chain(9)
    partition = build_partition(network, {"a": (1, 2, 3, 4), "b": (4, 5, 6, 7), "c": (7, 8, 9)})
    tables = results_of_power_flow(solve_power_flow(network), partition=partition)
    areas, branches = tables.areas, tables.branches
    assert areas.area == ("a", "b", "c")
    assert areas.owned_buses.tolist() == [4, 3, 2]
    into_b = row_of(branches, "branch", "4-5")["p_from_kw"]
    into_c = row_of(branches, "branch", "7-8")["p_from_kw"]
    assert areas.import_kw.tolist() == pytest.approx([-into_b, into_b - into_c, into_c])
    np.testing.assert_allclose(areas.generation_kw + areas.import_kw, areas.load_kw + areas.loss_kw, atol=1e-8)
    assert areas.load_kw[1] == pytest.approx(3 * 0.5 / 9 * 1e3)
