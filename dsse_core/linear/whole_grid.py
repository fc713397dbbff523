"""Numerics of a whole grid: one area without neighbours, whose meters determine its state."""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Self

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.linear.area_measurements import NO_ROWS, AreaMeasurements
from dsse_core.linear.interface import Received
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows, order_of
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern

EXACT = 1e-12  # p.u.: sigma of exact rows in variances by reflections; what many of them determine has next to none


class GridRows(SparseRows):
    """Rows of a whole grid, found by compiled code where elimination is compiled; those at ``flat`` are kept.

    ``flat``: x of the flat start. ``at_flat``: the factor there for the last sigmas, which most meters keep from scan
    to scan.
    """

    def __init__(self, area: AreaMeasurements, flat: np.ndarray) -> None:
        super().__init__(area)
        self.flat, self.at_flat = flat, dict[bytes, AugmentedFactor]()
        _, H = self._linearized_at_flat = area.model.linearize(flat)
        self._kept.first = H, NO_ROWS
        self.is_compiled = self.pattern(H, area.free).is_compiled

    def _linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        return self._linearized_at_flat if x is self.flat else super()._linearize(x)

    def _predict(self, read: np.ndarray) -> np.ndarray:
        model = self._area.model
        return model.linearize_compiled(read, with_H=False)[0] if self.is_compiled else model.predict(read)

    def _find_entries(self, read: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        model = self._area.model
        return model.linearize_compiled(read) if self.is_compiled else model.linearize_entries(read)

    def _find_pattern(self, H: sp.csr_array, columns: np.ndarray, others: sp.csr_array | None) -> AugmentedPattern:
        """Pattern with the order of the network's buses; pivots are those that fill in least."""
        order = order_of(self._area, columns, others)
        return AugmentedPattern(H, columns, order=order.rows, fills_in=order.fills_in, blocks=order.blocks)


class GridSolver(TableauSolver):
    """Solver of a whole grid: nothing is damped, and virtual measurements hold exactly.

    Steps near the end are solved on the last factor, and compiled factors take the pivots of the flat start.
    """

    rows: GridRows

    def __init__(self, model: AreaMeasurements, flat: np.ndarray) -> None:
        super().__init__(model, GridRows(model, flat), "sparse")
        self._last: tuple[AugmentedFactor, np.ndarray] | None = None  # factor of the last step, and s of its solution
        self._found: tuple[bytes, AugmentedFactor] | None = None  # x, and its factor for variances and covariances
        self._reflecting: list[ReducedSolver] = []  # for variances with phases; one for all readings of the same meters

    def with_values(self, z: np.ndarray, sigma: np.ndarray, held_back: np.ndarray = NO_ROWS) -> Self:
        """Solver for other readings of the same meters but the rows ``held_back``, with no memory of a last step."""
        other = self.with_readings(self.model.with_values(z, sigma, held_back=held_back))
        other.rows, other._last, other._found = self.rows.copy(), None, None
        other.__dict__.pop("_by_reflections", None)
        return other

    @property
    def flat(self) -> np.ndarray:
        """x of the flat start."""
        return self.rows.flat

    @property
    def is_compiled(self) -> bool:
        """True where elimination is compiled."""
        return self.rows.is_compiled

    def least_information(self, columns: np.ndarray) -> np.ndarray:
        return np.zeros(len(columns))

    def stack(self, x: np.ndarray, received: Received) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
        H, r, sigma = super().stack(x, received)
        return (_without_rows(H, self.model.held_back) if self.model.held_back.size else H), r, sigma

    def step(self, x: np.ndarray, received: Received, damping: float = 0.0, *, nearby: bool = False) -> np.ndarray:
        """See ``LinearArea``; ``nearby``: the last step was so small that its factor may serve once more."""
        H, r, sigma = self.stack(x, received)
        free, found = self.model.free, None
        if nearby and self._last is not None:
            factor, s = self._last
            found = factor.solve_nearby(H, r, s)
        if found is None:
            factor = self._factor_at(x, H, sigma, np.full(len(free), damping))
            found = factor.solve(r, np.zeros(len(free)))
        self._last, dx = (factor, found[0]), np.zeros(self.model.size)
        dx[free] = found[1]
        return dx

    def _factor_at(self, x: np.ndarray, H: sp.csr_array, sigma: np.ndarray, damping: np.ndarray) -> AugmentedFactor:
        """Factor of the rows H at x in the columns ``free``; at the flat start that which is kept.

        Compiled factors use the pivots of the flat start for these sigmas if they serve, never those of an estimate
        before: the same readings have the same estimate, to the bit.
        """
        model, rows, free = self.model, self.rows, self.model.free
        is_flat = x is rows.flat and len(model.held_back) == len(model.currents)
        if not (is_flat or rows.is_compiled):
            return rows.factor(H, sigma, damping, free)
        key, kept = sigma.tobytes(), rows.at_flat
        if (found := kept.get(key)) is None:
            H_flat = H if is_flat else _without_rows(rows.jacobian(rows.flat), model.currents)
            found = rows.factor(H_flat, sigma, damping, free)
            _ = found.elimination  # before the memory of the former one goes back to the system: 15 % of an estimate
            kept.clear()
            kept[key] = found
        return found if is_flat else rows.factor(H, sigma, damping, free, found)

    def _factor_of(self, x: np.ndarray, received: Received) -> AugmentedFactor:
        """Factor of all that is known of the state x, found once for variances and covariances."""
        if self._found is None or self._found[0] != x.tobytes():
            H, _, sigma = self.stack(x, received)
            self._found = x.tobytes(), self._factor_at(x, H, sigma, self.least_information(self.model.free))
        return self._found[1]

    @cached_property
    def _by_reflections(self) -> ReducedSolver:
        """Solver by reflections for what is known of the state, in pieces that join each bus with its neighbours."""
        model = self.model
        if not self._reflecting:
            beside = build_admittance(model.area.network).ybus
            together = sp.csr_array(sp.hstack([beside, beside]))
            self._reflecting.append(ReducedSolver(model, self.rows, "pieces", together))
        sigma = np.where(model.virtual, EXACT, model.sigma)
        sigma[model.held_back] = np.inf
        solver = self._reflecting[0].with_readings(model.with_values(model.z, sigma))
        solver.rows = self.rows
        return solver

    @property
    def _has_phases(self) -> bool:
        """True where variances are found by reflections: covariances in place of their roots would lose digits."""
        return not self.model.area.network.table.nodes.is_balanced

    def variance_of_state(self, x: np.ndarray) -> np.ndarray:
        """diag(G^-1), shape (size,); nan where it would take too long."""
        of_state, free = np.zeros(self.model.size), self.model.free
        if self._has_phases:
            of_state[free] = self._by_reflections.variances(x, {})[0][free]
        else:
            of_state[free] = self._factor_of(x, {}).state_variance(limited=True)
        return of_state

    def variance_of_residuals(self, x: np.ndarray) -> np.ndarray:
        """diag(Omega), shape (n_meas,), 0 for virtual measurements.

        Where loops are so many and long that all would take too long, only those of the largest |r| / sigma are found,
        and the others are nan.
        """
        if self._has_phases:
            return self._by_reflections.variances(x, {})[1]
        model = self.model
        factor, r = self._factor_of(x, {}), abs(model.residual_of(self.rows.predict(x)))
        wanted = np.argsort(-np.divide(r, model.sigma, out=np.zeros(len(r)), where=~model.virtual), kind="stable")
        return model.real_part(factor.residual_variance(wanted))

    def read_by_pieces(self, x: np.ndarray, read: MeasurementModel) -> ReflectedCovariance:
        """Covariance of the state and of the readings of perfect meters by reflections."""
        B = sp.csr_array(sp.vstack([sp.eye_array(len(x), format="csr"), read.jacobian(x)]))
        return ReflectedCovariance(self._by_reflections, x, B)

    def read(self, x: np.ndarray, read: MeasurementModel, joined: tuple[np.ndarray, np.ndarray]) -> JointCovariance:
        """Covariance of the state and of the readings of perfect meters; ``joined``: the pairs that are asked for.

        A reading y = h(x) joins the tableau with the constraint ``H_y dx - dy = 0``. Elimination then finds its
        variance as that of a voltage, and not as a difference of large numbers. The other factors that are kept are
        dropped, as this one needs more memory than they.
        """
        self._last = self._found = None
        self.rows.at_flat.clear()
        (H, _, sigma), free, n_read = self.stack(x, {}), self.model.free, len(read.kinds)
        of_y = sp.eye_array(H.shape[0] + n_read, n_read, k=-H.shape[0])
        both = sp.csr_array(sp.hstack([sp.vstack([H, read.jacobian(x)]), -of_y], format="csr"))
        order, columns = order_of(self.model, free, None, read), np.append(free, self.model.size + np.arange(n_read))
        pairs = _place(columns, *joined)[1:]
        pattern = AugmentedPattern(
            both, columns, order=order.rows, fills_in=order.fills_in, blocks=order.blocks, joined=pairs
        )
        if order.blocks is None and not pattern.is_compiled:  # minimum degree of the whole tableau fills in less
            pattern = AugmentedPattern(both, columns)
        return JointCovariance(AugmentedFactor(both, np.append(sigma, np.zeros(n_read)), pattern=pattern), columns)


class ReflectedCovariance:
    """Covariance of the variables [va; vm; readings], functions ``B`` (:, size) of x; readings of one bus each."""

    def __init__(self, solver: ReducedSolver, x: np.ndarray, B: sp.csr_array) -> None:
        self._solver, self._x, self._B = solver, x, B

    def entries(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Covariance of the variables a[k] and b[k], (k,), of one bus or of one branch."""
        return self._solver.covariance_of_pairs(self._x, self._B, a, b)

    def of_sums(self, B: sp.csr_array) -> np.ndarray:
        """diag(B C B'), shape (k,), for ``B`` (k, n), C the covariance."""
        return self._solver.variance_of(self._x, sp.csr_array(B @ self._B))


class JointCovariance:
    """Covariance of the state and of readings: of the variables [va; vm; readings], those in ``columns`` unknown."""

    def __init__(self, factor: AugmentedFactor, columns: np.ndarray) -> None:
        self._factor, self._columns = factor, columns

    def entries(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Covariance of the variables a[k] and b[k], (k,); nan where it would take too long."""
        unknown, *at = _place(self._columns, a, b)
        found = np.zeros(len(a))
        found[unknown] = self._factor.covariance_at(*at)
        return found

    def of_sums(self, B: sp.csr_array) -> np.ndarray:
        """diag(B C B'), shape (k,), for ``B`` (k, n), C the covariance; nan where it would take too long."""
        return self._factor.variance_of_sums(B[:, self._columns])


def _place(columns: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pairs of variables a[k], b[k] that are both in ``columns``, and the places of these variables there."""
    place = np.full(columns[-1] + 1, -1)
    place[columns] = np.arange(len(columns))
    unknown = np.flatnonzero((place[a] >= 0) & (place[b] >= 0))
    return unknown, place[a[unknown]], place[b[unknown]]


def _without_rows(H: sp.csr_array, rows: np.ndarray) -> sp.csr_array:
    """H of the same pattern, with entries of 0 in some ``rows``."""
    found = copy.copy(H)
    found.data = H.data.copy()
    for row in rows.tolist():
        found.data[H.indptr[row] : H.indptr[row + 1]] = 0.0
    return found
