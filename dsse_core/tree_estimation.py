"""The estimate of ``estimate_state`` for radial networks, by elimination on the tree; see ``tree_kernel``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dsse_core.errors import EstimationDivergedError
from dsse_core.measurement import Measurement, check_measurements
from dsse_core.tree_plan import N_SLOT, TreePlan

# Of the degrees of freedom, that is, of what J is on average: what the last step may still have gained. Squared norm
# of the gradient in the metric of the state's covariance.
GRADIENT = 1e-6


@dataclass(frozen=True)
class TreeEstimate:
    """The estimate; ``vm``, ``va``, ``residual``, ``objective``, ... as in ``EstimationResult``."""

    plan: TreePlan
    sigmas: np.ndarray
    vm: np.ndarray
    va: np.ndarray
    residual: np.ndarray
    objective: float
    degrees_of_freedom: int
    iterations: int

    def state_sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (sigma_vm, sigma_va) of all buses, p.u. and rad."""
        va, vm = np.sqrt(np.maximum(self._variances[0], 0.0)).T
        return vm, va

    @property
    def residual_variance(self) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); 0 for virtual measurements."""
        return self._variances[1]

    @cached_property
    def _variances(self) -> tuple[np.ndarray, np.ndarray]:
        """diag of the covariance of (va, vm), shape (n_bus, 2), network order; diag(Omega)."""
        from dsse_core import tree_inverse, tree_kernel

        plan, n = self.plan, len(self.vm)
        va = self.va[plan.order]
        v = self.vm[plan.order] * np.exp(1j * va)
        z, w = np.zeros((n, N_SLOT)), _weights(plan, self.sigmas)
        work = tree_kernel.Work.of(n)
        tree_kernel.eliminate(plan.parent, plan.admittance, z, w, v, va, True, tree_kernel.INVERT, *work)
        root = tree_inverse.root_of_reference(work.block)
        state, omega, _ = tree_inverse.find_variances(plan.parent, plan.admittance, z, w, v, *work[1:3], root)
        in_network_order = np.empty_like(state)
        in_network_order[plan.order] = state
        return in_network_order, omega.ravel()[plan.slot]


def estimate_on_tree(
    plan: TreePlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
) -> TreeEstimate:
    """Find the state that ``estimate_state`` finds for readings ``values``, ``sigmas`` (n_meas,) of the plan's meters.

    The sigma of a virtual meter is not used. Step by step the iteration of ``estimate_state``, but for the end: also
    the gradient must be next to none.

    Args:
        start: (vm, va) in network order; the flat start by default.

    Raises:
        InvalidInputError: readings that cannot be, as ``check_measurements`` tells.
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    from dsse_core import tree_iteration, tree_kernel

    values, sigmas = np.asarray(values, dtype=float), np.where(plan.virtual, 0.0, sigmas)
    _check(plan, values, sigmas)
    n = len(plan.order)
    z, w = np.zeros((n, N_SLOT)), _weights(plan, sigmas)
    z.ravel()[plan.slot] = values
    if start is None:
        v, va = plan.start.copy(), plan.start_va.copy()
    else:
        va = np.array(start[1], dtype=float)[plan.order]
        v = np.asarray(start[0])[plan.order] * np.exp(1j * va)
    degrees_of_freedom = len(values) - (2 * n - 1)
    end, iterations, step, _ = tree_iteration.iterate(
        plan.parent,
        plan.admittance,
        z,
        w,
        v,
        va,
        start is not None,
        plan.has_currents,
        float(tolerance),
        max_iterations,
        GRADIENT * max(1, degrees_of_freedom),
        *tree_kernel.Work.of(n),
    )
    h = np.empty((n, N_SLOT))
    tree_iteration.predict(plan.parent, plan.admittance, v, va, h)
    residual = values - h.ravel()[plan.slot]
    residual[plan.angles] = np.pi - (np.pi - residual[plan.angles]) % (2 * np.pi)
    weighted = residual / np.where(sigmas > 0, sigmas, np.inf)
    if end != tree_iteration.CONVERGED:
        worst = plan.meters[int(np.argmax(abs(weighted)))] if len(plan.meters) else "no meter"
        raise EstimationDivergedError(iterations, step, str(worst))
    vm_out, va_out = np.empty(n), np.empty(n)
    vm_out[plan.order], va_out[plan.order] = abs(v), va
    return TreeEstimate(
        plan, sigmas, vm_out, va_out, residual, float(weighted @ weighted), degrees_of_freedom, iterations
    )


def _weights(plan: TreePlan, sigmas: np.ndarray) -> np.ndarray:
    """Shape (n_bus, N_SLOT): 1 / sigma^2, of injections sigma^2; as ``tree_kernel.absent`` where there is no meter."""
    from dsse_core import tree_kernel

    w = tree_kernel.absent(len(plan.order))
    weight = sigmas * sigmas
    variance = weight[plan.injections]
    weight[plan.injections] = 1.0
    np.reciprocal(weight, out=weight)
    weight[plan.injections] = variance
    w.ravel()[plan.slot] = weight
    return w


def _check(plan: TreePlan, values: np.ndarray, sigmas: np.ndarray) -> None:
    """Raise as ``check_measurements`` does."""
    usable = np.where(plan.virtual, values == 0.0, np.isfinite(sigmas) & (sigmas > 0))
    if usable.all() and np.isfinite(values).all():
        return
    readings = zip(plan.meters, values.tolist(), sigmas.tolist(), strict=True)
    check_measurements(plan.network, [Measurement(meter, value, sigma) for meter, value, sigma in readings])
