"""Covariances of what follows from the state, on sparse matrices: each quantity is a state variable of its own.

A power y = h(x) joins the tableau as an unknown with the constraint ``H_y dx - dy = 0``. Elimination then finds its
variance as that of a voltage, and not as a difference of large numbers.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.estimation.estimator import EstimationResult
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.matrices.augmented import AugmentedFactor

INJECTIONS = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)


def find_sparse_covariances(result: EstimationResult) -> tuple[np.ndarray, np.ndarray]:
    """Of the branches in service: covariance of P, Q and ln vm at the from end, (n_active, 3, 3); and the variances of
    P and Q that the buses inject, (2, n_bus); p.u.
    """
    network, n = result.network, len(result.vm)
    active = network.active_branches
    metered = _metered_injections(result)
    meters = [
        Meter(kind, b.from_bus, b.id) for kind in (MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW) for b in active
    ]
    unmetered = np.argwhere(np.isnan(metered))
    meters += [Meter(INJECTIONS[kind], network.buses[row].id) for kind, row in unmetered.tolist()]
    factor = _extended_factor(result, meters)
    n_free, n_active = len(result.free), len(active)
    position = np.full(2 * n, -1)
    position[result.free] = np.arange(n_free)
    rows_from = np.array([network.row[b.from_bus] for b in active], dtype=np.int64)
    p = n_free + np.arange(n_active)
    y = p, p + n_active, position[n + rows_from]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    of_injections = n_free + 2 * n_active + np.arange(len(unmetered))
    entries = factor.covariance_at(
        np.concatenate([*(y[a] for a, _ in pairs), of_injections]),
        np.concatenate([*(y[b] for _, b in pairs), of_injections]),
    )
    covariance = np.empty((n_active, 3, 3))
    scale = np.ones(n_active), np.ones(n_active), 1 / result.vm[rows_from]
    for k, (a, b) in enumerate(pairs):
        part = entries[k * n_active : (k + 1) * n_active] * scale[a] * scale[b]
        covariance[:, a, b] = covariance[:, b, a] = part
    metered[unmetered[:, 0], unmetered[:, 1]] = entries[len(pairs) * n_active :]
    return covariance, metered


def _metered_injections(result: EstimationResult) -> np.ndarray:
    """Variances of metered injections, ``R - Omega``, (2, n_bus); nan where there is no meter."""
    found = np.full((2, len(result.vm)), np.nan)
    variance = result.sigmas**2 - result.residual_variance
    for meter, value in zip(result.plan.meters, variance.tolist(), strict=True):
        if meter.kind.of_injection:
            found[INJECTIONS.index(meter.kind), result.network.row[meter.bus]] = max(value, 0.0)
    return found


def _extended_factor(result: EstimationResult, meters: list[Meter]) -> AugmentedFactor:
    """The factor of the tableau with what perfect ``meters`` read as further unknowns."""
    model = build_measurement_model(result.network, build_admittance(result.network), meters)
    of_y = model.jacobian(np.concatenate([result.va, result.vm]))[:, result.free]
    H = sp.block_array([[result.jacobian, None], [of_y, -sp.eye_array(len(meters))]], format="csr")
    return AugmentedFactor(sp.csr_array(H), np.concatenate([result.sigmas, np.zeros(len(meters))]))
