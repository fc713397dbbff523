"""Weighted-least-squares state estimation by Gauss-Newton, virtual measurements as equality constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.decision import Memory
from dsse_core.estimation.divergence import IterationLostError, explain_divergence
from dsse_core.estimation.plan import Backend, BackendChoice, EstimationPlan, build_estimation_plan
from dsse_core.estimation.radial import RadialInverse, estimate_radial, find_radial_variances, invert_radial
from dsse_core.estimation.sparse import estimate_sparse
from dsse_core.gauss_newton import LAST_STEP
from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import Measurement, are_usable, check_measurements, check_readings, read_numbers
from dsse_core.grid.meter_table import find_virtual, read_meters_of
from dsse_core.grid.network import Network
from dsse_core.matrices.augmented import AugmentedFactor
from dsse_core.row_threads import find_threads

NO_MEMORY = Memory()


@dataclass(frozen=True, repr=False)
class EstimationResult:
    """The estimate. ``vm`` p.u., ``va`` rad: shape (n_bus,), network order; ``residual`` z - h(x): (n_meas,).

    ``values``, ``sigmas`` (n_meas,): the readings of the plan's meters, sigma 0 where a reading holds exactly.
    ``objective`` is J(x) (eq. 3.9), which under the model's assumptions is chi-square distributed with
    ``degrees_of_freedom`` = measurements + constraints - state variables. What is not stored is computed when it is
    asked for, by the radial back end where that is chosen, and else, or where it does not give it, by sparse
    factorisation. ``iterations``: steps since the start that it ended from. ``memory``: what later verdicts rest on;
    ``evaluating`` where J has exceeded the chi-square limit.
    """

    plan: EstimationPlan
    values: np.ndarray
    sigmas: np.ndarray
    memory: Memory
    vm: np.ndarray
    va: np.ndarray
    residual: np.ndarray
    objective: float
    iterations: int

    def __repr__(self) -> str:
        return (
            f"<EstimationResult of {self.network.name!r}: {len(self.vm)} buses, J = {self.objective:.4g} "
            f"with {self.degrees_of_freedom} degrees of freedom, {self.iterations} iterations, {self.backend!r}>"
        )

    @property
    def backend(self) -> Backend:
        """By which the state was found; ``plan.radial`` says why not by the other."""
        return self.plan.backend

    @property
    def network(self) -> Network:
        return self.plan.network

    @property
    def reference(self) -> int:
        """The bus whose angle is given."""
        return self.plan.reference

    @property
    def degrees_of_freedom(self) -> int:
        return self.plan.degrees_of_freedom

    @property
    def free(self) -> np.ndarray:
        """The unknown entries of x = [va; vm]: all but the reference angle."""
        return self.plan.sparse.free

    @cached_property
    def measurements(self) -> tuple[Measurement, ...]:
        readings = zip(self.plan.meters, self.values.tolist(), self.sigmas.tolist(), strict=True)
        return tuple(Measurement(meter, value, sigma) for meter, value, sigma in readings)

    @cached_property
    def jacobian(self) -> sp.csr_array:
        """H(x), columns ``free``."""
        return self.plan.sparse.linearize(np.concatenate([self.va, self.vm]))[1]

    @cached_property
    def factor(self) -> AugmentedFactor:
        return self.plan.sparse.factor(self.jacobian, self.sigmas)

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
        """Standard deviations (sigma_vm, sigma_va) of all buses, p.u. and rad; nan where they would take too long."""
        if (of_radial := self._radial_variances) is not None:
            variance = of_radial[0]
        else:
            variance = np.zeros(2 * len(self.vm))
            variance[self.free] = self.factor.state_variance(limited=True)
        sigma_va, sigma_vm = np.split(np.sqrt(np.maximum(variance, 0.0)), 2)
        return sigma_vm, sigma_va

    @cached_property
    def residual_variance(self) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); 0 for virtual measurements.

        In networks with so many long loops that all would take too long it is nan, but of the largest |r| / sigma.
        """
        if (of_radial := self._radial_variances) is not None:
            return of_radial[1]
        exact = self.sigmas == 0
        weighted = np.where(exact, 0.0, abs(self.residual) / np.where(exact, 1.0, self.sigmas))
        found = self.factor.residual_variance(np.argsort(-weighted, kind="stable"))
        return np.where(exact, 0.0, found)

    @cached_property
    def radial_inverse(self) -> RadialInverse:
        """What all variances follow from where the back end is radial."""
        assert not isinstance(self.plan.radial, str), "the back end is sparse"
        return invert_radial(self.plan.radial, self.sigmas, self.vm, self.va)

    @property
    def _radial_variances(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Variances of x and of the residuals where the back end is radial."""
        radial = self.plan.radial
        return None if isinstance(radial, str) else find_radial_variances(radial, self.radial_inverse)


def estimate_state(
    network: Network,
    measurements: Sequence[Measurement],
    *,
    reference: int | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = LAST_STEP,
    backend: BackendChoice = "auto",
) -> EstimationResult:
    """The estimate of one scan: ``build_estimation_plan``, which says what ``reference`` and ``backend`` are, and
    ``estimate_with_plan``. For more than one scan of the same meters build the plan once.

    Raises:
        InvalidInputError: measurements that do not fit the network, or a back end that cannot serve.
        NotObservableError: names the buses that are not determined.
        EstimationDivergedError: says why there is no end.
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
    threads: int = 1,
) -> EstimationResult:
    """Find the state that minimises J(x) = (z - h(x))' W (z - h(x)), W = diag(1 / sigma^2) (eqs. 3.8-3.14).

    ``values``, ``sigmas`` (n_meas,): the readings of the plan's meters. Virtual ones hold exactly; their sigma does
    not count. Gauss-Newton as ``decision.decide`` says, until it is final or normalised residuals are wanted: no step
    moves a voltage by more than MAX_DVM and MAX_DVA, and current magnitudes enter once the others have sent where flows
    go: before, they have several minima.

    Args:
        start: (vm, va) in network order, such as the last scan's; its angle of the reference is kept. By default the
            flat start, and there the set-point of the slack bus, 0 elsewhere; so too where the start leads to no end.
        tolerance: what the last step may move, p.u. and rad, where steps shrink no faster than by one rate.
        memory: what has been removed, and whether a start has led to no end before.
        threads: that share the feeders below the first fork of a radial network; others are solved on one. Worth it
            from some 10,000 buses on.

    Raises:
        InvalidInputError: readings that cannot be, a start that does not fit, or no thread.
        EstimationDivergedError: says why there is no end, see ``explain_divergence``.
    """
    values, sigmas = np.array(read_numbers("values", values)), np.array(read_numbers("sigmas", sigmas))
    try:
        return iterate_with_plan(plan, values, sigmas, start=start, tolerance=tolerance, memory=memory, threads=threads)
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
    threads: int = 1,
) -> EstimationResult:
    """``estimate_with_plan`` for a caller that goes on without an estimate, and need not know why there is none.

    Raises:
        InvalidInputError: as there.
        IterationLostError: there is no end.
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
        memory, found = estimate_sparse(plan.sparse, values, sigmas, *options)
    else:
        memory, found = estimate_radial(plan.radial, plan.virtual, values, sigmas, *options, find_threads(threads))
    return EstimationResult(plan, values, sigmas, memory, *found)


def _read_start(plan: EstimationPlan, vm: np.ndarray, va: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vm, va = read_numbers("vm of the start", vm), read_numbers("va of the start", va)
    n = len(plan.network.buses)
    if not vm.shape == va.shape == (n,):
        problem = f"the start has shapes {vm.shape} and {va.shape}; give ({n},) twice"
        raise InvalidInputError(f"estimate of network {plan.network.name!r}", [problem])
    return vm, va


def _are_usable(values: np.ndarray, sigmas: np.ndarray, virtual: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and np.where(virtual, values == 0.0, are_usable(sigmas)).all())
