"""One estimate of a whole grid in one place, for ``dsse estimate``. Meters and readings stay in arrays."""

from __future__ import annotations

import numpy as np

from dsse_core.estimation.bad_data import BadDataReport, process_bad_data_with_plan
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from scenarios.check import plan_whole_grid
from scenarios.scenario import Scenario
from scenarios.telemetry import read_meters


def estimate_whole_grid(scenario: Scenario) -> tuple[BadDataReport, PowerFlowResult | None]:
    """The estimate of the first scan with its bad data removed, and the truth where it is known.

    Raises:
        InvalidInputError: every problem in what the meters observe.
        NotObservableError: the readings of the scan do not determine the state.
        PowerFlowDivergedError, EstimationDivergedError: the power flow or the estimate does not converge.
    """
    plan = plan_whole_grid(scenario)
    scan = read_meters(scenario)
    values, sigmas = np.delete(scan.values, scan.missing), np.delete(scan.sigmas, scan.missing)
    plan = plan.without(scan.missing) if scan.missing else plan
    return process_bad_data_with_plan(plan, values, sigmas, tolerance=scenario.tolerances.estimator), scan.truth
