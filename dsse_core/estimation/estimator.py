"""Weighted-least-squares state estimation by Gauss-Newton, virtual measurements as equality constraints."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.decision import (
    DIVERGED,
    Decision,
    IterationLostError,
    Memory,
    Totals,
    Verdict,
    begin_at_flat_start,
    decide,
    limit_total,
)
from dsse_core.estimation.divergence import explain_divergence, explain_magnitudes
from dsse_core.estimation.plan import BackendChoice, EstimationPlan, build_estimation_plan
from dsse_core.estimation.radial import estimate_radial
from dsse_core.estimation.result import EstimationResult
from dsse_core.gauss_newton import LARGEST_STEP, LAST_STEP, Solution
from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import Measurement, are_usable, check_measurements, check_readings, read_numbers
from dsse_core.grid.meter_table import find_virtual, read_meters_of
from dsse_core.grid.network import Network
from dsse_core.linear.area_measurements import NO_ROWS
from dsse_core.linear.whole_grid import GridSolver

SMALL_STEP = 0.02  # p.u. and rad; after a smaller one the last factor may serve once more
NO_MEMORY = Memory()


def estimate_state(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    backend: BackendChoice = "auto",
) -> EstimationResult:
    """Estimate of one scan: ``build_estimation_plan`` and ``estimate_with_plan`` in one call.

    ``reference``, ``backend``: see ``build_estimation_plan``. For more than one scan of the same meters build the plan
    once.

    Raises:
        InvalidInputError: measurements that do not fit the network, or a back end that cannot serve.
        NotObservableError: names the buses that are not determined.
        EstimationDivergedError: names the cause why the iteration has no end.
    """
    plan, values, sigmas = plan_scan(network, measurements, reference=reference, backend=backend)
    return estimate_with_plan(plan, values, sigmas, start=start, tolerance=tolerance)


def plan_scan(
    network: Network, measurements: Sequence[Measurement], *, reference: int | None, backend: BackendChoice
) -> tuple[EstimationPlan, np.ndarray, np.ndarray]:
    """The plan for the meters of one scan, and its values and sigmas; raises as ``estimate_state``."""
    meters = read_meters_of(measurements)
    values, sigmas = (read_column(measurements, name, float) for name in ("value", "sigma"))
    if not _are_usable(values, sigmas, find_virtual(meters)):
        check_measurements(network, measurements)
    return build_estimation_plan(network, meters, reference=reference, backend=backend), values, sigmas


def estimate_with_plan(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    memory: Memory = NO_MEMORY,
) -> EstimationResult:
    """Finds the state that minimises J(x) = (z - h(x))' W (z - h(x)), W = diag(1 / sigma^2) (eqs. 3.8-3.14).

    ``values``, ``sigmas`` (n_meas,): the readings of the plan's meters. Virtual ones hold exactly; their sigma does
    not count. Gauss-Newton runs as ``decision.decide`` says, until the verdict is final or asks for normalised
    residuals. No step moves a voltage by more than MAX_DVM and MAX_DVA. Current magnitudes enter once the other meters
    have determined the direction of flows; before, J has several minima.

    Args:
        start: (vm, va) in network order, such as the last scan's; its angle of the reference is kept. By default, and
            where the start leads to no end, the flat start. There the angle of the
            reference is the set-point of the slack bus if that is the reference, else 0.
        tolerance: the most that the last step may move, p.u. and rad, where convergence is linear.
        memory: the meters removed before, and whether a start has led to no end before.

    Raises:
        InvalidInputError: unusable readings, or a start that does not fit.
        EstimationDivergedError: names the cause why the iteration has no end, see ``explain_divergence``.
    """
    values, sigmas = np.array(read_numbers("values", values)), np.array(read_numbers("sigmas", sigmas))
    try:
        return iterate_with_plan(plan, values, sigmas, start=start, tolerance=tolerance, memory=memory)
    except IterationLostError as lost:
        raise explain_divergence(plan, values, sigmas, lost, iterate_with_plan) from None


def iterate_with_plan(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    memory: Memory = NO_MEMORY,
) -> EstimationResult:
    """``estimate_with_plan`` without the search for a cause, for callers that go on without an estimate.

    Raises:
        InvalidInputError: as there.
        IterationLostError: the iteration has no end.
    """
    values, sigmas = np.array(read_numbers("values", values)), np.array(read_numbers("sigmas", sigmas))
    if not values.shape == sigmas.shape == (len(plan.meters),):
        problem = f"the plan has {len(plan.meters)} meters; given are values {values.shape} and sigmas {sigmas.shape}"
        raise InvalidInputError(f"readings of network {plan.network.name!r}", [problem])
    options = None if start is None else _read_start(plan, *start), tolerance, memory
    if isinstance(plan.radial, str):
        sigmas[plan.virtual] = 0.0
        if not _are_usable(values, sigmas, plan.virtual):
            check_readings(plan.network, plan.meters, values, sigmas)
        memory, found, taps = _estimate_as_area(plan, values, sigmas, *options)
        return EstimationResult(plan, values, sigmas, memory, *found, taps)
    memory, found = estimate_radial(plan.radial, plan.virtual, values, sigmas, *options)
    return EstimationResult(plan, values, sigmas, memory, *found)


def _read_start(plan: EstimationPlan, vm: np.ndarray, va: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vm, va = read_numbers("vm of the start", vm), read_numbers("va of the start", va)
    n = plan.network.n_nodes
    if not vm.shape == va.shape == (n,):
        problem = f"the start has shapes {vm.shape} and {va.shape}; give ({n},) twice"
        raise InvalidInputError(f"estimate of network {plan.network.name!r}", [problem])
    return vm, va


def _are_usable(values: np.ndarray, sigmas: np.ndarray, virtual: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and np.where(virtual, values == 0.0, are_usable(sigmas)).all())


def _estimate_as_area(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    memory: Memory,
) -> tuple[Memory, Solution, np.ndarray]:
    """Memory, solution and estimated taps of a scan: Gauss-Newton until the verdict is ``FINAL`` or ``EVALUATE``.

    ``sigmas`` (n_meas,) are 0 where a reading holds exactly.

    Raises:
        IterationLostError: the iteration has no end.
    """
    grid, removed = WholeGrid(plan.sparse, values, sigmas, None if memory.from_flat_start else start), memory.removed
    while True:
        memory, verdict = decide(memory, grid.totals(), tolerance)
        if verdict.reason or memory.removed != removed:  # the plan's meters have no estimate
            raise grid.diverged(verdict.reason)
        grid.carry_out(verdict)
        if verdict.decision not in (Decision.EVALUATE, Decision.FINAL):
            continue
        cause = "" if verdict.decision is Decision.EVALUATE else explain_magnitudes(plan.network, grid.x)
        if not (grid.is_lost or cause):
            return memory, grid.solution(), grid.taps
        if memory.from_flat_start:
            raise grid.diverged(cause=cause)
        memory = begin_at_flat_start(memory)
        grid.carry_out(Verdict(Decision.ANEW))


class WholeGrid:
    """The whole grid as one area without neighbours: states its totals, and carries out verdicts.

    ``x``: the state x_k = [va; vm; estimated taps], p.u. and rad.
    """

    def __init__(
        self,
        linear: GridSolver,
        values: np.ndarray,
        sigmas: np.ndarray,
        start: tuple[np.ndarray, np.ndarray] | None,
    ) -> None:
        self._of_meters, self._values, self._sigmas = linear, values, sigmas
        self._n = linear.model.n_nodes
        self._weight = np.divide(1.0, sigmas, out=np.zeros(len(sigmas)), where=sigmas > 0)
        self._begin(linear.flat if start is None else linear.model.area.join_state(*start))

    def _begin(self, x: np.ndarray) -> None:
        self.x = self._before = x
        self._steps = 0
        self._read(self._of_meters.model.currents)

    def _read(self, held_back: np.ndarray) -> None:
        """Takes all readings but those ``held_back`` into use; the last step is forgotten."""
        self._linear = self._of_meters.with_values(self._values, self._sigmas, held_back)
        self._step, self._size = np.zeros(len(self.x)), (0.0, 0.0)  # its largest entries, dva and dvm
        self._turn = 0.0  # its product with the step before

    @property
    def is_lost(self) -> bool:
        """True where the last step has led to no state, or no step could be solved for."""
        return not max(self._size) <= LARGEST_STEP

    def totals(self) -> Totals:
        dva, dvm = self._size
        model, objective = self._linear.model, np.inf
        if not self.is_lost:
            self._linear.prepare(self.x)
            objective = self._find_objective(model.residual_of(self._linear.rows.predict(self.x)))
        held_back = len(model.held_back)
        return Totals(
            objective=objective,
            degrees_of_freedom=len(self._values) - held_back - len(model.free),
            dvm=dvm,
            dva=dva,
            held_back=held_back,
            areas=1,
            referenced=True,
            square=limit_total(float(self._step[: 2 * self._n] @ self._step[: 2 * self._n])),
            turn=limit_total(self._turn),
        )

    def _find_objective(self, r: np.ndarray) -> float:
        """J of residuals r, (n_meas,); readings that hold exactly do not count."""
        weighted = r * self._weight
        return float(weighted @ weighted)

    def carry_out(self, verdict: Verdict) -> None:
        if verdict.takes_step:
            self._take_step(verdict.share)
        match verdict.decision:
            case Decision.SHORTEN:
                self.x = self._before + verdict.share * self._step
                self._read(self._linear.model.held_back)
            case Decision.USE_CURRENTS:
                self._read(NO_ROWS)
            case Decision.ANEW:
                self._begin(self._of_meters.flat)

    def _take_step(self, share: float) -> None:
        self._steps, self._before, step_before = self._steps + 1, self.x, self._step
        try:
            self._step = self._linear.step(self.x, {}, nearby=max(self._size) < SMALL_STEP)
        except RuntimeError:  # SuperLU: singular away from the no-load state, where the rank was full
            self._size = np.inf, np.inf
            return
        size, n = abs(self._step), self._n
        self._size = float(size[:n].max()), float(size[n : 2 * n].max())
        if not math.isfinite(sum(self._size)):
            self._size = np.inf, np.inf
        self._turn = float(step_before[: 2 * n] @ self._step[: 2 * n])
        self.x = self.x + share * self._step

    def solution(self) -> Solution:
        is_dead = self._linear.model.area.network.is_dead
        va, vm = np.where(is_dead, 0.0, self.x[: 2 * self._n].reshape(2, -1))
        r = self._find_residual(self.x)
        return vm, va, r, self._find_objective(r), self._steps

    @property
    def taps(self) -> np.ndarray:
        """The estimated taps, (n_tap,)."""
        return self.x[2 * self._n :]

    def _find_residual(self, x: np.ndarray) -> np.ndarray:
        """z - h(x) of all meters, (n_meas,)."""
        return self._linear.model.model.subtract(self._values, self._linear.rows.predict(x))

    def diverged(self, reason: str = DIVERGED, cause: str = "") -> IterationLostError:
        """The error for an iteration that has stopped here."""
        weighted = abs(self._find_residual(self._before)) * self._weight
        return IterationLostError(self._steps, max(self._size), weighted, reason, cause)
