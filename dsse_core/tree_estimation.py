"""The estimate of radial networks by elimination on the tree; see ``tree_kernel``."""

from __future__ import annotations

import numpy as np

from dsse_core.errors import EstimationDivergedError
from dsse_core.gauss_newton import GRADIENT, Solution
from dsse_core.tree_plan import N_SLOT, TreePlan


def estimate_on_tree(
    plan: TreePlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    max_iterations: int,
) -> Solution:
    """The iteration of ``estimate_sparse``, step by step; ``sigmas`` (n_meas,) are 0 where a reading holds exactly.

    Raises:
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    from dsse_core import tree_iteration, tree_kernel

    n = len(plan.order)
    z, w = np.zeros((n, N_SLOT)), tree_kernel.absent(n)
    tree_iteration.store(plan.slot, values, sigmas, z, w)
    if start is None:
        v, va = plan.start.copy(), plan.start_va.copy()
    else:
        va = np.array(start[1], dtype=float)[plan.order]
        v = np.asarray(start[0])[plan.order] * np.exp(1j * va)
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
        GRADIENT * max(1, len(values) - (2 * n - 1)),
        *tree_kernel.Work.of(n),
    )
    h = np.empty((n, N_SLOT))
    tree_iteration.predict(plan.parent, plan.admittance, v, va, h)
    residual = tree_iteration.subtract(plan.slot, values, h)
    if end != tree_iteration.CONVERGED:
        weighted = residual / np.where(sigmas > 0, sigmas, np.inf)
        worst = plan.meters[int(np.argmax(abs(weighted)))] if len(plan.meters) else "no meter"
        raise EstimationDivergedError(iterations, step, str(worst))
    vm_out, va_out = np.empty(n), np.empty(n)
    vm_out[plan.order], va_out[plan.order] = abs(v), va
    return Solution(vm_out, va_out, residual, iterations)


def find_variances_on_tree(
    plan: TreePlan, sigmas: np.ndarray, vm: np.ndarray, va: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """diag of the covariance of x = [va; vm], shape (2 n_bus,), network order, and diag(Omega), (n_meas,)."""
    from dsse_core import tree_inverse, tree_iteration, tree_kernel

    n = len(vm)
    va = va[plan.order]
    v = vm[plan.order] * np.exp(1j * va)
    z, w = np.zeros((n, N_SLOT)), tree_kernel.absent(n)
    tree_iteration.store(plan.slot, np.zeros(len(sigmas)), sigmas, z, w)
    work = tree_kernel.Work.of(n)
    tree_kernel.eliminate(plan.parent, plan.admittance, z, w, v, va, True, tree_kernel.INVERT, *work)
    root = tree_inverse.root_of_reference(work.block)
    in_tree_order, omega, _ = tree_inverse.find_variances(plan.parent, plan.admittance, z, w, v, *work[1:3], root)
    state = np.empty((2, n))
    state[:, plan.order] = in_tree_order.T
    return state.ravel(), omega.ravel()[plan.slot]
