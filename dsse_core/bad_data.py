"""Bad data: chi-square detection, identification by the largest normalised residual, removal (thesis 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.estimation import EstimationResult, estimate_state
from dsse_core.measurement import Measurement, Source
from dsse_core.network import Network

CRITICAL_REDUNDANCY = 1e-8  # Omega_ii / R_ii below which a residual says nothing about its measurement
TIE = 1e-6  # relative difference of normalised residuals that are equal in exact arithmetic


@dataclass(frozen=True)
class RemovedMeasurement:
    """A measurement taken out, and the meters that the data cannot tell from it."""

    measurement: Measurement
    normalized_residual: float
    indistinguishable_from: tuple[str, ...]


@dataclass(frozen=True)
class BadDataReport:
    """The clean estimate and how it was reached. ``detected``: the chi-square limit is still exceeded."""

    result: EstimationResult
    removed: tuple[RemovedMeasurement, ...]
    critical: tuple[str, ...]
    detected: bool
    objective: float
    chi_square_limit: float
    degrees_of_freedom: int


def chi_square_limit(degrees_of_freedom: int, confidence: float) -> float:
    """The value that J exceeds with probability 1 - ``confidence`` under noise alone; inf without redundancy."""
    from scipy.special import chdtri  # 0.1 s, which an agent without bad-data processing need not wait for

    return float(chdtri(degrees_of_freedom, 1 - confidence)) if degrees_of_freedom > 0 else float("inf")


def find_critical(result: EstimationResult) -> tuple[str, ...]:
    """Ids of the measurements without redundancy: their residual is zero whatever they read."""
    return tuple(
        m.meter.id
        for m, variance in zip(result.measurements, result.residual_variance, strict=True)
        if m.meter.source is not Source.VIRTUAL and variance <= CRITICAL_REDUNDANCY * m.sigma**2
    )


def normalized_residuals(result: EstimationResult) -> np.ndarray:
    """|r_i| / sqrt(Omega_ii) (eq. 3.23), shape (n_meas,); 0 for virtual and critical measurements."""
    sigma = np.array([m.sigma for m in result.measurements])
    telling = result.residual_variance > CRITICAL_REDUNDANCY * sigma**2
    telling &= np.array([m.meter.source is not Source.VIRTUAL for m in result.measurements], dtype=bool)
    return np.where(telling, abs(result.residual) / np.sqrt(np.where(telling, result.residual_variance, 1.0)), 0.0)


def process_bad_data(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 1e-6,
    confidence: float = 0.99,
    threshold: float = 3.0,
) -> BadDataReport:
    """Estimate; while J exceeds the chi-square limit, remove the largest normalised residual and repeat.

    Stops when the test passes or when no normalised residual exceeds ``threshold``. Equal residuals are
    broken by meter id; the others of the tie are reported as indistinguishable.

    Raises:
        As ``estimate_state``.
    """
    remaining = list(measurements)
    removed: list[RemovedMeasurement] = []
    while True:
        result = estimate_state(network, remaining, reference=reference, start=start, tolerance=tolerance)
        limit = chi_square_limit(result.degrees_of_freedom, confidence)
        detected = result.objective >= limit
        worst = _find_worst(result, threshold) if detected else None
        if worst is None:
            return BadDataReport(
                result=result,
                removed=tuple(removed),
                critical=find_critical(result),
                detected=detected,
                objective=result.objective,
                chi_square_limit=limit,
                degrees_of_freedom=result.degrees_of_freedom,
            )
        removed.append(worst)
        remaining.remove(worst.measurement)


def _find_worst(result: EstimationResult, threshold: float) -> RemovedMeasurement | None:
    normalized = normalized_residuals(result)
    largest = normalized.max(initial=0.0)
    if largest <= threshold:
        return None
    tied = sorted(np.flatnonzero(normalized >= largest * (1 - TIE)), key=lambda k: result.measurements[k].meter.id)
    first, *others = tied
    return RemovedMeasurement(
        measurement=result.measurements[first],
        normalized_residual=float(normalized[first]),
        indistinguishable_from=tuple(result.measurements[k].meter.id for k in others),
    )
