"""The penalty of consensus ADMM: in units of what the area knows of its boundary, kept within reason."""

import numpy as np
import pytest

from dsse_core.exchange.consensus_admm import (
    POWER_METER_SIGMA,
    SPREAD,
    VOLTMETER_SIGMA,
    compute_weight,
    pull,
    solve_damped_step,
)
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.linear.area_model import build_area_model

KIND = MeasurementKind
NETWORK = Network(
    "line",
    1.0,
    tuple(Bus(k, 20.0, p_load=0.1 * (k > 1), q_load=0.05 * (k > 1)) for k in (1, 2, 3, 4)),
    tuple(Branch(f"{k}-{k + 1}", k, k + 1, r=0.01, x=0.01) for k in (1, 2, 3)),
    (Generator(1, Control.SLACK),),
)
OWNER, CHILD = build_partition(NETWORK, {"owner": [1, 2, 3], "child": [3, 4]}).areas
FLAT = {4: np.array([0.0, 0.0, 1.0, 1.0]), 8: np.array([0.0] * 3 + [1.0] * 3 + [0.1, 0.05])}


def weight_of(area, *measurements):
    model = build_area_model(area, measurements, area.reference[0] if area.reference else None)
    return compute_weight(model, FLAT[model.size], area.neighbours[0])


def flow(sigma):
    return [Measurement(Meter(kind, 3, "3-4"), 0.1, sigma) for kind in (KIND.P_FLOW, KIND.Q_FLOW)]


def test_the_weight_is_the_information_of_the_areas_own_meters():
    voltage = Measurement(Meter(KIND.VM, 3), 1.0, 0.004)
    weight = weight_of(CHILD, voltage, *flow(0.02))
    np.testing.assert_allclose(weight, [0.02**-2, 0.02**-2, 0.004**-2, 0.004**-2], rtol=0.01)
    model = build_area_model(CHILD, [voltage, *flow(0.02)], None)
    R = model.linear.information(FLAT[4], CHILD.neighbours[0], {}).R
    np.testing.assert_allclose(weight[:3], (R**2).sum(axis=0)[:3], rtol=1e-9)


def test_exact_injections_do_not_make_it_infinite():
    exact = [Measurement(Meter(k, 4, source=Source.VIRTUAL), 0.0, 0.0) for k in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    weight = weight_of(CHILD, *exact, Measurement(Meter(KIND.VM, 4), 1.0, 0.004))
    np.testing.assert_allclose(weight[:2], (POWER_METER_SIGMA / SPREAD) ** -2.0)


def test_an_area_without_voltmeter_reckons_with_a_common_one():
    assert weight_of(CHILD, *flow(0.02))[2] == pytest.approx(VOLTMETER_SIGMA**-2.0)


def test_an_area_that_knows_nothing_of_a_power_still_holds_on_to_it():
    weight = weight_of(OWNER, Measurement(Meter(KIND.VM, 1), 1.0, 0.002))
    np.testing.assert_allclose(weight[:2], (SPREAD * POWER_METER_SIGMA) ** -2.0)


def test_the_pull_leads_to_the_mean_of_what_is_known_and_what_is_pulled_to():
    model = build_area_model(CHILD, [Measurement(Meter(KIND.VM, 3), 1.02, 0.01), *flow(0.02)], None)
    z = np.array([0.12, 0.12, 0.98, 0.3])
    x = FLAT[4]
    for _ in range(30):
        x = x + solve_damped_step(model, x, {"owner": pull(np.array([0.02, 0.02, 0.01, 0.01]) ** -2.0, z)})
    y, _ = model.boundary(x, CHILD.neighbours[0])
    np.testing.assert_allclose(y, [0.11, 0.11, 1.0, 0.3], atol=1e-9)
