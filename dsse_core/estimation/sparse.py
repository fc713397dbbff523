"""The estimate of any network by sparse factorisation of the tableau; all that depends on topology is found once."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.estimation.decision import (
    DIVERGED,
    Decision,
    IterationLostError,
    Memory,
    Totals,
    Verdict,
    begin_at_flat_start,
    decide,
)
from dsse_core.gauss_newton import LARGEST_STEP, Solution
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.network import Network
from dsse_core.grid.radial_order import order_tableau
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern

SMALL_STEP = 0.02  # p.u. and rad; after a smaller one the last factor may serve once more


@dataclass(frozen=True, repr=False)
class SparsePlan:
    """Plan of the sparse back end for scans of ``meters``.

    ``free``: the state variables but the reference angle. ``entries``: the entries of the model's H in the columns
    ``free``. ``empty`` (n_meas, n_free): the pattern of these entries. ``start``: x = [va; vm] of the flat start with
    the reference's angle. ``at_start``: the factor there for the last sigmas, which most meters keep from scan to scan.
    """

    meters: Sequence[Meter]
    model: MeasurementModel
    free: np.ndarray
    entries: np.ndarray
    empty: sp.csr_array
    pattern: AugmentedPattern
    start: np.ndarray
    at_start: dict[bytes, AugmentedFactor] = field(default_factory=dict, compare=False)

    def __repr__(self) -> str:
        return f"<SparsePlan: {len(self.meters)} meters, {len(self.free)} state variables>"

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        """h(x), (n_meas,), and the columns ``free`` of H(x); those at ``start`` itself are kept."""
        h, data = self._at_flat_start if x is self.start else self._find_h_and_entries(x)
        H = copy.copy(self.empty)  # a new one would have its indices checked each time
        H.data = data.copy() if x is self.start else data
        return h, H

    @cached_property
    def _at_flat_start(self) -> tuple[np.ndarray, np.ndarray]:
        return self._find_h_and_entries(self.start)

    def _find_h_and_entries(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.pattern.is_compiled:
            return self.model.linearize_compiled(x, self._places)
        h, whole = self.model.linearize(x)
        return h, whole.data[self.entries]

    @cached_property
    def _places(self) -> np.ndarray:
        return self.model.places_of(self.entries)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), (n_meas,)."""
        if self.pattern.is_compiled:
            return self.model.linearize_compiled(x, self._places[:0])[0]
        return self.model.predict(x)

    @cached_property
    def currents(self) -> np.ndarray:
        """Positions of the meters of current magnitudes."""
        return np.flatnonzero(self.model.kinds == MeasurementKind.CURRENT)

    def factor(self, H: sp.csr_array, sigmas: np.ndarray, *, at_start: bool = False) -> AugmentedFactor:
        """Factor for H; ``at_start``: H is that of the flat start without currents, whose factor is kept.

        Compiled factors use the pivots of the flat start for these sigmas if they serve, never those of an estimate
        before: the same readings have the same estimate, to the bit.
        """
        if not at_start and not self.pattern.is_compiled:
            return AugmentedFactor(H, sigmas, pattern=self.pattern)
        key = sigmas.tobytes()
        if (kept := self.at_start.get(key)) is None:
            kept = AugmentedFactor(H if at_start else self._linearize_at_start(), sigmas, pattern=self.pattern)
            self.at_start.clear()
            self.at_start[key] = kept
        return kept if at_start else AugmentedFactor(H, sigmas, pattern=self.pattern, nearby=kept)

    def _linearize_at_start(self) -> sp.csr_array:
        H = self.linearize(self.start)[1]
        H.data[np.isin(self.pattern.row, self.currents)] = 0.0
        return H


def build_sparse_plan(network: Network, meters: Sequence[Meter], reference: int) -> SparsePlan:
    """Plan for ``meters`` that fit the network and determine its state."""
    model = build_measurement_model(network, build_admittance(network), meters)
    vm, va = flat_start(network, reference)
    given = network.slack.va if network.slack and network.slack.bus == reference else 0.0
    start = np.concatenate([va + given, vm])
    fixed, H = network.row[reference], model.jacobian(start)
    free = np.delete(np.arange(len(start)), fixed)
    entries = np.flatnonzero(H.indices != fixed)
    indices = H.indices[entries] - (H.indices[entries] > fixed)
    indptr = np.searchsorted(entries, H.indptr)
    reduced = sp.csr_array((H.data[entries], indices, indptr), shape=(len(meters), len(free)))
    order = order_tableau(network, reference, model, free)
    pattern = AugmentedPattern(reduced, order.rows, fills_in=order.fills_in, blocks=order.blocks)
    return SparsePlan(meters, model, free, entries, reduced, pattern, start)


def estimate_sparse(
    plan: SparsePlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None,
    tolerance: float,
    memory: Memory,
) -> tuple[Memory, Solution]:
    """Memory and solution of a scan: Gauss-Newton until the verdict is ``FINAL`` or ``EVALUATE``.

    ``sigmas`` (n_meas,) are 0 where a reading holds exactly.

    Raises:
        IterationLostError: the iteration has no end.
    """
    grid, removed = SparseIteration(plan, values, sigmas, start, from_flat_start=memory.from_flat_start), memory.removed
    while True:
        memory, verdict = decide(memory, grid.totals(), tolerance)
        if verdict.reason or memory.removed != removed:  # the plan's meters have no estimate
            raise grid.diverged(verdict.reason)
        grid.carry_out(verdict)
        if verdict.decision not in (Decision.EVALUATE, Decision.FINAL):
            continue
        if not grid.is_lost:
            return memory, grid.solution()
        if memory.from_flat_start:
            raise grid.diverged()
        memory = begin_at_flat_start(memory)
        grid.carry_out(Verdict(Decision.ANEW))


