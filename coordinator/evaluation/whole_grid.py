"""The estimate of a whole grid in one place, once: what ``dsse estimate`` does. Meters and readings stay in arrays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dsse_core.estimation.bad_data import BadDataReport, process_bad_data_with_plan
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from scenarios.check import plan_whole_grid
from scenarios.scenario import load_scenario
from scenarios.telemetry import read_meters


def estimate_whole_grid(scenario: str | Path, seed: int | None = None) -> tuple[BadDataReport, PowerFlowResult | None]:
    """The estimate of the first scan with its bad data removed, and the truth where it is known.

    Raises:
        InvalidInputError: every problem found in the scenario, or in what its meters observe.
        NotObservableError: the scan lacks readings without which the state is not determined.
        PowerFlowDivergedError, EstimationDivergedError: see there.
    """
    loaded = load_scenario(scenario, whole=True)
    loaded = loaded if seed is None else replace(loaded, seed=seed)
    plan = plan_whole_grid(loaded)
    scan = read_meters(loaded)
    values, sigmas = np.delete(scan.values, scan.missing), np.delete(scan.sigmas, scan.missing)
    plan = plan.without(scan.missing) if scan.missing else plan
    return process_bad_data_with_plan(plan, values, sigmas, tolerance=loaded.tolerances.estimator), scan.truth
