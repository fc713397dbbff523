"""What areas show of their meters: estimates and normalised residuals are those of the centralised estimate."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from agents.messages.packing import ReadingsMessage
from coordinator.lab.evaluation.evaluation import estimate_centralised
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of


@pytest.mark.parametrize("name", ["industrial13", "ieee33"])
def test_normalised_residuals_of_areas_are_the_centralised_ones(name: str):
    scenario = load_scenario(name)
    telemetry = make_telemetry(scenario)
    shown: dict[str, ReadingsMessage] = {}
    bus = SimulatedBus(
        area_files_of(scenario),
        telemetry.by_area,
        on_readings=lambda at, used: shown.update({used.header.sender: used}),
    )
    bus.run_until_settled()
    report = estimate_centralised(scenario, telemetry).report
    assert report is not None
    meters = results_of_estimate(report, meters=scenario.meters).meters
    normalised = dict(zip(meters.meter, meters.normalised_residual, strict=True))
    assert {meter for used in shown.values() for meter in used.meters} == {
        m.meter.id for m in telemetry.union if m.meter.source != "virtual"
    }
    compared = 0
    for used in shown.values():
        for meter, off in zip(used.meters, used.normalised, strict=False):
            if not np.isnan(normalised[meter]):
                assert off == pytest.approx(normalised[meter], rel=1e-6, abs=1e-9), meter
                compared += 1
        for estimate, value, sigma in zip(used.estimates, used.values, used.sigmas, strict=False):
            assert abs(value - estimate) < 10 * sigma
    assert compared > 30


def test_who_comes_later_is_sent_the_readings_in_use_and_they_are_the_same():
    scenario = load_scenario("industrial13")
    seen: list[tuple[float, ReadingsMessage]] = []
    bus = SimulatedBus(
        area_files_of(scenario), make_telemetry(scenario).by_area, on_readings=lambda at, used: seen.append((at, used))
    )
    bus.run(25.0)
    of_one = [(at, used) for at, used in seen if used.header.sender == "area1"]
    assert len(of_one) == 3
    assert len({used for _, used in of_one}) == 1
    assert all(later - earlier >= 10.0 for (earlier, _), (later, _) in itertools.pairwise(of_one))
