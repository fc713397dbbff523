"""The estimate of any network by sparse factorisation of the tableau; what depends on topology only is found once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from dsse_core.admittance import build_admittance, flat_start
from dsse_core.augmented import AugmentedFactor, AugmentedPattern
from dsse_core.errors import EstimationDivergedError
from dsse_core.gauss_newton import (
    FLOWS_KNOWN,
    FULL_STEPS,
    LARGEST_STEP,
    MAX_DVA,
    MAX_DVM,
    NOT_YET,
    Solution,
    is_last,
)
from dsse_core.measurement import MeasurementKind, Meter
from dsse_core.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.network import Network
from dsse_core.radial import find_tree, order_tableau

SMALL_STEP = 0.02  # p.u. and rad; after a smaller one the last factor may serve once more


@dataclass(frozen=True)
class SparsePlan:
    """``free``: the state variables but the reference angle. ``entries``: which entries of the model's H are theirs,
    ``indices`` and ``indptr`` where they stand. ``start``: x = [va; vm] of the flat start with the reference's angle.
    ``at_start``: the factor there for the last sigmas, which most meters keep from scan to scan.
    """

    meters: tuple[Meter, ...]
    model: MeasurementModel
    free: np.ndarray
    entries: np.ndarray
    indices: np.ndarray
    indptr: np.ndarray
    pattern: AugmentedPattern
    start: np.ndarray
    at_start: dict[bytes, AugmentedFactor] = field(default_factory=dict, compare=False, repr=False)

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        """h(x), (n_meas,), and the columns ``free`` of H(x)."""
        h, H = self.model.linearize(x)
        shape = len(self.meters), len(self.free)
        return h, sp.csr_array((H.data[self.entries], self.indices, self.indptr), shape=shape)


def build_sparse_plan(network: Network, meters: Sequence[Meter], reference: int) -> SparsePlan:
    """The plan for ``meters`` that fit the network and determine its state."""
    model = build_measurement_model(network, build_admittance(network), meters)
    vm, va = flat_start(network, reference)
    given = network.slack.va if network.slack and network.slack.bus == reference else 0.0
    start = np.concatenate([va + given, vm])
    fixed, H = network.row[reference], model.jacobian(start)
    free = np.delete(np.arange(len(start)), fixed)
    entries = np.flatnonzero(H.indices != fixed)
    indices = H.indices[entries] - (H.indices[entries] > fixed)
    indptr = np.searchsorted(entries, H.indptr)
    reduced = sp.csr_array((H.data[entries], indices, indptr), shape=(len(meters), len(free)))
    tree = find_tree(network, reference)
    pattern = AugmentedPattern(reduced, None if isinstance(tree, str) else order_tableau(tree, model, free))
    return SparsePlan(tuple(meters), model, free, entries, reduced.indices, reduced.indptr, pattern, start)


def estimate_sparse(
    plan: SparsePlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    max_iterations: int,
) -> Solution:
    """Gauss-Newton with the tableau of ``augmented``; ``sigmas`` (n_meas,) are 0 where a reading holds exactly.

    Raises:
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    steps = _Steps(plan, sigmas)
    x = plan.start if start is None else np.concatenate([start[1], start[0]])
    flows_known = start is not None or not len(steps.currents)
    step, before, share = NOT_YET
    for iteration in range(1, max_iterations + 1):
        last = flows_known and is_last(step, before, len(steps.currents) > 0, tolerance)
        h, H = plan.linearize(x)
        r = plan.model.subtract(values, h)
        try:
            dx = steps.solve(H, r, flows_known, nearby=step < SMALL_STEP, at_start=x is plan.start, last=last)
        except RuntimeError:  # SuperLU: singular away from the no-load state, where the rank was full
            raise _diverged(plan, sigmas, r, iteration, np.inf) from None
        taken, share_before = step, share
        step, share = _measure(dx, len(x) // 2 - 1, 1.0 if iteration <= FULL_STEPS else 0.5)
        before = taken if share == share_before else 0.0
        if not step <= LARGEST_STEP:
            raise _diverged(plan, sigmas, r, iteration, step)
        x = x.copy()
        x[plan.free] += share * dx
        if last:
            va, vm = np.split(x, 2)
            r = plan.model.subtract(values, plan.model.predict(x))
            return vm, va, r, steps.objective(r), iteration
        if not flows_known and step < FLOWS_KNOWN:
            flows_known, (step, before, share) = True, NOT_YET
    raise _diverged(plan, sigmas, r, max_iterations, step)


class _Steps:
    """Solves one step after the other, on the last factor where that serves."""

    def __init__(self, plan: SparsePlan, sigmas: np.ndarray) -> None:
        self.currents = np.flatnonzero(plan.model.kinds == MeasurementKind.CURRENT)
        self._plan = plan
        self._sigmas = sigmas
        self._weight = np.where(sigmas > 0, 1 / np.where(sigmas > 0, sigmas, 1.0), 0.0)
        self._of_currents = np.flatnonzero(np.isin(plan.pattern.row, self.currents))
        self._factor: AugmentedFactor | None = None
        self._multipliers = np.zeros(len(sigmas))
        self._with_currents = False

    def solve(
        self, H: sp.csr_array, r: np.ndarray, with_currents: bool, *, nearby: bool, at_start: bool, last: bool
    ) -> np.ndarray:
        """The step dx, (n_free,); without currents: rows of 0. What is not the ``last`` one the next one corrects."""
        if not with_currents:
            H.data[self._of_currents] = 0.0
            r = r.copy()
            r[self.currents] = 0.0
        found = None
        if self._factor and nearby and with_currents == self._with_currents:
            found = self._factor.solve_nearby(H, r, self._multipliers)
        if found is None:
            self._factor, self._with_currents = self._find_factor(H, at_start), with_currents
            found = self._factor.solve(r, np.zeros(H.shape[1]), refined=last)
        self._multipliers, dx = found
        return dx

    def _find_factor(self, H: sp.csr_array, at_start: bool) -> AugmentedFactor:
        kept, sigmas = self._plan.at_start, self._sigmas.tobytes()
        if at_start and (found := kept.get(sigmas)):
            return found
        factor = AugmentedFactor(H, self._sigmas, pattern=self._plan.pattern)
        if at_start:
            kept.clear()
            kept[sigmas] = factor
        return factor

    def objective(self, r: np.ndarray) -> float:
        """J of residuals r, (n_meas,); what holds exactly does not count."""
        weighted = r * self._weight
        return float(weighted @ weighted)


def _measure(dx: np.ndarray, n_angles: int, largest_share: float) -> tuple[float, float]:
    """The largest entry of the step [dva; dvm], and the part of it that MAX_DVA and MAX_DVM allow."""
    dva, dvm = (float(abs(part).max(initial=0.0)) for part in (dx[:n_angles], dx[n_angles:]))
    return max(dva, dvm), 1.0 / max(1.0 / largest_share, dva / MAX_DVA, dvm / MAX_DVM)


def _diverged(
    plan: SparsePlan, sigmas: np.ndarray, r: np.ndarray, iterations: int, step: float
) -> EstimationDivergedError:
    weighted = abs(r) / np.where(sigmas > 0, sigmas, np.inf)
    worst = int(np.argmax(weighted))
    return EstimationDivergedError(iterations, step, str(plan.meters[worst]), float(weighted[worst]))
