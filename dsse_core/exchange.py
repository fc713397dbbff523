"""The exact boundary exchange: an area's state given its neighbours' information, and what it tells them.

Four numbers separate the two sides of a boundary bus b between an owner and one of its children:

``y = (vm_b, va_b, p, q)``, ``p + jq`` = power flowing from bus b into the child's branches.

In the child y is a function of its own state; in the owner p and q are two extra state variables per child.
Each side tells the other its cost-to-go, the least J that its measurements can reach as a function of y:
``phi(y) = 1/2 y' L y - e' y``. On a tree of areas the fixed point is the centralised estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dsse_core.admittance import build_admittance
from dsse_core.augmented import AugmentedFactor
from dsse_core.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.partition import Area, Neighbour

DAMPING = 0.3  # tau, p.u. and rad: undamped steps diverge while transit power is seen through losses only
LARGEST_STEP = 0.1  # p.u. and rad, per variable
FLOW_SIGMA = 1e-6  # p.u.; least sigma of what a message rests on: keeps L finite where p and q are exact functions
EXACT_SIGMA = 1e-8  # p.u.; of exact injections in an area's own step: it may have more of them than variables
NOT_YET = 1e-6  # information given to eliminated variables that nothing determines yet
NO_INFORMATION = 1e-9  # diagonal entry of L: a standard deviation of 3e4 p.u. or rad
TELLS_NOTHING = 1e-14  # relative eigenvalue of L, its diagonal scaled to 1, that is rounding
INDEFINITE = 1e-6  # relative size from which on a negative eigenvalue of L is no rounding


@dataclass(frozen=True)
class BoundaryInformation:
    """Cost-to-go ``1/2 y' L y - e' y`` of one side of a boundary, ``L`` (4, 4) symmetric, ``e`` (4,)."""

    L: np.ndarray
    e: np.ndarray

    @property
    def is_semidefinite(self) -> bool:
        """Whether ``L`` is positive semidefinite but for rounding, its diagonal scaled to 1."""
        diagonal = np.diag(self.L)
        empty = self.L[diagonal <= NO_INFORMATION]
        if diagonal.min() < -NO_INFORMATION or (empty**2).max(initial=0.0) > NO_INFORMATION * diagonal.max():
            return False
        _, w, _ = _decompose(self.L)
        return bool(w[0] >= -INDEFINITE * max(w[-1], 1.0))


@dataclass(frozen=True)
class AreaModel:
    """The measurements of one area as functions of ``x = [va; vm; p_1, q_1, p_2, q_2, ...]``, one pair per child.

    ``free``: the variables that are unknown, all but a reference angle.
    """

    area: Area
    model: MeasurementModel
    into_children: sp.csr_array  # (n_meas, 2 n_child): 1 where an injection meter counts a child's power
    into_area: MeasurementModel | None  # P and Q from the parent's bus into the area's own branches
    z: np.ndarray
    sigma: np.ndarray
    free: np.ndarray

    @property
    def size(self) -> int:
        return 2 * self._n + int(self.into_children.shape[1])

    @property
    def _n(self) -> int:
        return len(self.area.network.buses)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """z - h(x), shape (n_meas,); angles wrapped to (-pi, pi]."""
        r = self.z - self.model.predict(x[: 2 * self._n]) - self.into_children @ x[2 * self._n :]
        angles = self.model.kinds == MeasurementKind.VA
        r[angles] = np.pi - (np.pi - r[angles]) % (2 * np.pi)
        return np.asarray(r)

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """H(x), shape (n_meas, size)."""
        return sp.csr_array(sp.hstack([self.model.jacobian(x[: 2 * self._n]), self.into_children], format="csr"))

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        """y, shape (4,), and T = dy/dx, shape (4, size), at the boundary to ``neighbour``."""
        row = self.area.network.row[neighbour.bus]
        if self.into_area is None or not neighbour.is_parent:
            columns = [self._n + row, row, *self._power_columns(neighbour)]
            return x[columns], _select(columns, self.size)
        flows = self.into_area.predict(x[: 2 * self._n])
        C = sp.csr_array(self.into_area.jacobian(x[: 2 * self._n]))
        C = sp.csr_array((C.data, C.indices, C.indptr), shape=(2, self.size))
        T = sp.vstack([_select([self._n + row, row], self.size), C], format="csr")
        return np.concatenate([x[[self._n + row, row]], flows]), sp.csr_array(T)

    def _power_columns(self, child: Neighbour) -> list[int]:
        children = [n.area for n in self.area.neighbours if not n.is_parent]
        first = 2 * self._n + 2 * children.index(child.area)
        return [first, first + 1]


def build_area_model(area: Area, measurements: Sequence[Measurement], reference: int | None) -> AreaModel:
    """The model of ``area``'s own ``measurements``; ``reference``: bus of the grid's angle
    reference, if the area sees it."""
    network = area.network
    admittance = build_admittance(network)
    children = [n for n in area.neighbours if not n.is_parent]
    rows, columns = [], []
    for row, m in enumerate(measurements):
        for k, child in enumerate(children):
            if m.meter.kind.of_injection and m.meter.bus == child.bus:
                rows.append(row)
                columns.append(2 * k + (m.meter.kind is MeasurementKind.Q_INJECTION))
    shape = (len(measurements), 2 * len(children))
    size = 2 * len(network.buses) + shape[1]
    fixed = [] if reference is None else [network.row[reference]]
    at_parent = [Meter(k, area.parent.bus) for k in _POWER] if area.parent else []
    return AreaModel(
        area=area,
        model=build_measurement_model(network, admittance, [m.meter for m in measurements]),
        into_children=sp.csr_array(sp.coo_array((np.ones(len(rows)), (rows, columns)), shape=shape)),
        into_area=build_measurement_model(network, admittance, at_parent) if at_parent else None,
        z=np.array([m.value for m in measurements], dtype=float),
        sigma=np.array(
            [EXACT_SIGMA if m.meter.source is Source.VIRTUAL else m.sigma for m in measurements], dtype=float
        ),
        free=np.delete(np.arange(size), fixed),
    )


def solve_step(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """The damped step dx, shape (size,), ``(G + 1 / tau^2) dx = b`` with all messages ``heard`` in."""
    H, r, sigma = _stack(model, x, heard)
    factor = AugmentedFactor(sp.csr_array(H[:, model.free]), sigma, DAMPING**-2.0)
    dx = np.zeros(model.size)
    dx[model.free] = np.clip(factor.solve_step(r), -LARGEST_STEP, LARGEST_STEP)
    return dx


def state_variance(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """diag(G^-1) with all messages in, shape (size,): at the fixed point that of the centralised estimate."""
    H, _, sigma = _stack(model, x, heard)
    variance = np.zeros(model.size)
    variance[model.free] = AugmentedFactor(sp.csr_array(H[:, model.free]), sigma, NOT_YET).state_variance()
    return variance


def compute_information(
    model: AreaModel,
    x: np.ndarray,
    neighbour: Neighbour,
    heard: Mapping[str, BoundaryInformation],
    *,
    angle_known: bool,
) -> BoundaryInformation:
    """What ``neighbour`` is to hear: everything but y eliminated, its own message left out.

    With ``K = [[R, H_u], [H_u', -d]]``: ``L = H_y' s``, ``g = H_y' s_r`` of ``K [s, .] = [H_y, 0]`` and
    ``K [s_r, .] = [r, 0]``, one factorisation with five right-hand sides; then ``e = g + L y``. Toward the
    parent, p and q join as variables tied to the area's flows with ``FLOW_SIGMA``. ``angle_known``: whether
    this side, without the neighbour, has the reference or an angle meter; if not, it knows nothing of va.
    """
    H, r, sigma = _stack(model, x, {name: m for name, m in heard.items() if name != neighbour.area})
    y, T = model.boundary(x, neighbour)
    columns = T.indices.tolist()
    if neighbour.is_parent:
        H = sp.csr_array(sp.block_array([[H, None], [T[2:], -sp.eye_array(2)]], format="csr"))
        r, sigma = np.append(r, [0.0, 0.0]), np.append(sigma, [0.0, 0.0])
        columns = [*T[:2].indices.tolist(), model.size, model.size + 1]
    known = np.setdiff1d(np.arange(model.size), model.free)
    kept = [column for column in columns if column not in known]
    gone = np.setdiff1d(np.arange(H.shape[1]), np.concatenate([known, columns]))
    factor = AugmentedFactor(sp.csr_array(H[:, gone]), np.maximum(sigma, FLOW_SIGMA), NOT_YET)
    H_y = H[:, kept].toarray()
    s, _ = factor.solve(np.column_stack([H_y, r]), np.zeros((len(gone), len(kept) + 1)))
    L, g = np.zeros((4, 4)), np.zeros(4)
    at = [columns.index(column) for column in kept]
    product = H_y.T @ s
    L[np.ix_(at, at)], g[at] = product[:, :-1], product[:, -1]
    if not angle_known:
        L[1, :] = L[:, 1] = g[1] = 0.0
    L = _clip((L + L.T) / 2)
    return BoundaryInformation(L, g + L @ y)


_POWER = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)


def _decompose(L: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``length``, ``w``, ``V`` with ``L = D V diag(w) V' D``, ``D = diag(length)``, the middle's diagonal 1 or 0."""
    told = np.diag(L) > NO_INFORMATION
    length = np.sqrt(np.where(told, np.diag(L), 1.0))
    w, V = np.linalg.eigh(np.where(np.outer(told, told), L / np.outer(length, length), 0.0))
    return length, w, V


def _clip(L: np.ndarray) -> np.ndarray:
    """``L`` without the negative eigenvalues that rounding leaves where there is no information."""
    length, w, V = _decompose(L)
    told = np.diag(L) > NO_INFORMATION
    clipped: np.ndarray = (V * np.maximum(w, 0.0)) @ V.T * np.outer(length * told, length * told)
    return clipped


def _select(columns: Sequence[int], size: int) -> sp.csr_array:
    indptr = np.arange(len(columns) + 1)
    return sp.csr_array((np.ones(len(columns)), np.array(columns), indptr), shape=(len(columns), size))


def _stack(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
    """H, residual and sigma of the area's own measurements and, as four more rows each, the messages ``heard``.

    With ``L = D V diag(w) V' D`` the quadratic ``1/2 y' L y - e' y`` is four measurements of ``V' D dy`` with
    residual ``V' D^-1 (e - L y) / w`` and variance ``1 / w``: nothing is lost to the range of L.
    """
    H, r, sigma = [model.jacobian(x)], [model.residual(x)], [model.sigma]
    for n in model.area.neighbours:
        if (message := heard.get(n.area)) is not None:
            y, T = model.boundary(x, n)
            length, w, V = _decompose(message.L)
            told = w > TELLS_NOTHING * w[-1]
            H.append(sp.csr_array((V[:, told].T * length) @ T))
            r.append(V[:, told].T @ ((message.e - message.L @ y) / length) / w[told])
            sigma.append(1 / np.sqrt(w[told]))
    return sp.csr_array(sp.vstack(H, format="csr")), np.concatenate(r), np.concatenate(sigma)
