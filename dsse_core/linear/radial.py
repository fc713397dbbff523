"""Back end for radial areas: the numbers follow from one compiled elimination over the tree of buses.

The rows take the call where the elimination would lose digits. That happens where one combination of (p, q) is as good
as unknown and the other is not.
"""

from __future__ import annotations

import copy
from collections import Counter
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from dsse_core.compiling import find_obstacle
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Neighbour
from dsse_core.grid.radial_order import find_tree
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import (
    NOTHING_OF_VOLTAGE,
    TIED_SIGMA,
    BoundaryInformation,
    factor_information,
    factor_inverse,
    put_together,
)
from dsse_core.linear.contributions import VoltageReadings, least_squares
from dsse_core.linear.interface import NOT_YET, NOT_YET_OF_POWER, LinearArea, Received
from dsse_core.linear.rows import TableauSolver
from dsse_core.radial.plan import N_SLOT, N_VOLTAGE_SLOT, find_what_lacks_slots, plan_tree

if TYPE_CHECKING:
    from dsse_core.radial.tree import Tree

# Determinant of a covariance of (p, q) over the product of its diagonal. Below it one combination of p and q is known
# so much better than the other that its digits are lost in the entries of the covariance.
LEAST_SPREAD = 1e-5


def find_why_not_radial(network: Network) -> str:
    """The reason why radial cannot serve ``network``; empty if it can."""
    if why := find_what_lacks_slots(network):
        return why
    tree = find_obstacle() or find_tree(network, int(network.table.bus_id[0]))
    return tree if isinstance(tree, str) else ""