class SparseIteration:
    """The whole grid as one area without neighbours: states its totals, and carries out verdicts.

    ``x``: the state x_k = [va; vm], (2 n_bus,), p.u. and rad. Steps are solved with the tableau of ``augmented``, on
    the last factor where that serves.
    """

    def __init__(
        self,
        plan: SparsePlan,
        values: np.ndarray,
        sigmas: np.ndarray,
        start: tuple[np.ndarray, np.ndarray] | None,
        *,
        from_flat_start: bool = False,
    ) -> None:
        self._plan, self._values, self._sigmas = plan, values, sigmas
        self._start = plan.start if start is None or from_flat_start else np.concatenate([start[1], start[0]])
        self._weight = np.where(sigmas > 0, 1 / np.where(sigmas > 0, sigmas, 1.0), 0.0)
        self._currents = plan.currents
        self._of_currents = np.flatnonzero(np.isin(plan.pattern.row, self._currents))
        self._factor: AugmentedFactor | None = None
        self._size = 0.0, 0.0  # the largest entries of the last step, dva and dvm
        self._begin()

    def _begin(self) -> None:
        self.x = self._before = self._start
        self._forget_step()
        self._steps = 0
        self._held_back = len(self._currents)
        self._multipliers = np.zeros(len(self._sigmas))
        self._linearized: tuple[np.ndarray, sp.csr_array] | None = None  # r and H at x

    @property
    def is_lost(self) -> bool:
        """True where the last step has led to no state, or no step could be solved for."""
        return not max(self._size) <= LARGEST_STEP

    def totals(self) -> Totals:
        dva, dvm = self._size
        return Totals(
            objective=np.inf if self.is_lost else self._find_objective(self._linearize()[0]),
            degrees_of_freedom=len(self._values) - self._held_back - len(self._plan.free),
            dvm=dvm,
            dva=dva,
            held_back=self._held_back,
            areas=1,
            referenced=True,
        )

    def _linearize(self) -> tuple[np.ndarray, sp.csr_array]:
        """Residual and H at x of the meters in use; rows of 0 of the others."""
        if self._linearized is None:
            h, H = self._plan.linearize(self.x)
            r = self._plan.model.subtract(self._values, h)
            if self._held_back:
                H.data[self._of_currents] = 0.0
                r[self._currents] = 0.0
            self._linearized = r, H
        return self._linearized

    def _find_objective(self, r: np.ndarray) -> float:
        """J of residuals r, (n_meas,); readings that hold exactly do not count."""
        weighted = r * self._weight
        return float(weighted @ weighted)

    def carry_out(self, verdict: Verdict) -> None:
        if verdict.takes_step:
            self._take_step(verdict.share)
        match verdict.decision:
            case Decision.SHORTEN:
                self._move(verdict.share)
                self._forget_step()
            case Decision.USE_CURRENTS:
                self._held_back, self._linearized = 0, None
                self._forget_step()
            case Decision.ANEW:
                self._start = self._plan.start
                self._begin()

    def _take_step(self, share: float) -> None:
        try:
            self._step = self._solve()
        except RuntimeError:  # SuperLU: singular away from the no-load state, where the rank was full
            self._steps, self._before, self._size = self._steps + 1, self.x, (np.inf, np.inf)
            return
        size, n_angles = abs(self._step), len(self.x) // 2 - 1
        self._size = float(size[:n_angles].max(initial=0.0)), float(size[n_angles:].max(initial=0.0))
        if not math.isfinite(sum(self._size)):
            self._size = np.inf, np.inf
        self._steps, self._before = self._steps + 1, self.x
        self._move(share)

    def _forget_step(self) -> None:
        """Drops the last step and its factor: the next steps are not compared with it, nor solved on its factor."""
        self._step, self._size, self._factor = np.zeros(len(self._plan.free)), (0.0, 0.0), None

    def _move(self, share: float) -> None:
        """Moves x by ``share`` of the last step from the state where that began."""
        self.x, self._linearized = self._before.copy(), None
        self.x[self._plan.free] += share * self._step

    def _solve(self) -> np.ndarray:
        """The step dx, (n_free,)."""
        r, H = self._linearize()
        found = None
        if self._factor and max(self._size) < SMALL_STEP:
            found = self._factor.solve_nearby(H, r, self._multipliers)
        if found is None:
            self._factor = self._plan.factor(H, self._sigmas, at_start=self.x is self._plan.start)
            found = self._factor.solve(r, np.zeros(H.shape[1]))
        self._multipliers, dx = found
        return dx

    def solution(self) -> Solution:
        va, vm = np.split(self.x, 2)
        r = self._plan.model.subtract(self._values, self._plan.predict(self.x))
        return vm, va, r, self._find_objective(r), self._steps

    def diverged(self, reason: str = DIVERGED) -> IterationLostError:
        """The error for an iteration that has stopped here."""
        r = self._plan.model.subtract(self._values, self._plan.predict(self._before))
        return IterationLostError(self._steps, max(self._size), abs(r) * self._weight, reason)
