"""Numerics of an area from its rows; with sparse rows by one factor of the augmented system for each result."""

from __future__ import annotations

import copy
from collections import Counter
from typing import Self, cast

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.boundary import Kind
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import (
    NOTHING_OF_VOLTAGE,
    BoundaryInformation,
    factor_information,
    factor_inverse,
    put_together,
)
from dsse_core.linear.interface import NOT_YET, NOT_YET_OF_POWER, LinearArea, Matrix, Received, Rows
from dsse_core.linear.sparse import SparseRows
from dsse_core.matrices.augmented import AugmentedFactor

MOST_TURNS = 4  # axes of (p, q) that are tried, the first ones included


class RowSolver(LinearArea):
    """Solver on all rows of an area: own measurements, further rows, messages; ``rows``: h and H of ``model``."""

    not_yet = NOT_YET
    """Information given to voltages that nothing determines yet."""

    def __init__(self, model: AreaMeasurements, rows: Rows, name: str) -> None:
        self.name = name
        self.declined = Counter()
        self.model, self.rows = model, rows
        self._least = np.where(model.are_powers, NOT_YET_OF_POWER, self.not_yet)

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
        H = rows.jacobian(x)  # which finds h(x) in passing
        own, of_own = self.model.rows_where(rows.predict(x))
        messages, of_messages = rows.messages(x, received)
        if not (further or messages):
            return H, own, of_own
        r = np.concatenate([own, *(part.residual for part in further), *of_messages])
        sigma = np.ones(len(r))
        of_own = np.concatenate([of_own, *(part.sigma for part in further)])
        sigma[: len(of_own)] = of_own
        return rows.join([H, *(rows.take(part.H) for part in further), *messages]), r, sigma


class TableauSolver(RowSolver):
    """Solver by sparse factors of the augmented system, on ``SparseRows``."""

    rows: SparseRows

    nothing_of_voltage = NOTHING_OF_VOLTAGE

    def stack(self, x: np.ndarray, received: Received) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
        H, r, sigma = super().stack(x, received)
        return cast("sp.csr_array", H), r, sigma

    def prepare(self, x: np.ndarray) -> None:
        self.rows.jacobian(x)

    def step(self, x: np.ndarray, received: Received, damping: float = 0.0) -> np.ndarray:
        H, r, sigma = self.stack(x, received)
        free, dx = self.model.free, np.zeros(self.model.size)
        least = np.maximum(self.least_information(free), damping)
        dx[free] = self.rows.factor(H, sigma, least, free).solve(r, np.zeros(len(free)))[1]
        return dx

    def variances(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, np.ndarray]:
        factor, of_state = self._factor_of(x, received), np.zeros(self.model.size)
        of_state[self.model.free] = factor.state_variance()
        return of_state, self.model.real_part(factor.residual_variance()[: len(self.model.z)])

    def covariance(self, x: np.ndarray, received: Received, B: np.ndarray) -> np.ndarray:
        B = B[:, self.model.free]
        return np.asarray(B @ self._factor_of(x, received).covariance_times(B.T))

    def _factor_of(self, x: np.ndarray, received: Received) -> AugmentedFactor:
        """Factor of all that is known of the state x."""
        H, _, sigma = self.stack(x, received)
        return self.factor(H, sigma, self.model.free)

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
        W, P, A = self._find_power(factor, C, s[:, 3:], du[:, 3:])
        return put_together(y, P @ W.T, P @ (A.T @ B - W.T @ dp), P @ (A.T @ r), (N, z_of_voltage))

    def factor(self, H: sp.csr_array, sigma: np.ndarray, columns: np.ndarray) -> AugmentedFactor:
        """Factor of the ``columns`` of H, with the damping of ``least_information``."""
        return self.rows.factor(H, sigma, self.least_information(columns), columns)

    def _find_power(
        self, factor: AugmentedFactor, C: sp.csr_array, A: np.ndarray, du: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Information about (p, q), with v given: W, P, (2, 2), and A, (rows, 2).

        ``P'P`` is the inverse of the covariance of ``W'(p, q)``, and ``W'C du = A'r`` for residuals r. W turns the
        axes, so that both combinations of p and q are solved for by themselves; beside a combination that is as good as
        unknown the other one would drown in rounding. ``A``, ``du``: the solution for W = 1.
        """
        W = np.eye(2)
        for turn in range(MOST_TURNS):
            S, axes, P = self.weigh_power(factor, C.T @ W, A, du)
            if turn == MOST_TURNS - 1 or S[0, 1] ** 2 <= abs(S[0, 0] * S[1, 1]) / 2:
                break
            W = W @ axes
            A, du = factor.solve(np.zeros(A.shape), C.T @ W)
        return W, P, A

    def weigh_power(
        self, factor: AugmentedFactor, combinations: np.ndarray, A: np.ndarray, du: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariance S of two ``combinations`` (n_u, 2) of variables, its axes, and P with ``P'P = S^-1``.

        ``A``, ``du``: the solution for them.
        """
        S = -(combinations.T @ du)
        S = (S + S.T) / 2
        return S, np.linalg.svd(S)[0], factor_inverse(S)


def shift_of_own_rows(model: AreaMeasurements, rows: Rows, x: np.ndarray, H: Matrix) -> np.ndarray:
    """Responses of the area's own and further rows, H of ``stack``, to growth and turn of all voltages, shape (:, 2).

    Growth scales all voltages of the area alike, and turn turns all its angles (but a reference). Powers respond with
    2 s and 0 exactly, parts of currents with i and j i. Moving one bus alone would change flows by dv / z; the
    information about its voltage, a difference of such changes, would be left to rounding.
    """
    own = np.zeros((len(model.z), 2))
    own[:, 0], own[model.angles, 1] = model.degrees * rows.predict(x), 1.0
    if model.current_parts.size:
        ahead = x + np.pi / 2 * (np.arange(len(x)) < model.n_nodes)  # where Re and Im read their derivatives by a turn
        own[model.current_parts, 1] = model.model.predict(ahead)[model.current_parts]
    B = np.concatenate([own, *(further.at(x).response for further in model.further)]) if model.further else own
    if model.fixed.size:
        turned = np.zeros(model.size)
        turned[model.fixed] = 1.0
        B[:, 1] -= (H @ turned)[: len(B)]
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
