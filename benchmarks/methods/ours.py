"""Our centralised estimate, by back end: the public call with its complete result, from the flat start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from benchmarks.cases import Case
from benchmarks.methods.method import TOLERANCE, State
from dsse_core.estimation.bad_data import normalized_residuals
from dsse_core.estimation.estimator import EstimationResult, estimate_with_plan
from dsse_core.estimation.plan import Backend, EstimationPlan, build_estimation_plan
from dsse_core.estimation.residuals import chi_square_limit
from dsse_core.grid.measurement import Meter
from dsse_core.grid.network import Network

PACKAGE = "consensus-dsse"


class Scan(NamedTuple):
    """What a control centre has: its network and meters once, then one scan of readings after the other."""

    network: Network
    meters: tuple[Meter, ...]
    values: np.ndarray
    sigmas: np.ndarray


@dataclass(frozen=True)
class Ours:
    """Cold: nothing has been derived from the network yet. Warm: the plan is there, and another scan comes in."""

    name: str
    backend: Backend
    package: str = PACKAGE
    with_residuals: bool = False  # also the chi-square test and all normalised residuals

    def translate(self, case: Case) -> Scan:
        values, sigmas = np.array([(m.value, m.sigma) for m in case.measurements]).T
        return Scan(case.network, tuple(m.meter for m in case.measurements), values, sigmas)

    def build(self, scan: Scan) -> tuple[EstimationPlan, Scan]:
        return build_estimation_plan(replace(scan.network), scan.meters, backend=self.backend), scan

    def solve(self, model: tuple[EstimationPlan, Scan]) -> EstimationResult:
        plan, scan = model
        result = estimate_with_plan(plan, scan.values, scan.sigmas, tolerance=TOLERANCE)
        if self.with_residuals:
            normalized_residuals(result)
            chi_square_limit(result.degrees_of_freedom, 0.99)
        return result

    def read(self, case: Case, result: EstimationResult) -> State:
        return State(result.vm, result.va, result.iterations)
