"""What an area's part of the estimate says of its meters: the suspects, the critical ones, what each would read."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from dsse_core.estimation.residuals import CRITICAL_REDUNDANCY, THRESHOLD, normalize_residuals, split_suspects
from dsse_core.linear.area_model import AreaModel


def find_suspects(
    model: AreaModel, x: np.ndarray, variance: np.ndarray, critical: Collection[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Meter -> its normalised residual, the largest of the area above the threshold and those that equal it: meters
    that may go, and ``critical`` ones.

    ``x``: state, shape (size,), p.u. and rad; ``variance``: diag(Omega) at ``x``, shape (n_meas,).
    """
    normalized = normalize_residuals(model.residual(x), variance, model.sigma, ~model.virtual)
    above = np.flatnonzero(normalized > THRESHOLD)
    return split_suspects({model.ids[k]: float(normalized[k]) for k in above}, critical)


def find_critical(model: AreaModel, variance: np.ndarray, indispensable: Collection[str]) -> tuple[str, ...]:
    """Ids of the meters that are ``indispensable`` at no load, or whose residual says nothing.

    ``variance``: diag(Omega), shape (n_meas,).
    """
    without_check = (variance <= CRITICAL_REDUNDANCY * model.sigma**2) & ~model.virtual
    critical = {*indispensable, *(model.ids[k] for k in np.flatnonzero(without_check))}
    return tuple(meter for meter in model.ids if meter in critical)


def estimate_readings(model: AreaModel, x: np.ndarray, variance: np.ndarray) -> dict[str, tuple[float, float]]:
    """Id of each real meter in use -> h(x), p.u. or rad, and its normalised residual, 0 where no other meter checks it.

    ``x``: state, shape (size,), p.u. and rad; ``variance``: diag(Omega), shape (n_meas,).
    """
    residual = model.residual(x)
    normalized = normalize_residuals(residual, variance, model.sigma, ~model.virtual).tolist()
    estimates = (model.z - residual).tolist()
    return {model.ids[k]: (estimates[k], normalized[k]) for k in np.flatnonzero(~model.virtual)}
