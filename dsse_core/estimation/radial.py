"""The estimate of radial networks by elimination on the tree; see ``radial_kernel``."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import ModuleType

import numpy as np

from dsse_core.errors import EstimationDivergedError
from dsse_core.estimation.decision import Memory, begin_at_flat_start, most_steps
from dsse_core.estimation.radial_threads import estimate_on_threads
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit
from dsse_core.gauss_newton import Solution
from dsse_core.grid.measurement import check_readings
from dsse_core.radial.plan import N_SLOT, RadialPlan


def estimate_radial(
    plan: RadialPlan,
    exact: np.ndarray,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    memory: Memory,
    threads: int = 1,
) -> tuple[Memory, Solution]:
    """What ``estimate_sparse`` finds. ``sigmas`` (n_meas,) become 0 where a reading is ``exact``.

    For small networks calls made in Python take longer than solving, so that what ``decide`` says between two steps is
    compiled with them; that both come to the same is tested. On more than one thread it is said in Python again.

    Raises:
        InvalidInputError: readings that cannot be.
        EstimationDivergedError: names the measurement with the largest weighted residual.
    """
    compiled, n = _load_compiled(), len(plan.order)
    state, residual, space = np.empty((2, n)), np.empty(len(values)), plan.take_space()
    limit = chi_square_limit(len(values) - (2 * n - 1), CONFIDENCE)
    while True:
        v, va = _begin_at(plan, None if memory.from_flat_start else start)
        options = float(tolerance), most_steps(memory), limit
        if threads > 1:
            scan = exact, values, sigmas
            end, steps, step, objective = estimate_on_threads(
                plan, *scan, space, v, va, *options, state, residual, threads
            )
        else:
            end, steps, step, objective = compiled.estimate(
                plan.parent, plan.level, plan.admittance, plan.order, plan.slot, exact, v, va, plan.has_currents,
                *options, values, sigmas, space, state, residual,
            )  # fmt: skip
        if end == compiled.UNUSABLE:
            check_readings(plan.network, plan.meters, values, sigmas)
        if end != compiled.LOST or memory.from_flat_start:
            break
        memory = begin_at_flat_start(memory)
    plan.spaces.append(space)
    if end == compiled.LOST:
        weighted = abs(residual) / np.where(sigmas > 0, sigmas, np.inf)
        worst = int(np.argmax(weighted))
        raise EstimationDivergedError(steps, step, str(plan.meters[worst]), float(weighted[worst]))
    if end == compiled.EVALUATE and not memory.kept:
        memory = replace(memory, evaluating=True)
    return memory, (state[0], state[1], residual, objective, steps)


def _begin_at(plan: RadialPlan, start: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
    """Voltages and their angles in tree order, (n_bus,); the flat start without ``start``."""
    if start is None:
        return plan.start, plan.start_va
    va = np.array(start[1], dtype=float)[plan.order]
    return np.asarray(start[0])[plan.order] * np.exp(1j * va), va


@cache
def _load_compiled() -> ModuleType:
    """What needs numba; an import statement takes longer, every time, than to look it up here."""
    from dsse_core.radial import iteration as radial_iteration

    return radial_iteration


def find_radial_variances(
    plan: RadialPlan, sigmas: np.ndarray, vm: np.ndarray, va: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """diag of the covariance of x = [va; vm], shape (2 n_bus,), network order, and diag(Omega), (n_meas,)."""
    from dsse_core.radial import inverse as radial_inverse
    from dsse_core.radial import iteration as radial_iteration
    from dsse_core.radial import kernel as radial_kernel

    n = len(vm)
    z, w, v, va_in_order = np.zeros((n, N_SLOT)), radial_kernel.absent(n), np.empty(n, dtype=complex), np.empty(n)
    radial_inverse.turn_to_radial_order(plan.order, vm, va, v, va_in_order)
    radial_iteration.store(plan.slot, sigmas, sigmas, z, w)  # whatever was read
    work = radial_kernel.Work.of(n)
    radial_kernel.eliminate(plan.parent, plan.admittance, z, w, v, va_in_order, True, radial_kernel.INVERT, *work)
    in_order, omega, _ = radial_inverse.find_variances(plan.parent, plan.admittance, w, v, *work[2:5], True)
    state = np.empty((2, n))
    state[:, plan.order] = in_order.T
    return state.ravel(), omega.ravel()[plan.slot]
