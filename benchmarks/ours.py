"""Our centralised estimate, by back end: the public call with its complete result, from the flat start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from benchmarks.cases import Case
from benchmarks.method import MAX_ITERATIONS, TOLERANCE, State
from dsse_core.estimation import EstimationResult
from dsse_core.measurement import Measurement
from dsse_core.network import Network

PACKAGE = "consensus-dsse"


class Estimator(Protocol):
    """``estimate_state``, or a function of this module's callers that calls it with a certain back end."""

    def __call__(
        self, network: Network, measurements: tuple[Measurement, ...], *, tolerance: float, max_iterations: int
    ) -> EstimationResult: ...


@dataclass(frozen=True)
class Ours:
    """``estimate`` on our network and measurements. Cold: nothing has been derived from the network yet."""

    name: str
    estimate: Estimator
    package: str = PACKAGE
    with_residuals: bool = False  # also the variance of every residual: what all normalised residuals need

    def translate(self, case: Case) -> tuple[Network, tuple[Measurement, ...]]:
        return case.network, case.measurements

    def build(self, data: tuple[Network, tuple[Measurement, ...]]) -> tuple[Network, tuple[Measurement, ...]]:
        network, measurements = data
        return replace(network), measurements

    def solve(self, model: tuple[Network, tuple[Measurement, ...]]) -> EstimationResult:
        result = self.estimate(*model, tolerance=TOLERANCE, max_iterations=MAX_ITERATIONS)
        if self.with_residuals:
            _ = result.residual_variance
        return result

    def read(self, case: Case, result: EstimationResult) -> State:
        return State(result.vm, result.va, result.iterations)
