"""The estimate of radial networks by elimination on the tree; see ``radial.kernel``."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np

from dsse_core.estimation.decision import (
    DIVERGED,
    OUT_OF_REACH,
    IterationLostError,
    Memory,
    begin_at_flat_start,
)
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit
from dsse_core.gauss_newton import EVALUATE, LARGEST_STEP, LOST, MOST_STEPS, Solution
from dsse_core.grid.measurement import check_readings
from dsse_core.radial.plan import RadialPlan


def estimate_radial(
    plan: RadialPlan,
    exact: np.ndarray,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    memory: Memory,
) -> tuple[Memory, Solution]:
    """Memory and solution of a scan, as ``estimate_sparse`` finds them, by elimination on the tree.

    ``sigmas`` (n_meas,) become 0 where a reading is ``exact``. For small networks Python calls take longer than
    solving, so the rules of ``decide`` between two steps are compiled with the steps; a test compares the two.

    Raises:
        InvalidInputError: unusable readings.
        IterationLostError: the iteration has no end.
    """
    compiled, n = _load_compiled(), len(plan.order)
    state, residual, space = np.empty((2, n)), np.empty(len(values)), plan.take_space()
    limit = chi_square_limit(len(values) - (2 * n - 1), CONFIDENCE)
    try:
        while True:
            v, va = _begin_at(plan, None if memory.from_flat_start else start)
            options = float(tolerance), MOST_STEPS, limit
            end, steps, step, objective = compiled.estimate(
                plan.parent, plan.level, plan.admittance, plan.order, plan.meter, exact, v, va,
                plan.has_currents, *options, values, sigmas, space, state, residual,
            )  # fmt: skip
            if end == compiled.UNUSABLE:
                check_readings(plan.network, plan.meters, values, sigmas)
            if end != LOST or memory.from_flat_start:
                break
            memory = begin_at_flat_start(replace(memory, steps=steps))
    finally:
        plan.spaces.append(space)
    if end == LOST:
        is_far = steps < MOST_STEPS and step <= LARGEST_STEP
        weighted = abs(residual) / np.where(sigmas > 0, sigmas, np.inf)
        raise IterationLostError(steps, step, weighted, OUT_OF_REACH if is_far else DIVERGED)
    memory = replace(memory, steps=steps - 1, evaluating=end == EVALUATE and not memory.kept)  # the last does not count
    return memory, (state[0], state[1], residual, objective, steps)


def _begin_at(plan: RadialPlan, start: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
    """Voltages and their angles in tree order, (n_bus,); the flat start without ``start``."""
    if start is None:
        return plan.start, plan.start_va
    va = np.array(start[1], dtype=float)[plan.order]
    return np.asarray(start[0])[plan.order] * np.exp(1j * va), va


@cache
def _load_compiled() -> ModuleType:
    """Module of compiled code, loaded with numba once; an import statement in each call would take longer."""
    from dsse_core.radial import iteration as radial_iteration

    return radial_iteration


class RadialInverse(NamedTuple):
    """The selected inverse of a tree, in tree order; ``radial.kernel`` defines the letters.

    ``weights`` (n_bus, 10): variances of injections, -1 without a meter, and weights of other meters. ``factor``
    (n_bus, 24), ``more`` (n_bus, 9): the factors of ``kernel.eliminate``, 0 at the root. ``S`` (n_bus, 4, 4): blocks of
    the inverse at (lam, x). ``omega`` (n_bus, 10): variances of the residuals. ``variance`` (2 n_bus,): of
    x = [va; vm], network order.
    """

    weights: np.ndarray
    factor: np.ndarray
    more: np.ndarray
    S: np.ndarray
    omega: np.ndarray
    variance: np.ndarray


def invert_radial(plan: RadialPlan, sigmas: np.ndarray, vm: np.ndarray, va: np.ndarray) -> RadialInverse:
    """Selected inverse of the information of meters with ``sigmas`` (n_meas,) at vm, va (n_bus,), network order."""
    from dsse_core.radial.kernel import INVERT
    from dsse_core.radial.tree import Tree

    tree = Tree.of(plan).read(np.zeros(len(sigmas)), sigmas)
    tree.go_up(np.concatenate([va, vm]), INVERT, (0.0, 0.0), (0.0, 0.0))
    variance, omega, S, _ = tree.variances(True, 2 * len(vm))
    tree.work.factor[0] = 0.0
    return RadialInverse(tree.w, tree.work.factor, tree.work.more, S, omega, variance)


def find_radial_variances(plan: RadialPlan, inverse: RadialInverse) -> tuple[np.ndarray, np.ndarray]:
    """diag of the covariance of x = [va; vm], shape (2 n_bus,), network order, and diag(Omega), (n_meas,)."""
    return inverse.variance, inverse.omega.ravel()[plan.slot]
