"""Numerics of an area from its rows; with sparse rows by one factor of the augmented system for each result."""

from __future__ import annotations

import copy
from collections import Counter
from typing import Self, cast

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.boundary import Kind
from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import NO_ROWS, AreaMeasurements
from dsse_core.linear.boundary_information import (
    NOTHING_OF_VOLTAGE,
    BoundaryInformation,
    factor_information,
    factor_inverse,
    put_together,
)
from dsse_core.linear.interface import NOT_YET, NOT_YET_OF_POWER, LinearArea, Matrix, Received, Rows
from dsse_core.linear.sparse import SparseRows, order_of
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern

MOST_TURNS = 4  # axes of (p, q) that are tried, the first ones included


class RowSolver(LinearArea):
    """Solver on all rows of an area: own measurements, further rows, messages; ``rows``: h and H of ``model``."""

    def __init__(self, model: AreaMeasurements, rows: Rows, name: str) -> None:
        self.name = name
        self.declined = Counter()
        self.model, self.rows = model, rows
        n_voltage = 2 * len(model.area.network.buses)
        self._least = np.where(np.arange(model.size) < n_voltage, NOT_YET, NOT_YET_OF_POWER)

    def with_readings(self, model: AreaMeasurements) -> Self:
        other = copy.copy(self)
        other.model = model
        return other

    def least_information(self, columns: np.ndarray) -> np.ndarray:
        """The damping of variables that nothing determines yet, shape of ``columns``."""
        return np.asarray(self._least[columns])

    def stack(self, x: np.ndarray, received: Received) -> tuple[Matrix, np.ndarray, np.ndarray]:
        """H, residual and sigma of the area's own measurements, its further rows, and the messages ``received``."""
        rows, further = self.rows, [rows.at(x) for rows in self.model.further]
        own, of_own = self.model.rows_where(rows.predict(x))
        messages, of_messages = rows.messages(x, received)
        if not (further or messages):
            return rows.jacobian(x), own, of_own
        r = np.concatenate([own, *(part.residual for part in further), *of_messages])
        sigma = np.ones(len(r))
        of_own = np.concatenate([of_own, *(part.sigma for part in further)])
        sigma[: len(of_own)] = of_own
        return rows.join([rows.jacobian(x), *(rows.take(part.H) for part in further), *messages]), r, sigma


