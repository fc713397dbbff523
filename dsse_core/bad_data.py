"""Bad data: chi-square detection, identification by the largest normalised residual, removal (thesis 3.3)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation import EstimationResult, estimate_with_plan, plan_scan
from dsse_core.estimation_plan import BackendChoice, EstimationPlan
from dsse_core.gauss_newton import LAST_STEP
from dsse_core.measurement import Measurement, MeasurementKind, Meter
from dsse_core.network import Network

# Omega_ii / R_ii below which a residual says nothing about its measurement: what meters 1e6 times coarser leave.
CRITICAL_REDUNDANCY = 1e-12
DEAD_VM = 0.5  # p.u.; no grid works below it, and weighted squares find states that almost would
CONFIDENCE = 0.99  # of the chi-square test
THRESHOLD = 3.0  # of normalised residuals
TIE = 1e-6  # relative difference of normalised residuals that are equal in exact arithmetic


@dataclass(frozen=True)
class RemovedMeasurement:
    """A measurement taken out, and the meters that the data cannot tell from it."""

    measurement: Measurement
    normalized_residual: float
    indistinguishable_from: tuple[str, ...]


@dataclass(frozen=True)
class SuspectKept:
    """A meter above the threshold that stays, and why: it is critical, or without it the estimation diverges."""

    meter: Meter
    normalized_residual: float
    reason: Literal["critical", "diverges"]


@dataclass(frozen=True)
class BadDataReport:
    """The clean estimate and how it was reached.

    ``critical``: ids of the meters that cannot be spared, whatever they read. ``detected``: the chi-square limit
    is still exceeded; then ``suspect`` has the largest normalised residual, if that exceeds the threshold.
    """

    result: EstimationResult
    removed: tuple[RemovedMeasurement, ...]
    critical: tuple[str, ...]
    detected: bool
    objective: float
    chi_square_limit: float
    degrees_of_freedom: int
    suspect: SuspectKept | None


def chi_square_limit(degrees_of_freedom: int, confidence: float) -> float:
    """The value that J exceeds with probability 1 - ``confidence`` under noise alone; inf without redundancy."""
    from scipy.special import chdtri  # 0.1 s, which an agent without bad-data processing need not wait for

    return float(chdtri(degrees_of_freedom, 1 - confidence)) if degrees_of_freedom > 0 else float("inf")


def find_critical(result: EstimationResult) -> tuple[str, ...]:
    """Ids of the measurements without redundancy, in the order of ``result``.

    Their residual is zero whatever they read; or it is not, because losses or current magnitudes check them a
    little, but without them the state is not observable.
    """
    plan = result.plan
    spared = (result.residual_variance <= CRITICAL_REDUNDANCY * result.sigmas**2) | plan.indispensable
    return tuple(plan.meters[k].id for k in np.flatnonzero(spared & ~plan.virtual))


def normalized_residuals(result: EstimationResult) -> np.ndarray:
    """|r_i| / sqrt(Omega_ii) (eq. 3.23), shape (n_meas,); 0 for virtual measurements and where Omega_ii is 0."""
    return normalize_residuals(result.residual, result.residual_variance, result.sigmas, ~result.plan.virtual)


def normalize_residuals(residual: np.ndarray, variance: np.ndarray, sigmas: np.ndarray, real: np.ndarray) -> np.ndarray:
    """The same of ``residual`` z - h(x) with ``variance`` diag(Omega); ``real``: not virtual; (n_meas,) each."""
    telling = real & (variance > CRITICAL_REDUNDANCY * sigmas**2)
    return np.where(telling, abs(residual) / np.sqrt(np.where(telling, variance, 1.0)), 0.0)


def process_bad_data(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    confidence: float = CONFIDENCE,
    threshold: float = THRESHOLD,
    backend: BackendChoice = "auto",
) -> BadDataReport:
    """``process_bad_data_with_plan`` of one scan; ``reference``, ``backend``: see ``build_estimation_plan``.

    Raises:
        As ``estimate_state``.
    """
    plan, values, sigmas = plan_scan(network, measurements, reference=reference, backend=backend)
    options = {"tolerance": tolerance, "confidence": confidence, "threshold": threshold}
    return process_bad_data_with_plan(plan, values, sigmas, start=start, **options)


def process_bad_data_with_plan(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    confidence: float = CONFIDENCE,
    threshold: float = THRESHOLD,
) -> BadDataReport:
    """Estimate; while J exceeds the chi-square limit, remove the largest normalised residual and repeat.

    Voltmeters that read less than DEAD_VM are judged first, by the estimate without them; where that does not exist
    because nothing else determines the state, the scan is not observable, unless they confirm each other.
    Stops when the test passes or when no normalised residual exceeds ``threshold``. Equal residuals are
    broken by meter id; the others of the tie are reported as indistinguishable. A measurement without which
    the state is not observable is critical: it stays, and the next largest residual is looked at. If without
    a measurement the estimation diverges, the last good estimate stands, and ``detected`` with it.

    Raises:
        NotObservableError: without voltmeters that read less than DEAD_VM, which it names.
        As ``estimate_with_plan``, about all readings.
    """

    def estimate(plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray) -> EstimationResult:
        return estimate_with_plan(plan, values, sigmas, start=start, tolerance=tolerance)

    def estimate_without(rows: Sequence[int], plan: EstimationPlan, *scan: np.ndarray) -> EstimationResult:
        return estimate(plan.without(rows), *(np.delete(readings, rows) for readings in scan))

    low = _find_low_voltmeters(plan, values)
    try:
        dead, removed = _find_dead_voltmeters(low, plan, values, sigmas, estimate_without, threshold)
        result = estimate_without(dead, plan, values, sigmas) if dead else estimate(plan, values, sigmas)
    except NotObservableError as gap:
        result, removed = _confirm_low_voltages(low, plan, values, sigmas, estimate, confidence, gap), []
    kept: set[str] = set()  # critical, found out by trying
    while _exceeds_limit(result, confidence) and (found := _find_worst(result, threshold, kept)):
        row, worst = found
        try:
            result = estimate_without([row], result.plan, result.values, result.sigmas)
            removed.append(worst)
        except NotObservableError:
            kept.add(worst.measurement.meter.id)
        except EstimationDivergedError:
            break
    critical = kept.union(find_critical(result))
    detected = _exceeds_limit(result, confidence)
    return BadDataReport(
        result=result,
        removed=tuple(removed),
        critical=tuple(meter.id for meter in result.plan.meters if meter.id in critical),
        detected=detected,
        objective=result.objective,
        chi_square_limit=chi_square_limit(result.degrees_of_freedom, confidence),
        degrees_of_freedom=result.degrees_of_freedom,
        suspect=_find_suspect(result, threshold, critical) if detected else None,
    )


def _find_low_voltmeters(plan: EstimationPlan, values: np.ndarray) -> list[int]:
    """Positions of the voltmeters that read less than DEAD_VM."""
    low = np.flatnonzero(np.asarray(values) < DEAD_VM).tolist()
    return [k for k in low if plan.meters[k].kind is MeasurementKind.VM]


def _find_dead_voltmeters(
    low: Sequence[int],
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    estimate_without: Callable[[Sequence[int], EstimationPlan, np.ndarray, np.ndarray], EstimationResult],
    threshold: float,
) -> tuple[list[int], list[RemovedMeasurement]]:
    """Voltmeters ``low`` that the estimate without them contradicts, with their positions; none where it diverges.

    (z - vm) / sqrt(sigma^2 + sigma_vm^2) is the normalised residual of the meter in the linear model, but taken
    at a state that the reading has not moved.

    Raises:
        NotObservableError: the other meters do not determine the state.
    """
    if not low:
        return [], []
    try:
        result = estimate_without(low, plan, values, sigmas)
    except (InvalidInputError, EstimationDivergedError):
        return [], []  # the estimate with all of them says what is wrong
    sigma_vm, _ = result.state_sigma()
    rows, dead = [], []
    for k in low:
        m = Measurement(plan.meters[k], float(values[k]), float(sigmas[k]))
        row = plan.network.row[m.meter.bus]
        normalized = float(abs(m.value - result.vm[row]) / np.hypot(m.sigma, sigma_vm[row]))
        if normalized > threshold:
            rows.append(k)
            dead.append(RemovedMeasurement(m, normalized, ()))
    return rows, dead


def _confirm_low_voltages(
    low: Sequence[int],
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    estimate: Callable[[EstimationPlan, np.ndarray, np.ndarray], EstimationResult],
    confidence: float,
    gap: NotObservableError,
) -> EstimationResult:
    """The estimate with voltmeters ``low``, without which there is a ``gap``, where they confirm each other.

    Each must be one that the others could replace, and all readings together must pass the chi-square test: else
    the state would follow a dead meter, and good meters would be removed until nothing contradicts it.

    Raises:
        NotObservableError: they do not.
    """
    if not plan.indispensable[list(low)].any():
        try:
            result = estimate(plan, values, sigmas)
        except EstimationDivergedError:
            pass
        else:
            if not _exceeds_limit(result, confidence):
                return result
    left_out = [f"{plan.meters[k]} reads {float(values[k]):.3g} p.u., below {DEAD_VM:g}" for k in low]
    raise NotObservableError(gap.buses, gap.cures, left_out) from None


def _exceeds_limit(result: EstimationResult, confidence: float) -> bool:
    return result.objective >= chi_square_limit(result.degrees_of_freedom, confidence)


def _find_worst(
    result: EstimationResult, threshold: float, kept: Collection[str]
) -> tuple[int, RemovedMeasurement] | None:
    """The largest normalised residual above ``threshold`` but for the meters ``kept``, with those that equal it."""
    normalized, meters = normalized_residuals(result), result.plan.meters
    candidates = [k for k in np.flatnonzero(normalized > threshold).tolist() if meters[k].id not in kept]
    largest = max((normalized[k] for k in candidates), default=0.0)
    tied = sorted((k for k in candidates if normalized[k] >= largest * (1 - TIE)), key=lambda k: meters[k].id)
    if not tied:
        return None
    first = tied[0]
    equal = np.flatnonzero(abs(normalized - largest) <= TIE * largest).tolist()
    return first, RemovedMeasurement(
        measurement=result.measurements[first],
        normalized_residual=float(normalized[first]),
        indistinguishable_from=tuple(sorted(meters[k].id for k in equal if k != first)),
    )


def _find_suspect(result: EstimationResult, threshold: float, critical: Collection[str]) -> SuspectKept | None:
    """The largest normalised residual where removal has ended, with what keeps its meter."""
    normalized = normalized_residuals(result)
    worst = int(np.argmax(normalized))
    if normalized[worst] <= threshold:
        return None
    meter = result.plan.meters[worst]
    return SuspectKept(meter, float(normalized[worst]), "critical" if meter.id in critical else "diverges")
