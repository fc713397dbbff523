"""What `dsse estimate` says of bad data that it cannot remove."""

from dataclasses import replace

import numpy as np
import pytest

from coordinator.show.report.grid_text import format_estimate
from dsse_core.estimation.bad_data import SuspectKept, process_bad_data
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry


@pytest.fixture(scope="module")
def detected():
    scenario = load_scenario("industrial13")
    return replace(process_bad_data(scenario.network, make_telemetry(scenario).union), detected=True, suspect=None)


@pytest.fixture(scope="module")
def tables(detected):
    return results_of_estimate(detected)


def test_a_residual_that_stands_out_is_not_said_not_to(detected, tables):
    for reason, text in (("critical", "is not determined"), ("diverges", "does not converge")):
        suspect = SuspectKept(Meter(MeasurementKind.VM, 4), 21.9, reason)
        report = format_estimate(replace(detected, suspect=suspect), tables)
        assert "still detected: vm@4 (vm of bus 4) has the largest normalised residual, 21.9, but without it" in report
        assert text in report
        assert "stands out" not in report


def test_where_none_does_it_is_reported(detected, tables):
    assert "still detected, but no normalised residual stands out" in format_estimate(detected, tables)


def test_residuals_of_unknown_variance_are_reported_to_identify_nothing(detected, tables):
    assert "no bad data identification" not in format_estimate(detected, tables)
    variance = detected.result.residual_variance.copy()
    variance[:3] = np.nan
    result = replace(detected.result)
    result.__dict__["residual_variance"] = variance
    report = format_estimate(replace(detected, result=result), tables)
    assert f"no bad data identification by residuals for 3 of {len(variance)} meters" in report
