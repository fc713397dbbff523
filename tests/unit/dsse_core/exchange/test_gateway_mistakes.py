"""The likelihood ratio of a mistake of a whole gateway, its accumulation, and what it must not be misled by."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from dsse_core.exchange.gateway_mistakes import MISTAKES, THRESHOLD, GatewayTest, add_up, expect_loads
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Network
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.linear.area_model import build_area_model
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

SCENARIO = load_scenario("industrial13")
READINGS = list(make_telemetry(SCENARIO).union)


def whole_grid() -> Area:
    network = SCENARIO.network
    assert network.slack
    return Area("grid", network, (), network.slack.bus, network.slack.vm, (network.slack.bus, network.slack.va))


def is_power(m: Measurement) -> bool:
    return m.meter.kind.of_power and m.meter.source is not Source.VIRTUAL


def multiply(factor: float, readings: list[Measurement] = READINGS) -> list[Measurement]:
    return [replace(m, value=factor * m.value) if is_power(m) else m for m in readings]


def weigh(readings: list[Measurement]) -> dict[float, float]:
    return GatewayTest(whole_grid()).weigh(readings, {m.meter.id for m in readings}, None, {})


@pytest.mark.parametrize("factor", MISTAKES)
def test_the_mistake_is_the_one_that_fits(factor: float):
    found = weigh(multiply(1 / factor))
    assert max(found, key=found.__getitem__) == factor
    assert found[factor] > THRESHOLD
    assert max(weigh(READINGS).values()) < 0


def test_the_ratio_of_a_sign_is_half_the_difference_of_the_least_sums_of_squares():
    area, turned = whole_grid(), multiply(-1.0)
    loads = expect_loads(area)
    model = build_area_model(area, turned, area.reference[0] if area.reference else None)
    at = {(m.meter.kind, m.meter.bus, m.meter.phases): k for k, m in enumerate(turned) if m.meter.kind.of_injection}
    sign = np.array([-1.0 if is_power(m) else 1.0 for m in turned])
    flat = np.concatenate([np.zeros(len(area.network.buses)), np.ones(len(area.network.buses))])

    def find_least(z: np.ndarray) -> float:
        def find_residuals(free: np.ndarray) -> np.ndarray:
            x = flat.copy()
            x[model.free] = free
            h = model.predict(x)
            exact = np.where(model.virtual, 1e6, 1 / model.sigma)  # of virtual measurements only the weight counts
            of_loads = [(h[at[place]] - load.mean) / load.sigma for place, load in loads.items()]
            return np.concatenate([(z - h) * exact, of_loads])

        return 2 * float(least_squares(find_residuals, flat[model.free], xtol=1e-14, ftol=1e-14, gtol=1e-14).cost)

    as_stated, mistaken = find_least(model.z), find_least(sign * model.z)
    n = int((~model.virtual).sum()) + len(loads)
    reference = max(-as_stated / 2, -n / 2 * (1 + math.log(max(as_stated / n, 1.0))))
    assert weigh(turned)[-1.0] == pytest.approx(-mistaken / 2 - reference, rel=1e-4)


def test_where_standard_deviations_are_shares_of_what_is_read_a_unit_is_found_too():
    scaled = [replace(m, value=m.value / 1000, sigma=m.sigma / 1000) if is_power(m) else m for m in READINGS]
    found = weigh(scaled)
    assert max(found, key=found.__getitem__) == 1e3
    assert found[1e3] > THRESHOLD


def test_without_power_readings_nothing_is_weighed_and_zeros_have_no_unit():
    assert weigh([m for m in READINGS if not is_power(m)]) == {}
    assert weigh(multiply(0.0)) == {}


def lateral(load: complex) -> Area:
    """Buses 1 to 3 in a row, the load at the last one; the parent is met at bus 1."""
    branches = tuple(Branch(f"{k}-{k + 1}", k, k + 1, r=0.007, x=0.01) for k in (1, 2))
    buses = Bus(1, 20.0), Bus(2, 20.0), Bus(3, 20.0, load.real, load.imag)
    return Area("a", Network("a", 1.0, buses, branches), (Neighbour("p", 1, True),), 1, None)


def test_meters_of_thirty_percent_that_read_the_schedule_have_no_wrong_unit():
    kinds = MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION
    read = [
        Measurement(Meter(kind, 3), value, -0.3 * value) for kind, value in zip(kinds, (-0.055, -0.025), strict=True)
    ]
    found = GatewayTest(lateral(0.06 + 0.025j)).weigh(read, {m.meter.id for m in read}, None, {})
    assert max(found.values()) < 0


def test_flows_through_an_area_without_loads_tell_no_unit_while_its_neighbours_are_silent():
    places = (MeasurementKind.P_FLOW, 0.04), (MeasurementKind.Q_FLOW, 0.015)
    flows = [Measurement(Meter(kind, k, f"{k}-{k + 1}"), value, 1e-4) for kind, value in places for k in (1, 2)]
    found = GatewayTest(lateral(0j)).weigh(flows, {m.meter.id for m in flows}, None, {})
    assert max(found.values()) < 1e-9  # but for rounding


@pytest.mark.parametrize("seed", range(5))
def test_a_feeder_without_supply_is_no_unit(seed: int):
    rng = np.random.default_rng(seed)
    dead = [replace(m, value=float(rng.normal(0, m.sigma))) if is_power(m) else m for m in READINGS]
    assert max(weigh(dead).values()) < THRESHOLD


def test_loads_have_one_sign_of_q_and_sources_none():
    loads, network = expect_loads(whole_grid()), SCENARIO.network
    assert (MeasurementKind.Q_INJECTION, 1, "") not in loads  # the substation
    assert loads[MeasurementKind.Q_INJECTION, 4, ""].mean == 0.0  # a generator
    assert loads[MeasurementKind.Q_INJECTION, 5, ""].mean == pytest.approx(-0.85 * network.bus(5).q_load)
    assert loads[MeasurementKind.P_INJECTION, 5, ""].mean == 0.0
    assert (MeasurementKind.P_INJECTION, 6, "") not in loads  # nothing there


def test_loads_of_phases_are_expected_at_their_nodes_and_between_two_of_either_sign():
    scenario = load_scenario("ieee13")
    loads = {place: load for area in scenario.partition.areas for place, load in expect_loads(area).items()}
    q = {load.phases: load.s.imag for load in scenario.network.loads if load.bus == 675}
    assert loads[MeasurementKind.Q_INJECTION, 675, "a"].mean == pytest.approx(-0.85 * q["a"])
    assert loads[MeasurementKind.Q_INJECTION, 646, "b"].mean == 0.0  # a leg from b to c
    assert (MeasurementKind.Q_INJECTION, 684, "a") not in loads


@pytest.mark.parametrize("shift", [0.5, 2.0, 5.0])
def test_sums_of_evidence_exceed_the_threshold_once_in_ten_thousand_scans_at_most(shift: float):
    ratios = shift * np.random.default_rng(1).normal(size=100_000) - shift**2 / 2  # of N(shift, 1) to N(0, 1)
    so_far, n_alarms = 0.0, 0
    for ratio in ratios.tolist():
        so_far = add_up(so_far, ratio)
        if so_far > THRESHOLD:
            so_far, n_alarms = 0.0, n_alarms + 1
    assert n_alarms <= 10