class RadialSolver(LinearArea):
    """Back end for a radial ``model``; ``by_rows`` takes the calls that are declined."""

    name = "radial"

    def __init__(self, model: AreaMeasurements, by_rows: TableauSolver) -> None:
        self.declined = Counter()
        self._model, self._by_rows = model, by_rows
        self._area, self._reference = model.area, model.reference
        self._rooted: dict[int, Tree] = {}
        self._column = np.array(
            [-1 if n.is_parent else model.boundary_columns(n)[0] for n in self._area.neighbours], dtype=np.int64
        )

    def with_readings(self, model: AreaMeasurements) -> Self:
        """See ``LinearArea``; the two solvers share trees and the memory of the passes."""
        other = copy.copy(self)
        other._model, other._by_rows = model, self._by_rows.with_readings(model)
        other._rooted = {at: other._read_into(tree, model.z) for at, tree in self._rooted.items()}
        return other

    @cached_property
    def _top(self) -> int:
        """The root for steps: the reference, else the parent's boundary bus, else the first bus."""
        if self._reference is not None:
            return self._reference
        return self._area.parent.bus if self._area.parent else self._area.network.buses[0].id

    def step(self, x: np.ndarray, received: Received, damping: float = 0.0) -> np.ndarray:
        found = self._find_step(x, received, (max(NOT_YET, damping), max(NOT_YET_OF_POWER, damping)))
        return self._by_rows.step(x, received, damping) if found is None else found

    def variances(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, np.ndarray]:
        found = self._find_variances(x, received, (NOT_YET, NOT_YET_OF_POWER))
        return self._by_rows.variances(x, received) if found is None else found

    def covariance(self, x: np.ndarray, received: Received, B: np.ndarray) -> np.ndarray:
        """See ``LinearArea``; found by rows, as the tree has covariances of one bus and the branch above it only."""
        return self._by_rows.covariance(x, received, B)

    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        found = self._find_information(x, neighbour, received)
        return self._by_rows.information(x, neighbour, received) if found is None else found

    def _find_step(self, x: np.ndarray, received: Received, damping: tuple[float, float]) -> np.ndarray | None:
        """The step, shape (size,), or None where it is declined; ``damping``: of voltages and of powers."""
        tree = self._tree_from(self._top, x)
        if not self._pass(tree, x, received, damping, 0.0):
            return None
        dx = tree.step(self._reference is not None, self._model.size)
        if dx is None:
            self._decline("a step beyond all numbers")
        return dx

    def _find_variances(
        self, x: np.ndarray, received: Received, damping: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        tree = self._tree_from(self._top, x)
        if not self._pass(tree, x, received, damping, 0.0):
            return None
        variance, omega, _, enough = tree.variances(self._reference is not None, self._model.size)
        if not enough:
            self._decline("a variance lost in that of a power")
            return None
        return variance, self._model.real_part(omega.ravel()[tree.plan.slot] + self._variance_beside_further(tree, x))

    def _find_information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation | None:
        from dsse_core.radial.root import describe_root

        angle_given, is_away = self._reference == neighbour.bus, self._reference not in (None, neighbour.bus)
        t = self._tree_from(neighbour.bus, x)
        if is_away:
            i = self._number_of(t, self._reference)
            t.z[i, 0], t.w[i, 0] = x[t.plan.order[i]], 1 / NOT_YET  # 1e2 to 1e11 lead to the same
        if not self._pass(t, x, received, (0.0, NOT_YET_OF_POWER), NOT_YET_OF_POWER, addressee=neighbour.area):
            return None
        K, vm = t.work.above[0], abs(t.v[0])
        describe_root(t.plan.admittance[0], t.z[0], t.w[0], t.v[0], t.va[0], K, angle_given, not neighbour.is_parent)
        S = -np.array([[K[0], K[1]], [K[1], K[2]]])
        slope, mean = np.array([[K[4] / vm, K[3]], [K[6] / vm, K[5]]]), -K[10:12]
        M, g = np.array([[K[9] / vm**2, K[8] / vm], [K[8] / vm, K[7]]]), np.array([K[13] / vm, K[12]])
        sign, power, metered = -1.0, K[14:16], np.ones(2, dtype=bool)
        if not neighbour.is_parent:
            column = self._column[self._area.neighbours.index(neighbour)]
            sign, power, metered = 1.0, x[column : column + 2], t.w[0, 2:4] >= 0
            slope, mean = -slope, -mean - power
        if is_away:
            given = factor_inverse(np.where(np.outer(metered, metered), S, np.eye(2))) * metered
            angle = self._angle_of_reference(t, given, slope, mean, sign)
        if not neighbour.is_parent:
            S, slope, mean, M, g = _with_own_balance(S, slope, mean, M, g, metered)
        if S[0, 1] ** 2 > (1 - LEAST_SPREAD) * abs(S[0, 0] * S[1, 1]):
            self._decline("an open combination of p and q at the boundary")
            return None
        P = factor_inverse(S)
        y = np.array([power[0], power[1], vm, t.va[0]])
        found = put_together(y, P, -P @ slope, P @ mean, factor_information(M, g, NOTHING_OF_VOLTAGE))
        return found.with_row(angle[0], angle[0] @ y + angle[1]) if is_away else found

    def _angle_of_reference(
        self, t: Tree, P: np.ndarray, slope: np.ndarray, mean: np.ndarray, sign: float
    ) -> tuple[np.ndarray, float]:
        """The given angle of the reference as a function of y: a row by dy, (4,), of variance 1, and its z.

        With y given at the root, ``lam = sign P'P (dpq - slope dv - mean)`` there, (lam, x) of the buses on the way to
        the reference follow by substitution, and their covariance from ``-P'P``, that of lam.
        """
        from dsse_core.radial.inverse import find_last_angle
        from dsse_core.radial.kernel import descend

        path = [self._number_of(t, self._reference)]
        while path[-1]:
            path.append(int(t.plan.parent[path[-1]]))
        path.reverse()
        n = len(path)
        place, v, va = np.arange(n), t.v[path], np.zeros(n)
        above, with_rest, response = np.maximum(place - 1, 0), t.work.factor[path], t.work.factor[path]
        response[:, 16:20] = 0.0
        known = np.zeros((5, 4))  # (lam, x) at the root: responses to p, q, vm, va, and the rest
        known[:, :2] = sign * np.vstack([np.eye(2), -slope.T, -mean]) @ (P.T @ P)
        known[2, 3], known[3, 2] = 1 / abs(v[0]), 1.0
        angle = np.empty(5)
        for k, factor in enumerate((response,) * 4 + (with_rest,)):
            step = np.zeros((n, 4))
            step[0] = known[k]
            descend(0, n, above, place, factor, v, va, step, 0.0, v, va)
            angle[k] = step[-1, 2]
        variance = find_last_angle(above, t.w[path], response, t.work.more[path], -P.T @ P)
        angle /= np.sqrt(max(variance, TIED_SIGMA**2))
        return angle[:4], -float(angle[4])

    def _number_of(self, t: Tree, bus: int | None) -> int:
        """Number of ``bus`` in ``t``."""
        assert bus is not None
        return int(t.plan.number[self._area.network.row[bus]])

    def _pass(
        self,
        t: Tree,
        x: np.ndarray,
        received: Received,
        damping: tuple[float, float],
        least_of_flow: float,
        addressee: str = "",
    ) -> bool:
        from dsse_core.radial import boundary as radial_boundary
        from dsse_core.radial.kernel import UPWARD

        for k, n in enumerate(self._area.neighbours):
            message = received.get(n.area) if n.area != addressee else None
            t.role[k] = (
                radial_boundary.ADDRESSEE
                if n.area == addressee
                else radial_boundary.SILENT
                if message is None
                else radial_boundary.RECEIVED
            )
            t.R[k], t.message_z[k] = (0.0, 0.0) if message is None else (message.R, message.z)
            if n.is_parent:
                t.w[t.at[k], 2:4] = -1.0
        x, least = np.asarray(x, dtype=float), (least_of_flow, LEAST_SPREAD)
        if not t.go_up(x, UPWARD, damping, least):
            self._decline("an open combination of p and q")
            return False
        return True

    def _decline(self, why: str) -> None:
        self.declined[why] += 1

    def _h_for_contributions(self, x: np.ndarray) -> np.ndarray:
        """h(x), (n_meas,); without computing it where the contributions do not depend on it, any numbers."""
        return self._model.z if self._model.method is least_squares else self._by_rows.rows.predict(x)

    def _tree_from(self, bus: int, x: np.ndarray) -> Tree:
        """The tree from ``bus`` with the meters' contributions at ``x``; those of least squares depend on no x."""
        tree = self._rooted.get(bus)
        if tree is None or self._model.method is not least_squares:
            self._rooted[bus] = tree = self._read_into(tree or self._root_at(bus), self._h_for_contributions(x))
        return tree

    def _root_at(self, bus: int) -> Tree:
        from dsse_core.radial.tree import Tree

        found = plan_tree(self._area.network, self._model.meters, bus)
        assert not isinstance(found, str)  # find_why_not_radial
        tree = Tree.of(found[0], np.empty(len(self._column), dtype=np.int64), self._column)
        tree.at[:] = [self._number_of(tree, n.bus) for n in self._area.neighbours]
        return tree

    def _read_into(self, tree: Tree, h: np.ndarray) -> Tree:
        """``tree`` with the contributions of the meters where h(x) is ``h``, and with further readings.

        Two readings of one voltage become one of their joint weight.
        """
        model = self._model
        own = model.contribution(h)
        tree = tree.read(model.z + own.shift, own.weight**-0.5)
        z, w = tree.z[:, :N_VOLTAGE_SLOT], tree.w[:, :N_VOLTAGE_SLOT]
        for further in model.further:
            assert isinstance(further, VoltageReadings)  # others are dense, see ``choose``
            read, of_read = (np.stack(np.split(of, 2))[:, tree.plan.order].T for of in (further.z, further.weight))
            joint, misfit = w + of_read, z - read
            misfit[:, 0] = np.pi - (np.pi - misfit[:, 0]) % (2 * np.pi)
            share = np.divide(w, joint, where=joint > 0, out=np.ones_like(w))
            z[:], w[:] = read + share * misfit, joint
        return tree

    def _variance_beside_further(self, t: Tree, x: np.ndarray) -> np.ndarray:
        """R of each meter less the variance of its joint reading with further ones, (n_meas,); 0 without these."""
        slot = t.plan.slot
        if not self._model.further:
            return np.zeros(len(slot))
        own = self._model.contribution(self._h_for_contributions(x)).weight
        return np.where(slot % N_SLOT < N_VOLTAGE_SLOT, 1 / own - 1 / t.w.ravel()[slot], 0.0)


def _with_own_balance(
    S: np.ndarray, slope: np.ndarray, mean: np.ndarray, M: np.ndarray, g: np.ndarray, metered: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The power into a child by the balance of its bus, where that is ``metered``.

    NOT_YET_OF_POWER is added as information. Returns covariance, slope by (vm, va), mean of the change, and the
    information about the voltage.
    """
    d = NOT_YET_OF_POWER
    S = np.where(metered[:, None] & metered, S, 0.0)
    slope, mean = np.where(metered[:, None], slope, 0.0), np.where(metered, mean, 0.0)
    share = np.linalg.inv(np.eye(2) + d * S)  # symmetric with S, and S share too
    M = M + d * slope.T @ share @ slope
    g = g - d * slope.T @ share @ mean
    S, slope, mean = S @ share, share @ slope, share @ mean
    unmetered = ~metered
    S[unmetered, unmetered] = 1 / d
    return (S + S.T) / 2, slope, mean, M, g
