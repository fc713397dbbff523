"""Back end for radial areas: the numbers follow from one compiled elimination over the tree of buses.

The rows take the call where the elimination would lose digits. That happens where one combination of (p, q) is as good
as unknown and the other is not.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from dsse_core.grid.network import Network
from dsse_core.grid.partition import Neighbour
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
from dsse_core.radial.plan import (
    N_SLOT,
    N_VOLTAGE_SLOT,
    RadialLayout,
    find_slots,
    lay_out_radial,
    stack_admittances,
)

if TYPE_CHECKING:
    from dsse_core.radial.kernel import Work

ANGLE_HELD = 1e6  # weight of the reference's angle, rad^-2, small enough to keep the digits of other information
LEAST_OF_FLOW = 1e-12  # information given to powers through branches that nothing determines yet
LEAST_OF_POWER = 1e-11  # the same of powers into children
# Determinant of a covariance of (p, q) over the product of its diagonal. Below it one combination of p and q is known
# so much better than the other that its digits are lost in the entries of the covariance.
LEAST_SPREAD = 1e-5


def find_why_not_radial(network: Network) -> str:
    """The reason why radial cannot serve ``network``; empty if it can."""
    layout = lay_out_radial(network, int(network.table.bus_id[0]))
    return layout if isinstance(layout, str) else ""


@dataclass
class _Rooted:
    """The area's tree from one bus, with the readings and weights of ``radial.kernel`` and memory for the passes."""

    layout: RadialLayout
    admittance: np.ndarray
    slot: np.ndarray
    z: np.ndarray
    w: np.ndarray
    variance: np.ndarray  # of the meters
    at: np.ndarray
    work: Work
    v: np.ndarray
    va: np.ndarray
    message_of: np.ndarray
    R: np.ndarray  # of the neighbours' messages
    message_z: np.ndarray
    role: np.ndarray


