"""Bad data: chi-square detection, identification by the largest normalised residual, removal (thesis 3.3)."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dsse_core.errors import EstimationDivergedError, NotObservableError
from dsse_core.estimation.decision import Decision, IterationLostError, Memory, Totals, decide
from dsse_core.estimation.divergence import explain_magnitudes
from dsse_core.estimation.estimator import estimate_with_plan, iterate_with_plan, plan_scan
from dsse_core.estimation.plan import BackendChoice, EstimationPlan, build_estimation_plan
from dsse_core.estimation.residuals import (
    CONFIDENCE,
    DEAD_VM,
    THRESHOLD,
    chi_square_limit,
    find_dead,
    find_switches,
    find_taps,
)
from dsse_core.estimation.result import EstimationResult
from dsse_core.estimation.switches import Gain
from dsse_core.gauss_newton import LAST_STEP
from dsse_core.grid.columns import take_items
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.switches import find_meters_in_service

NO_NUMBERS = Totals(areas=1, failed=("",))  # of a grid whose iteration has no end


@dataclass(frozen=True)
class RemovedMeasurement:
    """A measurement taken out, and the meters that the data cannot distinguish from it."""

    measurement: Measurement
    normalized_residual: float
    indistinguishable_from: tuple[str, ...]


@dataclass(frozen=True)
class SuspectKept:
    """A meter above the threshold that stays in use, and the reason.

    The reason is one of three: the meter is critical, without it the estimation diverges, or the steps of the scan are
    used up.
    """

    meter: Meter
    normalized_residual: float
    reason: Literal["critical", "diverges", "steps used up"]


@dataclass(frozen=True, repr=False)
class BadDataReport:
    """The clean estimate, with the meters removed on the way to it.

    ``critical``: ids of the meters that cannot be spared, whatever they read. ``detected``: J still exceeds the
    chi-square limit. Then ``taps`` has branch -> by how many steps its tap is probably off, if no meter stands out more
    than a tap, else ``suspect`` the largest normalised residual, if that exceeds the threshold. ``switched``: switch ->
    root of the change of J, of those that have the other status in the estimate, as the readings contradict theirs.
    ``gains``: see ``weigh_switches``.
    """

    result: EstimationResult
    removed: tuple[RemovedMeasurement, ...]
    critical: tuple[str, ...]
    detected: bool
    objective: float
    chi_square_limit: float
    degrees_of_freedom: int
    suspect: SuspectKept | None
    taps: Mapping[str, int]
    switched: Mapping[str, float]
    gains: Mapping[str, Gain]

    @property
    def undecided(self) -> tuple[tuple[str, ...], ...]:
        """Groups of meters of which the first is removed; the data cannot tell which meter of a group is wrong."""
        groups = ((r.measurement.meter.id, *r.indistinguishable_from) for r in self.removed)
        return tuple(group for group in groups if len(group) > 1)

    @property
    def n_meters(self) -> int:
        """Number of meters in use, virtual ones included."""
        return len(self.result.plan.meters)

    @property
    def n_without_variance(self) -> int:
        """Number of meters whose residual has an unknown variance, as all variances would take too long.

        Bad data among these meters is detected but not identified. The report does not know which of them are critical.
        """
        return int(np.isnan(self.result.residual_variance).sum())

    def __repr__(self) -> str:
        where = "above" if self.detected else "below"
        return (
            f"<BadDataReport of {self.result.network.name!r}: {len(self.removed)} meters removed, "
            f"{len(self.critical)} critical, J = {self.objective:.4g} {where} its limit {self.chi_square_limit:.4g}>"
        )


def find_critical(result: EstimationResult) -> tuple[str, ...]:
    """Ids of the measurements without redundancy, see ``MeterChecks.critical``."""
    return result.checks.critical


def normalized_residuals(result: EstimationResult) -> np.ndarray:
    """|r_i| / sqrt(Omega_ii) (eq. 3.23), shape (n_meas,); 0 for virtual measurements and where Omega_ii is 0."""
    return result.checks.normalized


def process_bad_data(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    threshold: float = THRESHOLD,
    backend: BackendChoice = "auto",
) -> BadDataReport:
    """``process_bad_data_with_plan`` of one scan; ``reference``, ``backend``: see ``build_estimation_plan``.

    Raises:
        As ``estimate_state``.
    """
    plan, values, sigmas = plan_scan(network, measurements, reference=reference, backend=backend)
    return process_bad_data_with_plan(plan, values, sigmas, start=start, tolerance=tolerance, threshold=threshold)


def process_bad_data_with_plan(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    threshold: float = THRESHOLD,
) -> BadDataReport:
    """Estimates; while J exceeds the chi-square limit, removes the largest normalised residual and repeats. A switch
    whose other status explains more than any meter takes that status.

    The verdicts are those of ``decision.decide``, to which the whole grid is one area without neighbours. Removal ends
    when the test passes or when no normalised residual exceeds ``threshold``. Of equal residuals the first meter by id
    is removed; the others are reported as indistinguishable. A critical measurement stays, and the next largest
    residual is looked at. If the estimation diverges without a measurement, that measurement stays, the estimate before
    stands, and ``detected`` with it. Dead voltmeters (``find_dead``) are left out from the start and stand first among
    the removed ones.

    Raises:
        NotObservableError: without dead voltmeters, which it names.
        As ``estimate_with_plan``.
    """
    plan, values, sigmas, dead = _leave_out_dead(plan, np.asarray(values, dtype=float), np.asarray(sigmas, dtype=float))
    result = estimate_with_plan(plan, values, sigmas, start=start, tolerance=tolerance)
    removed: list[RemovedMeasurement] = []
    switched: dict[str, float] = {}
    while result.memory.evaluating:
        memory, verdict = decide(result.memory, _totals_of(result, threshold))
        if verdict.decision is Decision.FINAL:
            break
        switches = find_switches(memory.removed[-1:])
        rows = [row for row, meter in enumerate(result.plan.meters) if meter.id == memory.removed[-1]]
        try:
            following = _estimate_without(rows, result, start, tolerance, memory, switches)
        except (IterationLostError, NotObservableError):
            _check_magnitudes(result)
            memory, _ = decide(memory, NO_NUMBERS)
            result = _estimate_without([], result, start, tolerance, memory)
            break
        for row in rows:
            normalized = float(normalized_residuals(result)[row])
            removed.append(RemovedMeasurement(result.measurements[row], normalized, memory.tied[-1]))
        switched |= {switch: math.sqrt(result.gains[switch].fall) for switch in switches}
        result = following
    _check_magnitudes(result)
    return _report(result, [*(_describe_dead(m, result) for m in dead), *removed], switched, threshold)


def _check_magnitudes(result: EstimationResult) -> None:
    """Raises EstimationDivergedError where no grid has the magnitudes of an estimate that is to stand."""
    if cause := explain_magnitudes(result.network, result.x):
        raise EstimationDivergedError(result.iterations, 0.0, cause)


def _leave_out_dead(
    plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray
) -> tuple[EstimationPlan, np.ndarray, np.ndarray, list[Measurement]]:
    """Plan and readings without dead voltmeters, and the readings of the dead ones.

    Raises:
        NotObservableError: the others do not determine the state.
    """
    if not (rows := find_dead(plan.meters, values)):
        return plan, values, sigmas, []
    dead = [Measurement(plan.meters[k], float(values[k]), float(sigmas[k])) for k in rows]
    try:
        plan = plan.without(rows)
    except NotObservableError as error:
        left_out = [f"{m.meter} reads {m.value:.3g} p.u., below {DEAD_VM:g}" for m in dead]
        raise NotObservableError(error.buses, error.cures, left_out, error.together) from None
    return plan, np.delete(values, rows), np.delete(sigmas, rows), dead


def _estimate_without(
    rows: list[int],
    result: EstimationResult,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    memory: Memory,
    switches: Sequence[str] = (),
) -> EstimationResult:
    """The estimate without the meters at the positions ``rows``, with the other statuses of ``switches``."""
    plan = result.plan.without(rows) if rows else result.plan
    if switches:
        status = plan.network.switches
        network = plan.network.operated({switch: not status[switch] for switch in switches}).supplied()
        kept = find_meters_in_service(network, plan.meters)
        meters, rows = take_items(plan.meters, kept), np.delete(np.arange(len(plan.meters)), kept).tolist()
        plan = build_estimation_plan(network, meters, reference=plan.reference)
    readings = np.delete(result.values, rows), np.delete(result.sigmas, rows)
    return iterate_with_plan(plan, *readings, start=start, tolerance=tolerance, memory=memory)


def _totals_of(result: EstimationResult, threshold: float) -> Totals:
    """Totals of the estimate for ``decide``: J, and the suspects above ``threshold``."""
    worst, tied = (tuple(found.items()) for found in result.checks.suspects(threshold))
    return Totals(result.objective, result.degrees_of_freedom, worst=worst, tied=tied, areas=1, referenced=True)


def _describe_dead(m: Measurement, result: EstimationResult) -> RemovedMeasurement:
    """The dead voltmeter ``m`` as a removed measurement, with its distance from the state estimated without it.

    ``|z - vm| / sqrt(sigma^2 + sigma_vm^2)`` is its normalised residual in the linear model.
    """
    nodes = [result.network.node(m.meter.bus, phase) for phase in list_phases(m.meter.phases)]
    vm, sigma = result.vm[nodes[0]], result.state_sigma()[0][nodes[0]]
    if len(nodes) > 1:
        v = result.vm[nodes] * np.exp(1j * result.va[nodes])
        vm = abs(v[0] - v[1])
    normalized = float(abs(m.value - vm) / np.hypot(m.sigma, sigma))
    return RemovedMeasurement(m, normalized, ())


def _report(
    result: EstimationResult, removed: Sequence[RemovedMeasurement], switched: Mapping[str, float], threshold: float
) -> BadDataReport:
    critical = find_critical(result)
    limit = chi_square_limit(result.degrees_of_freedom, CONFIDENCE)
    detected = result.objective >= limit
    taps = find_taps(result.checks.suspects(threshold)[0]) if detected else {}
    return BadDataReport(
        result=result,
        removed=tuple(removed),
        critical=critical,
        detected=detected,
        objective=result.objective,
        chi_square_limit=limit,
        degrees_of_freedom=result.degrees_of_freedom,
        suspect=_find_suspect(result, threshold, critical) if detected and not taps else None,
        taps=taps,
        switched=switched,
        gains=result.gains,
    )


def _find_suspect(result: EstimationResult, threshold: float, critical: Collection[str]) -> SuspectKept | None:
    """The meter with the largest normalised residual where removal has ended, and the reason why it stays."""
    normalized, kept = normalized_residuals(result), result.memory.kept
    if find_switches((kept,)):
        return None
    worst = [meter.id for meter in result.plan.meters].index(kept) if kept else int(np.argmax(normalized))
    if normalized[worst] <= threshold:
        return None
    meter = result.plan.meters[worst]
    if meter.id in critical:
        return SuspectKept(meter, float(normalized[worst]), "critical")
    return SuspectKept(meter, float(normalized[worst]), "diverges" if kept else "steps used up")