class TableauSolver(RowSolver):
    """Solver by sparse factors of the augmented system, on ``SparseRows``.

    Where the meters of a whole grid determine its state, steps near the end are solved on the last factor, and compiled
    factors take the pivots of the flat start.
    """

    rows: SparseRows

    nothing_of_voltage = NOTHING_OF_VOLTAGE

    def __init__(self, model: AreaMeasurements, rows: SparseRows, name: str) -> None:
        super().__init__(model, rows, name)
        self._last: tuple[AugmentedFactor, np.ndarray] | None = None  # factor of the last step, and s of its solution
        self._found: tuple[bytes, AugmentedFactor] | None = None  # x, and its factor for variances and covariances

    def with_readings(self, model: AreaMeasurements) -> Self:
        other = super().with_readings(model)
        other._last = other._found = None
        return other

    def with_values(self, z: np.ndarray, sigma: np.ndarray, held_back: np.ndarray = NO_ROWS) -> Self:
        """Solver for other readings of the same meters, with no memory of a last step."""
        other = self.with_readings(self.model.with_values(z, sigma, held_back=held_back))
        other.rows = self.rows.copy()
        return other

    @property
    def flat(self) -> np.ndarray:
        """x of the flat start of a whole grid."""
        assert self.model.flat is not None
        return self.model.flat

    @property
    def is_compiled(self) -> bool:
        """True where elimination is compiled."""
        return self.rows.is_compiled

    def least_information(self, columns: np.ndarray) -> np.ndarray:
        return super().least_information(columns) if self.model.flat is None else np.zeros(len(columns))

    def stack(self, x: np.ndarray, received: Received) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
        self.rows.jacobian(x)  # which finds h(x) in passing
        H, r, sigma = super().stack(x, received)
        H = cast("sp.csr_array", H)
        return (without_rows(H, self.model.held_back) if self.model.held_back.size else H), r, sigma

    def prepare(self, x: np.ndarray) -> None:
        self.rows.jacobian(x)

    def step(self, x: np.ndarray, received: Received, damping: float = 0.0, *, nearby: bool = False) -> np.ndarray:
        """See ``LinearArea``; ``nearby``: the last step was so small that its factor may serve once more."""
        H, r, sigma = self.stack(x, received)
        free, found = self.model.free, None
        if nearby and self._last is not None:
            factor, s = self._last
            found = factor.solve_nearby(self.rows.structure(H, free).take(H), r, s)
        if found is None:
            least = self.least_information(free)
            factor = self._factor_at(x, H, sigma, np.maximum(least, damping) if damping else least)
            found = factor.solve(r, np.zeros(len(free)))
        if self.model.flat is not None:
            self._last = factor, found[0]
        dx = np.zeros(self.model.size)
        dx[free] = found[1]
        return dx

    def _factor_at(self, x: np.ndarray, H: sp.csr_array, sigma: np.ndarray, least: np.ndarray) -> AugmentedFactor:
        """Factor of the rows H at x in the columns ``free``; at the flat start that which is kept.

        Compiled factors use the pivots of the flat start for these sigmas if they serve, never those of an estimate
        before: the same readings have the same estimate, to the bit.
        """
        model, rows, free = self.model, self.rows, self.model.free
        is_flat = x is model.flat and len(model.held_back) == len(model.currents)
        if model.flat is None or not (is_flat or rows.is_compiled):
            return rows.factor(H, sigma, least, free)
        key, kept = sigma.tobytes(), rows.kept.at_flat
        if (found := kept.get(key)) is None:
            H_flat = H if is_flat else without_rows(rows.jacobian(model.flat), model.currents)
            found = rows.factor(H_flat, sigma, least, free)
            kept.clear()
            kept[key] = found
        return found if is_flat else rows.factor(H, sigma, least, free, found)

    def variances(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, np.ndarray]:
        factor = self._factor_of(x, received)
        return self._variance_of_state(factor), self._variance_of_residuals(factor, x)

    def variance_of_state(self, x: np.ndarray) -> np.ndarray:
        """diag(G^-1) of a whole grid, shape (size,), see ``variances``; nan where it would take too long."""
        return self._variance_of_state(self._factor_of(x, {}))

    def variance_of_residuals(self, x: np.ndarray) -> np.ndarray:
        """diag(Omega) of a whole grid, shape (n_meas,), see ``variances``.

        Where loops are so many and long that all would take too long, only those of the largest |r| / sigma are found,
        and the others are nan.
        """
        return self._variance_of_residuals(self._factor_of(x, {}), x)

    def _variance_of_state(self, factor: AugmentedFactor) -> np.ndarray:
        of_state = np.zeros(self.model.size)
        of_state[self.model.free] = factor.state_variance(limited=self.model.flat is not None)
        return of_state

    def _variance_of_residuals(self, factor: AugmentedFactor, x: np.ndarray) -> np.ndarray:
        model, wanted = self.model, None
        if model.flat is not None:
            r = abs(model.residual_of(self.rows.predict(x)))
            wanted = np.argsort(-np.divide(r, model.sigma, out=np.zeros(len(r)), where=~model.virtual), kind="stable")
        return model.real_part(factor.residual_variance(wanted)[: len(model.z)])

    def covariance(self, x: np.ndarray, received: Received, B: np.ndarray) -> np.ndarray:
        B = B[:, self.model.free]
        return np.asarray(B @ self._factor_of(x, received).covariance_times(B.T))

    def _factor_of(self, x: np.ndarray, received: Received) -> AugmentedFactor:
        """Factor of all that is known of the state x; without messages found once for variances and covariances."""
        at = x.tobytes()
        if self._found is None or self._found[0] != at or received:
            H, _, sigma = self.stack(x, received)
            factor = self._factor_at(x, H, sigma, self.least_information(self.model.free))
            if received:
                return factor
            self._found = at, factor
        return self._found[1]

    def factor_with(self, x: np.ndarray, received: Received, read: MeasurementModel) -> AugmentedFactor:
        """Factor with the readings of perfect meters as further variables, after those in ``free``.

        A reading y = h(x) joins the tableau with the constraint ``H_y dx - dy = 0``. Elimination then finds its
        variance as that of a voltage, and not as a difference of large numbers. The other factors that are kept are
        dropped, as this one needs more memory than they.
        """
        self._last = self._found = None
        self.rows.kept.at_flat.clear()
        H, _, sigma = self.stack(x, received)
        free, n_read = self.model.free, len(read.kinds)
        known, of_x = H[:, free], read.jacobian(x[: 2 * len(self.model.area.network.buses)])
        of_x.resize(n_read, self.model.size)
        of_y = sp.eye_array(H.shape[0] + n_read, n_read, k=-H.shape[0])
        both = sp.csr_array(sp.hstack([sp.vstack([known, of_x[:, free]]), -of_y], format="csr"))
        others = known[len(self.model.z) :] if H.shape[0] > len(self.model.z) else None
        order, pattern = order_of(self.model, free, others, read), None
        if order.blocks is not None:  # with loops minimum degree of the whole tableau fills in less
            pattern = AugmentedPattern(both, order.rows, blocks=order.blocks)
        least = np.concatenate([self.least_information(free), np.zeros(n_read)])
        return AugmentedFactor(both, np.concatenate([sigma, np.zeros(n_read)]), least, pattern)

    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        """Information for ``neighbour``: every variable but y eliminated, the neighbour's own message left out.

        The information has two parts, each a 2x2 matrix that no rounding of the other part can spoil. The first part is
        about the boundary's voltage v = (vm_b, va_b), whatever power flows. With u all variables but v and
        ``K = [[R, H_u], [H_u', -d]]`` it is ``M = B' s`` and ``g = B' s_r``, from ``K [s, .] = [B, 0]`` and
        ``K [s_r, .] = [r, 0]``. The second part is about the power given v:
        ``(p, q) = y_p + C du_r + (dp - C du_B) dv`` with covariance ``C G_uu^-1 C'`` (``_find_power``). ``B`` and
        ``dp`` are the responses of measurements and power when v moves and takes the whole area along
        (``_responses_to_shift``).
        """
        received = {name: message for name, message in received.items() if name != neighbour.area}
        H, r, sigma = self.stack(x, received)
        B, dp = _responses_to_shift(self.model, self.rows, x, neighbour, received, H)
        y, T = self.rows.boundary(x, neighbour)
        u = self.model.eliminated[neighbour.area]
        C = T[:2, u]
        factor = self.factor(H, sigma, u)
        above, below = np.zeros((len(r), 5)), np.zeros((len(u), 5))
        above[:, :2], above[:, 2], below[:, 3:] = B, r, C.toarray().T
        s, du = factor.solve(above, below)
        information = B.T @ s[:, :3]
        N, z_of_voltage = factor_information(information[:, :2], information[:, 2], self.nothing_of_voltage)
        W, S, A = _find_power(factor, C, s[:, 3:], du[:, 3:])
        P = factor_inverse(S)
        return put_together(y, P @ W.T, P @ (A.T @ B - W.T @ dp), P @ (A.T @ r), (N, z_of_voltage))

    def factor(self, H: Matrix, sigma: np.ndarray, columns: np.ndarray) -> AugmentedFactor:
        """Factor of the ``columns`` of H, with the damping of ``least_information``."""
        return self.rows.factor(H, sigma, self.least_information(columns), columns)


