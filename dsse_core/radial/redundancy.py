"""Indispensable meters of a tree, found by fitting random readings at no load; see ``observability.NoLoadFit``."""

from __future__ import annotations

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.observability import ROUND_OFF, WIDTH
from dsse_core.radial import kernel as radial_kernel
from dsse_core.radial.iteration import branch_powers, find_residuals
from dsse_core.radial.kernel import coefficients_of, row_of_branch
from dsse_core.radial.plan import N_SLOT, RadialPlan
from dsse_core.radial.root import N_KNOWN, solve_root


def find_radial_indispensable(plan: RadialPlan) -> np.ndarray:
    """True for meters, virtual ones included, without any one of which the state is undetermined, (n_meas,), bool.

    Current magnitudes are never indispensable.
    """
    n, Y, slot = len(plan.order), plan.no_load_admittance, plan.slot
    length = _row_lengths(plan.parent, Y)
    own_length = length.ravel()[slot]
    z, w = np.zeros((n, N_SLOT)), radial_kernel.absent(n)
    exact = _predict(plan)
    w.ravel()[slot] = 1 / own_length**2
    w[:, 2:4] = np.where(w[:, 2:4] > 0, length[:, 2:4] ** 2, w[:, 2:4])
    w[:, [6, 9]] = 0.0
    rng, work = np.random.default_rng(0), radial_kernel.Work.of(n)
    v, va, largest = plan.start.copy(), plan.start_va.copy(), np.zeros(len(slot))
    for _ in range(WIDTH):
        z.ravel()[slot] = exact + own_length * rng.standard_normal(len(slot))
        at, root = (plan.parent, Y, z, w, v, va), (Y[0], z[0], w[0], v[0], va[0])
        radial_kernel.eliminate(1, n, *at, False, radial_kernel.STEP, *work[:5], 0.0)
        solve_root(*root, work.above[0], True, False, work.block, work.step)
        radial_kernel.descend(0, n, plan.parent, work.place, work.factor, v, va, work.step, 0.0, v, va)
        residual = _fit_residuals(*at, work.factor, work.more, work.step)
        largest = np.maximum(largest, abs(residual.ravel()[slot]) / own_length)
    of_current = np.isin(slot % N_SLOT, (6, 9))
    indispensable: np.ndarray = (largest < ROUND_OFF) & ~of_current
    return indispensable


def _predict(plan: RadialPlan) -> np.ndarray:
    """h of all meters at the flat start without load, (n_meas,)."""
    n, h = len(plan.order), np.empty(len(plan.slot))
    z, at = np.zeros((n, N_SLOT)), (plan.start, plan.start_va, True, plan.meter)
    memory = np.zeros((n, N_KNOWN)), np.empty(N_SLOT)
    find_residuals(0, n, plan.parent, plan.level, plan.no_load_admittance, z, radial_kernel.absent(n), *at, *memory, h)
    return -h


def _row_lengths(parent: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Rough length of the row of H of every slot, shape (n, N_SLOT), as ``observability`` scales rows."""
    ycc, ycp, ypp, ypc = abs(Y[:, :4]).T
    at_child, at_parent = np.hypot(ycc, ycp), np.hypot(ypp, ypc)
    at_parent[0] = 0.0
    of_bus = at_child + np.bincount(parent, at_parent, len(parent))
    length = np.ones((len(parent), N_SLOT))
    length[:, 2:4] = np.where(of_bus > 0, of_bus, 1.0)[:, None]
    length[1:, 4:7], length[1:, 7:] = at_parent[1:, None], at_child[1:, None]
    return length


@compiled
def _fit_residuals(parent, Y, z, w, v, va, factor, more, step):
    """``r - H dx`` of every slot with a meter but currents, (n, 10); of injections by the multipliers of the step."""
    n = len(parent)
    residual = np.zeros((n, 10))
    for i in range(n):
        for k in range(2):
            if w[i, 2 + k] > 0.0:
                residual[i, 2 + k] = -w[i, 2 + k] * step[i, k]
        vm = abs(v[i])
        residual[i, 0] = z[i, 0] - va[i] - step[i, 2]
        residual[i, 1] = z[i, 1] - vm - vm * step[i, 3]
        if i > 0:
            p = parent[i]
            own, at_parent = branch_powers(i, p, Y, v)
            p2 = v[p].real ** 2 + v[p].imag ** 2
            l0, l1, x0, x1 = step[p, 0], step[p, 1], step[p, 2], step[p, 3]
            f0 = factor[i, 18] - (factor[i, 8] * l0 + factor[i, 9] * l1 + factor[i, 10] * x0 + factor[i, 11] * x1)
            f1 = factor[i, 19] - (factor[i, 12] * l0 + factor[i, 13] * l1 + factor[i, 14] * x0 + factor[i, 15] * x1)
            residual[i, 4], residual[i, 5] = z[i, 4] - at_parent.real - f0, z[i, 5] - at_parent.imag - f1
            for k in range(7, 9):
                if w[i, k] > 0.0:
                    k0, k1, kx, h = row_of_branch(k, own, at_parent, vm, p2, coefficients_of(i, factor, more))
                    residual[i, k] = z[i, k] - h - (k0 * f0 + k1 * f1 + kx * x1)
    return residual
