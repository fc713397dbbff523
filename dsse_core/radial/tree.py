"""A tree with readings: its step and variances, of the centre or of an area with the messages of its neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from dsse_core.grid.boundary import D_SINGLE
from dsse_core.radial.boundary import N_MESSAGE, pass_upward, step_downward, variances_downward
from dsse_core.radial.iteration import store
from dsse_core.radial.kernel import Work, absent
from dsse_core.radial.plan import N_SLOT, RadialPlan

NO_BOUNDARY = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Tree:
    """The tree of ``plan`` with readings ``z`` and weights ``w``, (n_bus, N_SLOT) each, and memory for its passes.

    ``v``, ``va``: the state of the last pass, tree order. ``at``, ``column`` (k,): of each neighbour, see
    ``boundary.pass_upward``; ``role`` (k,), ``R`` (k, d, d), ``message_z`` (k, d): its message, which the caller fills.
    """

    plan: RadialPlan
    z: np.ndarray
    w: np.ndarray
    v: np.ndarray
    va: np.ndarray
    work: Work
    at: np.ndarray
    column: np.ndarray
    role: np.ndarray
    R: np.ndarray
    message_z: np.ndarray
    message_of: np.ndarray

    @classmethod
    def of(cls, plan: RadialPlan, at: np.ndarray = NO_BOUNDARY, column: np.ndarray = NO_BOUNDARY) -> Self:
        """The tree of ``plan`` without readings."""
        n, k = len(plan.order), len(at)
        v, role, d = np.empty(n, dtype=complex), np.zeros(k, dtype=np.int64), D_SINGLE
        messages = np.zeros((k, d, d)), np.zeros((k, d)), np.zeros((k, N_MESSAGE))
        return cls(plan, np.zeros((n, N_SLOT)), absent(n), v, np.empty(n), Work.of(n), at, column, role, *messages)

    def read(self, values: np.ndarray, sigmas: np.ndarray) -> Self:
        """The tree with other readings, (n_meas,), exact where sigma is 0; both have the memory of the passes."""
        z, w = np.zeros_like(self.z), np.empty_like(self.w)
        store(self.plan.meter, sigmas == 0, values, sigmas, z, w)
        return replace(self, z=z, w=w)

    def go_up(self, x: np.ndarray, mode: int, damping: tuple[float, float], least: tuple[float, float]) -> bool:
        """``pass_upward`` at x = [va; vm; powers into children], network order; ``least``: of flow and of spread."""
        plan = self.plan
        enough: bool = pass_upward(
            plan.order, plan.parent, plan.admittance, self.z, self.w, mode, self.at, self.column, self.role, self.R,
            self.message_z, x, damping, *least, self.v, self.va, self.message_of, *self.work,
        )  # fmt: skip
        return enough

    def step(self, angle_given: bool, size: int) -> np.ndarray | None:
        """The step of all variables, (size,), after ``go_up``; None where it is not finite."""
        dx = np.empty(size)
        return dx if step_downward(*self._at_root(), angle_given, dx) else None

    def variances(self, angle_given: bool, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        """Variances of all variables, (size,), and ``variances_downward``, after ``go_up``."""
        variance = np.empty(size)
        omega, S, enough = variances_downward(*self._at_root(), angle_given, variance)
        return variance, omega, S, enough

    def _at_root(self) -> tuple[np.ndarray, ...]:
        plan = self.plan
        of_area = self.at, self.column, self.v, self.va, self.message_of
        return plan.order, plan.parent, plan.admittance, self.z, self.w, *of_area, *self.work