def without_rows(H: sp.csr_array, rows: np.ndarray) -> sp.csr_array:
    """H of the same pattern, with entries of 0 in some ``rows``."""
    found = copy.copy(H)
    found.data = H.data.copy()
    for row in rows.tolist():
        found.data[H.indptr[row] : H.indptr[row + 1]] = 0.0
    return found


def _find_power(
    factor: AugmentedFactor, C: Matrix, A: np.ndarray, du: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information about (p, q), with v given: W, S, (2, 2), and A, (rows, 2).

    S is the covariance of ``W'(p, q)``, and ``W'C du = A'r`` for residuals r. W turns the axes, so that both
    combinations of p and q are solved for by themselves; beside a combination that is as good as unknown the other one
    would drown in rounding. ``A``, ``du``: the solution for W = 1.
    """
    W = np.eye(2)
    for turn in range(MOST_TURNS):
        S = -(W.T @ (C @ du))
        S = (S + S.T) / 2
        if turn == MOST_TURNS - 1 or S[0, 1] ** 2 <= abs(S[0, 0] * S[1, 1]) / 2:
            break
        W = W @ np.linalg.svd(S)[0]
        A, du = factor.solve(np.zeros(A.shape), C.T @ W)
    return W, S, A


def shift_of_own_rows(model: AreaMeasurements, rows: Rows, x: np.ndarray, H: Matrix) -> np.ndarray:
    """Responses of the area's own and further rows, H of ``stack``, to growth and turn of all voltages, shape (:, 2).

    Growth scales all voltages of the area alike, and turn turns all its angles (but a reference). Powers respond with
    2 s and 0 exactly. Moving one bus alone would change flows by dv / z; the information about its voltage, a
    difference of such changes, would be left to rounding.
    """
    own = np.zeros((len(model.z), 2))
    own[:, 0], own[model.angles, 1] = model.degrees * rows.predict(x), 1.0
    B = np.concatenate([own, *(further.at(x).response for further in model.further)]) if model.further else own
    if model.fixed.size:
        B[:, 1] -= H[: len(B), model.fixed].sum(axis=1)
    return B


def _responses_to_shift(
    model: AreaMeasurements, rows: Rows, x: np.ndarray, neighbour: Neighbour, received: Received, H: Matrix
) -> tuple[np.ndarray, np.ndarray]:
    """Responses to dv of all rows H of ``stack``, shape (rows, 2), and of (p, q) at the boundary, shape (2, 2).

    The voltage of the boundary moves and takes the whole area along.
    """
    (vm_column, va_column), fixed = model.voltage_columns(neighbour), model.fixed
    vm_b = float(x[vm_column])
    B, dp, own = np.zeros((H.shape[0], 2)), np.zeros((2, 2)), shift_of_own_rows(model, rows, x, H)
    end = len(own)
    B[:end] = own / (vm_b, 1.0)
    for n in model.area.neighbours:
        boundary = model.boundary_of(n)
        dy = np.zeros((boundary.d, 2))
        dy[:, 0], dy[boundary.places[Kind.VA], 1] = rows.boundary_values(x, n) * boundary.degrees / vm_b, 1.0
        if n.area == neighbour.area:
            dp[:, 0] = dy[:2, 0]
            if fixed.size:
                dp[:, 1] = -rows.boundary(x, n)[1][:2, fixed].sum(axis=1)
        elif (message := received.get(n.area)) is not None:
            first, end = end, end + len(message.rows[0])
            B[first:end] = message.rows[0] @ dy
            if fixed.size:
                B[first:end, 1] -= H[first:end, fixed].sum(axis=1)
    if va_column in fixed:  # the reference itself: it does not move
        B[:, 1] = dp[:, 1] = 0.0
    return B, dp