class RadialSolver(LinearArea):
    """Back end for a radial ``model``; ``by_rows`` takes the calls that are declined."""

    name = "radial"

    def __init__(self, model: AreaMeasurements, by_rows: TableauSolver) -> None:
        self.declined = Counter()
        self._model, self._by_rows = model, by_rows
        self._area, self._reference = model.area, model.reference
        self._rooted: dict[int, _Rooted] = {}
        self._column = np.array(
            [-1 if n.is_parent else model.boundary_columns(n)[0] for n in self._area.neighbours], dtype=np.int64
        )

    def with_readings(self, model: AreaMeasurements) -> Self:
        """See ``LinearArea``; the two solvers share trees and the memory of the passes."""
        other = copy.copy(self)
        other._model, other._by_rows = model, self._by_rows.with_readings(model)
        other._rooted = {at: other._read_into(rooted) for at, rooted in self._rooted.items()}
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
        from dsse_core.radial.boundary import step_downward

        t = self._tree_from(self._top, x)
        if not self._pass(t, x, received, damping, 0.0):
            return None
        dx = np.empty(self._model.size)
        if not self._downward(step_downward, t, t.work.block, t.work.step, dx):
            self._decline("a step beyond all numbers")
            return None
        return dx

    def _find_variances(
        self, x: np.ndarray, received: Received, damping: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        from dsse_core.radial.boundary import variances_downward

        t = self._tree_from(self._top, x)
        if not self._pass(t, x, received, damping, 0.0):
            return None
        variance = np.empty(self._model.size)
        omega, enough = self._downward(variances_downward, t, t.work.more, t.work.block, variance)
        if not enough:
            self._decline("a variance lost in that of a power")
            return None
        return variance, self._model.real_part(omega.ravel()[t.slot] + self._variance_beside_further(t))

    def _downward(
        self, compiled: Callable[..., Any], t: _Rooted, one: np.ndarray, other: np.ndarray, found: np.ndarray
    ) -> Any:
        """Result of the pass ``compiled`` from root to leaves, which fills ``found``; memory: ``one``, ``other``."""
        return compiled(
            t.layout.order, t.layout.parent, t.admittance, t.z, t.w, t.at, self._column, t.v, t.va, t.message_of,
            t.work.above, t.work.factor, one, other, self._reference is not None, found,
        )  # fmt: skip

    def _find_information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation | None:
        from dsse_core.radial import root as radial_root

        angle_given, is_away = self._reference == neighbour.bus, self._reference not in (None, neighbour.bus)
        t = self._tree_from(neighbour.bus, x)
        if is_away:
            i = self._row_of_reference(t)
            t.z[i, 0], t.w[i, 0] = x[t.layout.order[i]], ANGLE_HELD
        if not self._pass(t, x, received, (0.0, LEAST_OF_POWER), LEAST_OF_FLOW, addressee=neighbour.area):
            return None
        K, vm = np.empty(radial_root.N_KNOWN), abs(t.v[0])
        radial_root.describe_root(
            t.admittance[0], t.z[0], t.w[0], t.v[0], t.va[0], t.work.above[0], angle_given,
            not neighbour.is_parent, K,
        )  # fmt: skip
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
        self, t: _Rooted, P: np.ndarray, slope: np.ndarray, mean: np.ndarray, sign: float
    ) -> tuple[np.ndarray, float]:
        """The given angle of the reference as a function of y: a row by dy, (4,), of variance 1, and its z.

        With y given at the root, ``lam = sign P'P (dpq - slope dv - mean)`` there, (lam, x) of the buses on the way to
        the reference follow by substitution, and their covariance from ``-P'P``, that of lam.
        """
        from dsse_core.radial.inverse import find_last_angle
        from dsse_core.radial.kernel import substitute

        path = [self._row_of_reference(t)]
        while path[-1]:
            path.append(int(t.layout.parent[path[-1]]))
        path.reverse()
        above, v = np.maximum(np.arange(len(path)) - 1, 0), t.v[path]
        with_rest, response = t.work.factor[path], t.work.factor[path]
        response[:, 16:20] = 0.0
        known = np.zeros((5, 4))  # (lam, x) at the root: responses to p, q, vm, va, and the rest
        known[:, :2] = sign * np.vstack([np.eye(2), -slope.T, -mean]) @ (P.T @ P)
        known[2, 3], known[3, 2] = 1 / abs(v[0]), 1.0
        angle = np.empty(5)
        for k, factor in enumerate((response,) * 4 + (with_rest,)):
            step = np.zeros((len(path), 4))
            step[0] = known[k]
            substitute(above, factor, v, step)
            angle[k] = step[-1, 2]
        variance = find_last_angle(above, t.w[path], response, t.work.more[path], -P.T @ P)
        angle /= np.sqrt(max(variance, TIED_SIGMA**2))
        return angle[:4], -float(angle[4])

    def _row_of_reference(self, t: _Rooted) -> int:
        """Number of the reference in the tree of ``t``."""
        assert self._reference is not None
        return int(t.layout.number[self._area.network.row[self._reference]])

    def _pass(
        self,
        t: _Rooted,
        x: np.ndarray,
        received: Received,
        damping: tuple[float, float],
        least_of_flow: float,
        addressee: str = "",
    ) -> bool:
        from dsse_core.radial import boundary as radial_boundary

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
        enough = radial_boundary.pass_upward(
            t.layout.order, t.layout.parent, t.admittance, t.z, t.w, t.at, self._column, t.role, t.R, t.message_z,
            np.asarray(x, dtype=float), damping, least_of_flow, LEAST_SPREAD, t.v, t.va, t.message_of, *t.work,
        )  # fmt: skip
        if not enough:
            self._decline("an open combination of p and q")
        return bool(enough)

    def _decline(self, why: str) -> None:
        self.declined[why] += 1

    def _tree_from(self, bus: int, x: np.ndarray) -> _Rooted:
        """The tree from ``bus`` with the meters' contributions at ``x``; those of least squares depend on no x."""
        t = self._rooted.get(bus) or self._root_at(bus)
        if self._model.method is not least_squares:
            self._rooted[bus] = t = self._read_into(t, self._by_rows.rows.predict(x))
        return t

    def _root_at(self, bus: int) -> _Rooted:
        from dsse_core.radial import kernel as radial_kernel
        from dsse_core.radial.boundary import N_MESSAGE

        network, neighbours = self._area.network, self._area.neighbours
        layout = lay_out_radial(network, bus)
        assert isinstance(layout, RadialLayout)  # find_why_not_radial
        n, k = len(network.buses), len(neighbours)
        rooted = _Rooted(
            layout=layout,
            admittance=stack_admittances(network, layout),
            slot=find_slots(network, self._model.meters, layout),
            z=np.zeros((n, N_SLOT)),
            w=radial_kernel.absent(n),
            variance=self._model.sigma**2.0,
            at=np.array([layout.number[network.row[n.bus]] for n in neighbours], dtype=np.int64),
            work=radial_kernel.Work.of(n),
            v=np.empty(n, dtype=complex),
            va=np.empty(n),
            message_of=np.zeros((k, N_MESSAGE)),
            R=np.zeros((k, 4, 4)),
            message_z=np.zeros((k, 4)),
            role=np.zeros(k, dtype=np.int64),
        )
        self._rooted[bus] = rooted = self._read_into(rooted)
        return rooted

    def _read_into(self, t: _Rooted, h: np.ndarray | None = None) -> _Rooted:
        """``t`` with the contributions of the meters where h(x) is ``h``, by default z, and with further readings.

        Two readings of one voltage become one of their joint weight.
        """
        z, w, model = t.z.copy(), t.w.copy(), self._model
        own, of_injection = model.contribution(model.z if h is None else h), np.isin(t.slot % N_SLOT, (2, 3))
        w[:, :N_VOLTAGE_SLOT] = 0.0
        z.ravel()[t.slot] = model.z + own.shift
        w.ravel()[t.slot] = np.where(of_injection, 1 / own.weight, own.weight)
        for further in model.further:
            assert isinstance(further, VoltageReadings)  # others are dense, see ``choose``
            read, of_read = np.stack(np.split(further.z, 2))[:, t.layout.order].T, further.sigma**-2.0
            joint = w[:, :N_VOLTAGE_SLOT] + of_read
            misfit = z[:, :N_VOLTAGE_SLOT] - read
            misfit[:, 0] = np.pi - (np.pi - misfit[:, 0]) % (2 * np.pi)
            z[:, :N_VOLTAGE_SLOT] = read + w[:, :N_VOLTAGE_SLOT] / joint * misfit
            w[:, :N_VOLTAGE_SLOT] = joint
        return replace(t, z=z, w=w, variance=1 / own.weight)

    def _variance_beside_further(self, t: _Rooted) -> np.ndarray:
        """R of each meter less the variance of its joint reading with further ones, (n_meas,); 0 without these."""
        if not self._model.further:
            return np.zeros(len(t.slot))
        share = 1 - 1 / (t.variance * t.w.ravel()[t.slot])
        return np.where(t.slot % N_SLOT < N_VOLTAGE_SLOT, t.variance * share, 0.0)


def _with_own_balance(
    S: np.ndarray, slope: np.ndarray, mean: np.ndarray, M: np.ndarray, g: np.ndarray, metered: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The power into a child by the balance of its bus, where that is ``metered``, with LEAST_OF_POWER as information.

    Returns covariance, slope by (vm, va), mean of the change, and the information about the voltage.
    """
    d = LEAST_OF_POWER
    S = np.where(metered[:, None] & metered, S, 0.0)
    slope, mean = np.where(metered[:, None], slope, 0.0), np.where(metered, mean, 0.0)
    share = np.linalg.inv(np.eye(2) + d * S)  # symmetric with S, and S share too
    M = M + d * slope.T @ share @ slope
    g = g - d * slope.T @ share @ mean
    S, slope, mean = S @ share, share @ slope, share @ mean
    unmetered = ~metered
    S[unmetered, unmetered] = 1 / d
    return (S + S.T) / 2, slope, mean, M, g
