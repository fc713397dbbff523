"""Weighted-least-squares state estimation by Gauss-Newton, virtual measurements as equality constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.admittance import build_admittance, flat_start
from dsse_core.errors import EstimationDivergedError
from dsse_core.measurement import Measurement, MeasurementKind, Source, check_measurements
from dsse_core.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.network import Network
from dsse_core.observability import check_observable

BLOCK = 256  # right-hand sides solved at once; bounds memory at (2 n_bus, BLOCK)


class GainFactor:
    """The factorised Gauss-Newton system of the free state variables under equality constraints.

    ``[G  C'] [dx]   [g ]``
    ``[C  0 ] [l ] = [-c]``  with ``G = H'WH`` (thesis eq. 3.13); scaled to unit diagonal before factorising.
    """

    def __init__(self, G: sp.csr_array, C: sp.csr_array) -> None:
        self.n_state = G.shape[0]
        diagonal = G.diagonal()
        d = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = C @ sp.diags_array(d)
        length = np.sqrt(np.asarray(scaled.multiply(scaled).sum(axis=1)).ravel())
        self._scale = np.r_[d, 1 / np.where(length > 0, length, 1.0)]
        K = sp.block_array([[G, C.T], [C, None]], format="csc") if C.shape[0] else G.tocsc()
        D = sp.diags_array(self._scale)
        self._lu = spla.splu((D @ K @ D).tocsc())

    def solve(self, g: np.ndarray, c: np.ndarray | None = None) -> np.ndarray:
        """dx for gradient ``g`` (n_state, ...) and constraint values ``c`` (0 if left out)."""
        n_constraint = len(self._scale) - self.n_state
        below = np.zeros((n_constraint, *g.shape[1:])) if c is None else -c
        scale = self._scale.reshape(-1, *(1,) * (g.ndim - 1))
        return (scale * self._lu.solve(scale * np.concatenate([g, below])))[: self.n_state]


@dataclass(frozen=True)
class EstimationResult:
    """The estimate. ``vm`` p.u., ``va`` rad: shape (n_bus,), network order; ``residual`` z - h(x): (n_meas,).

    ``objective`` is J(x) (eq. 3.9), which under the model's assumptions is chi-square distributed with
    ``degrees_of_freedom`` = measurements + constraints - state variables.
    """

    network: Network
    measurements: tuple[Measurement, ...]
    vm: np.ndarray
    va: np.ndarray
    residual: np.ndarray
    objective: float
    degrees_of_freedom: int
    iterations: int
    free: np.ndarray
    jacobian: sp.csr_array
    factor: GainFactor

    def state_covariance(self, rows: Sequence[int]) -> np.ndarray:
        """Covariance of the entries ``rows`` of x = [va; vm], shape (k, k); 0 for the reference angle."""
        position = {int(row): k for k, row in enumerate(self.free)}
        unit = np.zeros((len(self.free), len(rows)))
        for column, row in enumerate(rows):
            if row in position:
                unit[position[row], column] = 1.0
        return unit.T @ self.factor.solve(unit)

    def state_sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (sigma_vm, sigma_va) of all buses, p.u. and rad."""
        variance = np.zeros(2 * len(self.network.buses))
        for block in np.array_split(np.arange(len(self.free)), -(-len(self.free) // BLOCK)):
            unit = np.zeros((len(self.free), len(block)))
            unit[block, np.arange(len(block))] = 1.0
            variance[self.free[block]] = self.factor.solve(unit)[block, np.arange(len(block))]
        sigma_va, sigma_vm = np.split(np.sqrt(np.maximum(variance, 0.0)), 2)
        return sigma_vm, sigma_va

    @cached_property
    def residual_variance(self) -> np.ndarray:
        """diag(Omega) = R_ii - H_i G^-1 H_i' (eq. 3.22), shape (n_meas,); solved in blocks of rows of H."""
        H = self.jacobian
        leverage = np.zeros(H.shape[0])
        for block in np.array_split(np.arange(H.shape[0]), -(-H.shape[0] // BLOCK)):
            rows = H[block].toarray()
            leverage[block] = np.einsum("ij,ji->i", rows, self.factor.solve(rows.T))
        sigma = np.array([m.sigma for m in self.measurements])
        return sigma**2 - leverage


def estimate_state(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
) -> EstimationResult:
    """Find the state that minimises J(x) = (z - h(x))' W (z - h(x)), W = diag(1 / sigma^2) (eqs. 3.8-3.14).

    Virtual measurements hold exactly. Gauss-Newton from the flat start, or from ``start`` = (vm, va), until
    max |dx| < ``tolerance``. Current magnitudes enter after the first step off the flat start.

    Args:
        reference: bus whose angle is given (0, or that of ``start``); the slack bus by default.

    Raises:
        InvalidInputError: measurements that do not fit the network.
        NotObservableError: names the buses that are not determined.
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    measurements = tuple(measurements)
    check_measurements(network, measurements)
    meters = [m.meter for m in measurements]
    reference = reference if reference is not None else network.slack.bus if network.slack else network.buses[0].id
    check_observable(network, meters, reference=reference)
    vm, va = start if start is not None else flat_start(network, reference)
    model = build_measurement_model(network, build_admittance(network), meters)
    free = np.delete(np.arange(2 * len(vm)), network.row[reference])
    virtual = np.array([meter.source is Source.VIRTUAL for meter in meters])
    currents = np.array([meter.kind is MeasurementKind.CURRENT for meter in meters])
    weight = np.array([0.0 if m.meter.source is Source.VIRTUAL else m.sigma**-2.0 for m in measurements])
    x = np.r_[va, vm]
    for iteration in range(1, max_iterations + 1):
        usable = np.where(currents, 0.0, weight) if iteration == 1 and start is None else weight
        H, r = model.jacobian(x)[:, free], _residual(model, measurements, x)
        factor = _factorise(H, usable, virtual, iteration, r, weight, measurements)
        dx = factor.solve(H.T @ (usable * r), -r[virtual])
        x = x.copy()
        x[free] += dx
        if not np.isfinite(x).all() or abs(dx).max(initial=0.0) > 1e6:
            raise _divergence(iteration, dx, r, weight, measurements)
        if abs(dx).max(initial=0.0) < tolerance and not (iteration == 1 and start is None and currents.any()):
            break
    else:
        raise _divergence(max_iterations, dx, r, weight, measurements)
    H, r = model.jacobian(x)[:, free], _residual(model, measurements, x)
    va, vm = np.split(x, 2)
    return EstimationResult(
        network=network,
        measurements=measurements,
        vm=vm,
        va=va,
        residual=r,
        objective=float(r @ (weight * r)),
        degrees_of_freedom=len(measurements) - len(free),
        iterations=iteration,
        free=free,
        jacobian=H,
        factor=_factorise(H, weight, virtual, iteration, r, weight, measurements),
    )


def _residual(model: MeasurementModel, measurements: Sequence[Measurement], x: np.ndarray) -> np.ndarray:
    """z - h(x); differences of angles are wrapped to (-pi, pi]."""
    r = np.array([m.value for m in measurements]) - model.predict(x)
    angles = model.kinds == MeasurementKind.VA
    r[angles] = np.pi - (np.pi - r[angles]) % (2 * np.pi)
    return r


def _factorise(
    H: sp.csr_array,
    usable: np.ndarray,
    virtual: np.ndarray,
    iteration: int,
    r: np.ndarray,
    weight: np.ndarray,
    measurements: Sequence[Measurement],
) -> GainFactor:
    G = sp.csr_array(H.T @ sp.diags_array(usable) @ H)
    try:
        return GainFactor(G, H[np.flatnonzero(virtual)])
    except RuntimeError:  # SuperLU: exactly singular away from the no-load state, where the rank was full
        raise _divergence(iteration, np.array([np.inf]), r, weight, measurements) from None


def _divergence(
    iteration: int, dx: np.ndarray, r: np.ndarray, weight: np.ndarray, measurements: Sequence[Measurement]
) -> EstimationDivergedError:
    worst = measurements[int(np.argmax(np.nan_to_num(weight * r**2, nan=np.inf)))].meter
    return EstimationDivergedError(iteration, float(abs(dx).max(initial=0.0)), str(worst))
