"""Our centralised estimate, by back end: the public call with its complete result, from the flat start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from benchmarks.estimates.cases import Case
from benchmarks.methods.method import TOLERANCE, State
from dsse_core.estimation.bad_data import normalized_residuals
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import Backend, EstimationPlan, build_estimation_plan
from dsse_core.estimation.residuals import chi_square_limit
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, make_meters
from dsse_core.grid.network import Branch, Bus, Network

PACKAGE = "consensus-dsse"


class Scan(NamedTuple):
    """Input of a control centre: its network and meters, which stay, and one scan of readings."""

    network: Network
    meters: Sequence[Meter]
    values: np.ndarray
    sigmas: np.ndarray


def _in_columns(network: Network) -> Network:
    """``network`` as tables without an object for each bus, with which power-grid-model begins, too."""
    buses, branches = (
        {field.name: [getattr(item, field.name) for item in items] for field in fields(kind)}
        for kind, items in ((Bus, network.buses), (Branch, network.branches))
    )
    arrays = [{k: v if isinstance(v[0], str) else np.array(v) for k, v in part.items()} for part in (buses, branches)]
    return replace(network, buses=Records(Bus, arrays[0]), branches=Records(Branch, arrays[1]))


def _meters_in_columns(case: Case) -> Sequence[Meter]:
    meters = [m.meter for m in case.measurements]
    row = {branch.id: k for k, branch in enumerate(case.network.branches)}
    kind = np.array([KINDS.index(meter.kind) for meter in meters])
    branch = np.array([NO_BRANCH if meter.branch is None else row[meter.branch] for meter in meters])
    return make_meters(case.network, kind, np.array([meter.bus for meter in meters]), branch)


@dataclass(frozen=True)
class Ours:
    """Cold: nothing has been derived from the network yet. Warm: the plan is there, and another scan comes in."""

    name: str
    backend: Backend
    package: str = PACKAGE
    with_residuals: bool = False  # also the chi-square test and all normalised residuals

    def translate(self, case: Case) -> Scan:
        values, sigmas = np.array([(m.value, m.sigma) for m in case.measurements]).T
        return Scan(_in_columns(case.network), _meters_in_columns(case), values, sigmas)

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
