"""Weighted-least-squares state estimation by Gauss-Newton, virtual measurements as equality constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.admittance import build_admittance, flat_start
from dsse_core.augmented import AugmentedFactor
from dsse_core.errors import EstimationDivergedError
from dsse_core.measurement import Measurement, MeasurementKind, Source, check_measurements
from dsse_core.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.network import Network
from dsse_core.observability import check_observable, find_reference

# Gauss-Newton needs 3 to 6 steps; what takes longer swings around the answer, as current magnitudes make it
# do that are as uncertain as they are large, and half steps settle it.
FULL_STEPS = 10
FLOWS_KNOWN = 1e-4  # p.u. and rad; after a smaller step current magnitudes are used
LARGEST_STEP = 1e6  # p.u. or rad; beyond it the iteration has left every state of interest
# A longer step is shortened: a dead voltmeter must not throw all voltages to zero, where nothing converges.
MAX_DVM = 0.2  # p.u.
MAX_DVA = 1.0  # rad


@dataclass(frozen=True)
class EstimationResult:
    """The estimate. ``vm`` p.u., ``va`` rad: shape (n_bus,), network order; ``residual`` z - h(x): (n_meas,).

    ``objective`` is J(x) (eq. 3.9), which under the model's assumptions is chi-square distributed with
    ``degrees_of_freedom`` = measurements + constraints - state variables. ``reference``: the bus whose angle
    is given.
    """

    network: Network
    measurements: tuple[Measurement, ...]
    reference: int
    vm: np.ndarray
    va: np.ndarray
    residual: np.ndarray
    objective: float
    degrees_of_freedom: int
    iterations: int
    free: np.ndarray
    jacobian: sp.csr_array
    factor: AugmentedFactor

    def state_covariance(self, rows: Sequence[int]) -> np.ndarray:
        """Covariance of the entries ``rows`` of x = [va; vm], shape (k, k); 0 for the reference angle."""
        position = {int(row): k for k, row in enumerate(self.free)}
        unit = np.zeros((len(self.free), len(rows)))
        for column, row in enumerate(rows):
            if row in position:
                unit[position[row], column] = 1.0
        covariance: np.ndarray = unit.T @ self.factor.covariance_times(unit)
        return covariance

    def state_sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (sigma_vm, sigma_va) of all buses, p.u. and rad."""
        variance = np.zeros(2 * len(self.network.buses))
        variance[self.free] = self.factor.state_variance()
        sigma_va, sigma_vm = np.split(np.sqrt(np.maximum(variance, 0.0)), 2)
        return sigma_vm, sigma_va

    @cached_property
    def residual_variance(self) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); 0 for virtual measurements."""
        return self.factor.residual_variance()


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
    max |dx| < ``tolerance``; no step moves a voltage by more than MAX_DVM and MAX_DVA. From the flat start current
    magnitudes enter once the others have told where flows go: before, they have several minima.

    Args:
        reference: bus whose angle is given: that of ``start``, else the set-point of the slack bus, 0 elsewhere.
            The slack bus by default.

    Raises:
        InvalidInputError: measurements that do not fit the network.
        NotObservableError: names the buses that are not determined.
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    measurements = tuple(measurements)
    check_measurements(network, measurements)
    reference = find_reference(network, reference)
    meters = [m.meter for m in measurements]
    check_observable(network, meters, reference=reference)
    model = build_measurement_model(network, build_admittance(network), meters)
    vm, va = start if start is not None else _flat_start(network, reference)
    free = np.delete(np.arange(2 * len(vm)), network.row[reference])
    sigma = np.array([0.0 if m.meter.source is Source.VIRTUAL else m.sigma for m in measurements])
    is_current = model.kinds == MeasurementKind.CURRENT
    x = np.r_[va, vm]
    flows_known = start is not None
    for iteration in range(1, max_iterations + 1):
        used = np.flatnonzero(flows_known | ~is_current)
        H, r = model.jacobian(x)[:, free], _residual(model, measurements, x)
        try:
            dx = AugmentedFactor(H[used], sigma[used]).solve_step(r[used])
        except RuntimeError:  # SuperLU: singular away from the no-load state, where the rank was full
            raise EstimationDivergedError(iteration, np.inf, _name_worst(measurements, r, sigma)) from None
        step = float(abs(dx).max(initial=0.0))
        if not step <= LARGEST_STEP:
            raise EstimationDivergedError(iteration, step, _name_worst(measurements, r, sigma))
        x = x.copy()
        x[free] += dx * _step_length(dx, len(vm) - 1, halved=iteration > FULL_STEPS and step >= tolerance)
        if step < tolerance and (flows_known or not is_current.any()):
            break
        flows_known = flows_known or step < FLOWS_KNOWN
    else:
        raise EstimationDivergedError(max_iterations, step, _name_worst(measurements, r, sigma))
    H, r = model.jacobian(x)[:, free], _residual(model, measurements, x)
    va, vm = np.split(x, 2)
    return EstimationResult(
        network=network,
        measurements=measurements,
        reference=reference,
        vm=vm,
        va=va,
        residual=r,
        objective=float(np.sum(_weighted(r, sigma) ** 2)),
        degrees_of_freedom=len(measurements) - len(free),
        iterations=iteration,
        free=free,
        jacobian=H,
        factor=AugmentedFactor(H, sigma),
    )


def _step_length(dx: np.ndarray, n_angles: int, *, halved: bool) -> float:
    """The part of the step [dva; dvm] to take: the whole, or half, and no more than MAX_DVA and MAX_DVM allow."""
    dva, dvm = (float(abs(part).max(initial=0.0)) for part in (dx[:n_angles], dx[n_angles:]))
    return 1.0 / max(2.0 if halved else 1.0, dva / MAX_DVA, dvm / MAX_DVM)


def _flat_start(network: Network, reference: int) -> tuple[np.ndarray, np.ndarray]:
    vm, va = flat_start(network, reference)
    given = network.slack.va if network.slack and network.slack.bus == reference else 0.0
    return vm, va + given


def _residual(model: MeasurementModel, measurements: Sequence[Measurement], x: np.ndarray) -> np.ndarray:
    """z - h(x); differences of angles are wrapped to (-pi, pi]."""
    r = np.array([m.value for m in measurements]) - model.predict(x)
    angles = model.kinds == MeasurementKind.VA
    r[angles] = np.pi - (np.pi - r[angles]) % (2 * np.pi)
    return np.asarray(r)


def _weighted(r: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """r / sigma; 0 for virtual measurements."""
    return np.where(sigma > 0, r / np.where(sigma > 0, sigma, 1.0), 0.0)


def _name_worst(measurements: Sequence[Measurement], r: np.ndarray, sigma: np.ndarray) -> str:
    return str(measurements[int(np.argmax(abs(_weighted(r, sigma))))].meter)
