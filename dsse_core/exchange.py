"""The exact boundary exchange: an area's state given its neighbours' information, and what it tells them.

Four numbers separate the two sides of a boundary bus b between an owner and one of its children:

``y = (p, q, vm_b, va_b)``, ``p + jq`` = power flowing from bus b into the child's branches.

In the child y is a function of its own state; in the owner p and q are two extra state variables per child.
Each side tells the other its cost-to-go, the least J that its measurements can reach as a function of y, as
four measurements of y with variance 1: ``1/2 |R y - z|^2``. On a tree of areas the fixed point is the
centralised estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dsse_core.area_model import EXACT_SIGMA, AreaModel
from dsse_core.augmented import AugmentedFactor, scale_rows
from dsse_core.measurement import MeasurementKind
from dsse_core.partition import Neighbour

DAMPING = 0.3  # tau, p.u. and rad: undamped steps diverge while transit power is seen through losses only
LARGEST_STEP = 0.1  # p.u. and rad, of any voltage
SMALL_STEP = 1e-3  # p.u. and rad; after a smaller one the damping falls in proportion
NOT_YET = 1e-6  # information given to eliminated voltages that nothing determines yet
NOT_YET_OF_POWER = 1e-8  # the same of powers, which may be large
NO_LOAD_NOT_YET = 1e-18  # the same in the no-load model, relative to what the rows tell where that is less than 1
NOTHING = 1e-30  # for variables that no row speaks of
ROUNDING = 1e-14  # relative; what is left of a difference of equal numbers
NOTHING_OF_VOLTAGE = 1e-10  # information about it, below which it is rounding
MOST_TURNS = 4  # of the axes of (p, q)
BEYOND_REASON = 1e18  # numbers of a message


@dataclass(frozen=True)
class BoundaryInformation:
    """Cost-to-go ``1/2 |R y - z|^2`` of one side of a boundary: ``R`` (4, 4) upper triangular, ``z`` (4,).

    A row of zeros tells nothing. ``L = R'R`` is its information matrix.
    """

    R: np.ndarray
    z: np.ndarray

    @property
    def is_reasonable(self) -> bool:
        return bool(max(abs(self.R).max(), abs(self.z).max()) < BEYOND_REASON)


def solve_step(
    model: AreaModel,
    x: np.ndarray,
    heard: Mapping[str, BoundaryInformation],
    last_step: float = np.inf,
    *,
    powers_too: bool = False,
) -> np.ndarray:
    """The damped step dx, shape (size,), ``(G + D) dx = b`` with all messages in; D = 1 / tau^2 for voltages.

    ``powers_too``: damp them alike, where messages do not yet tell what neighbours know. After a small
    ``last_step``, max |dx|, less damping is needed, and directions of little information converge too.
    """
    least = _least_information(model, model.free)
    most = np.full(len(least), DAMPING**-2.0) if powers_too else _damping(model)
    damping = np.maximum(most * min(1.0, last_step / SMALL_STEP), least)
    return _solve_damped(model, x, heard, damping, np.zeros(len(model.free)))


def solve_step_near(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], start: np.ndarray
) -> np.ndarray:
    """The step dx, shape (size,), where news is missing: ``start`` counts as measured, all voltages with sigma tau.

    Without it losses alone would tell what the missing neighbours should, and the state would run away.
    """
    damping = _damping(model)
    return _solve_damped(model, x, heard, damping, damping * (x - start)[model.free])


def _damping(model: AreaModel) -> np.ndarray:
    """Of voltages; nobody knows beforehand how large powers are."""
    return np.where(model.free < 2 * len(model.area.network.buses), DAMPING**-2.0, NOT_YET_OF_POWER)


def _solve_damped(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], damping: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    H, r, sigma = _stack(model, x, heard)
    dx = np.zeros(model.size)
    dx[model.free] = AugmentedFactor(sp.csr_array(H[:, model.free]), sigma, damping).solve(r, pull)[1]
    largest = float(abs(dx[: 2 * len(model.area.network.buses)]).max())
    return np.asarray(dx * min(1.0, LARGEST_STEP / max(largest, LARGEST_STEP)))


def state_variance(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], *, near_start: bool = False
) -> np.ndarray:
    """diag(G^-1) with all messages in, shape (size,): at the fixed point that of the centralised estimate.

    ``near_start``: with the start as a measurement, as in ``solve_step_near``.
    """
    H, _, sigma = _stack(model, x, heard)
    variance = np.zeros(model.size)
    damping = _damping(model) if near_start else _least_information(model, model.free)
    variance[model.free] = AugmentedFactor(sp.csr_array(H[:, model.free]), sigma, damping).state_variance()
    return variance


def residual_variance(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """diag(Omega) of the area's own measurements with all messages in, shape (n_meas,) (eq. 3.22)."""
    H, _, sigma = _stack(model, x, heard)
    variance: np.ndarray = _factor_undamped(model, H, sigma, model.free).residual_variance()
    return variance[: len(model.z)]


def _least_information(model: AreaModel, columns: np.ndarray) -> np.ndarray:
    return np.where(columns < 2 * len(model.area.network.buses), NOT_YET, NOT_YET_OF_POWER)


def _factor_undamped(model: AreaModel, H: sp.csr_array, sigma: np.ndarray, columns: np.ndarray) -> AugmentedFactor:
    """The factor of some columns of H, damped only where nothing determines a variable yet."""
    H = sp.csr_array(H[:, columns])
    if not model.no_load:
        return AugmentedFactor(H, sigma, _least_information(model, columns))
    told = np.bincount(H.indices, scale_rows(H, 1 / sigma).data ** 2, len(columns))
    return AugmentedFactor(H, sigma, np.where(told > 0, NO_LOAD_NOT_YET * np.minimum(told, 1.0), NOTHING))


def compute_information(
    model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: Mapping[str, BoundaryInformation]
) -> BoundaryInformation:
    """What ``neighbour`` is to hear: everything but y eliminated, its own message left out.

    Two parts, each a 2x2 matrix that no rounding of the other can spoil. What this side knows of the boundary's
    voltage v = (vm_b, va_b), whatever power flows: with u all variables but v and ``K = [[R, H_u], [H_u', -d]]``,
    ``M = B' s``, ``g = B' s_r`` from ``K [s, .] = [B, 0]``, ``K [s_r, .] = [r, 0]``. And what it knows of the power
    given v: ``(p, q) = y_p + C du_r + (dp - C du_B) dv`` with covariance ``C G_uu^-1 C'`` (``_find_power``). ``B`` and
    ``dp`` are the responses of measurements and power when v moves and takes the whole area along
    (``_responses_to_shift``).
    """
    heard = {name: message for name, message in heard.items() if name != neighbour.area}
    H, r, sigma = _stack(model, x, heard)
    B, dp = _responses_to_shift(model, x, neighbour, heard, H)
    y, T = model.boundary(x, neighbour)
    u = np.setdiff1d(model.free, T[2:].indices)
    factor = _factor_undamped(model, H, sigma, u)
    nothing = 0.0 if model.no_load else NOTHING_OF_VOLTAGE
    s, _ = factor.solve(np.column_stack([B, r]), np.zeros((len(u), 3)))
    information = B.T @ s
    N, told_v = _factor_information(information[:, :2], information[:, 2], nothing)
    W, S, A = _find_power(factor, sp.csr_array(T[:2, u]), len(r))
    rows = _factor_inverse(S) @ np.column_stack([W.T, A.T @ B - W.T @ dp, A.T @ r])
    Q, P = np.linalg.qr(rows[:, :2])
    R = np.block([[P, Q.T @ rows[:, 2:4]], [np.zeros((2, 2)), N]])
    return BoundaryInformation(R, R @ y + np.concatenate([Q.T @ rows[:, 4], told_v]))


def _find_power(factor: AugmentedFactor, C: sp.csr_array, n_rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is known of (p, q), with v given: W, S, (2, 2), and A, (rows, 2).

    S is the covariance of ``W'(p, q)``, and ``W'C du = A'r`` for residuals r. W turns the axes: beside a combination
    that is as good as unknown the other one would drown in rounding, so both are solved for by themselves.
    """
    W = np.eye(2)
    for _ in range(MOST_TURNS):
        A, du = factor.solve(np.zeros((n_rows, 2)), C.T @ W)
        S = -(W.T @ (C @ du))
        S = (S + S.T) / 2
        if S[0, 1] ** 2 <= abs(S[0, 0] * S[1, 1]) / 2:
            break
        W = W @ np.linalg.svd(S)[0]
    return W, S, A


def _responses_to_shift(
    model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: Mapping[str, BoundaryInformation], H: sp.csr_array
) -> tuple[np.ndarray, np.ndarray]:
    """How all rows H of ``_stack``, shape (rows, 2), and (p, q) at the boundary, shape (2, 2), answer to dv.

    dvm scales all voltages of the area alike, dva turns all its angles (but a reference): then powers answer with
    2 s / vm_b and 0 exactly. Moving bus b alone would change flows by dv / z and leave M, a difference of such
    changes, to rounding.
    """
    vm_b = float(x[model.voltage_columns(neighbour)[0]])
    fixed = np.setdiff1d(np.arange(model.size), model.free)
    rows = [np.column_stack([_degrees(model.kinds) * model.predict(x) / vm_b, model.kinds == MeasurementKind.VA])]
    for n in model.area.neighbours:
        y, T = model.boundary(x, n)
        dy = np.column_stack([y * (2.0, 2.0, 1.0, 0.0) / vm_b, (0.0, 0.0, 0.0, 1.0)])
        if n.area == neighbour.area:
            dp = dy[:2] - np.column_stack([np.zeros(2), T[:2, fixed].sum(axis=1)])
        elif (message := heard.get(n.area)) is not None:
            rows.append(message.R[_telling(message)] @ dy)
    B = np.concatenate(rows)
    B[:, 1] -= H[:, fixed].sum(axis=1)
    if model.voltage_columns(neighbour)[1] in fixed:  # the reference itself: it does not move
        B[:, 1] = dp[:, 1] = 0.0
    return B, dp


def _factor_information(M: np.ndarray, g: np.ndarray, nothing: float) -> tuple[np.ndarray, np.ndarray]:
    """N upper triangular and n with ``N'N = M``, ``N'n = g``; what of the (2, 2) information M is ``nothing`` is 0."""
    N, n = np.zeros((2, 2)), np.zeros(2)
    M = np.where(np.diag(M) > nothing, M, 0.0)
    if M[0, 0] > nothing:
        N[0] = M[0] / np.sqrt(M[0, 0])
        n[0] = g[0] / N[0, 0]
    rest = M[1, 1] - N[0, 1] ** 2
    if rest > max(nothing, ROUNDING * M[1, 1]):
        N[1, 1] = np.sqrt(rest)
        n[1] = (g[1] - N[0, 1] * n[0]) / N[1, 1]
    return N, n


def _factor_inverse(S: np.ndarray) -> np.ndarray:
    """P with ``P'P = S^-1`` for the (2, 2) covariance S.

    What is less certain comes first, then the other given it: p may be as good as unknown and still tell q, by the
    losses that it causes. A variance below zero is rounding of a number too large to be known: a row of 0.
    """
    least = EXACT_SIGMA**2
    first, other = (0, 1) if abs(S[0, 0]) >= abs(S[1, 1]) else (1, 0)
    P = np.zeros((2, 2))
    slope = 0.0
    if (unknown := S[first, first]) > 0:
        variance = max(unknown, least)
        slope = S[0, 1] / variance
        P[0, first] = 1 / np.sqrt(variance)
    rest = max(S[other, other] - slope * S[0, 1], least, ROUNDING * S[other, other])
    P[1, other], P[1, first] = np.array([1.0, -slope]) / np.sqrt(rest)
    return P


def _degrees(kinds: np.ndarray) -> np.ndarray:
    """The power k for which h grows as c^k when all voltages grow by c, shape (n_meas,)."""
    once = np.isin(kinds, (MeasurementKind.VM, MeasurementKind.CURRENT))
    return np.where(once, 1.0, np.where(kinds == MeasurementKind.VA, 0.0, 2.0))


def _stack(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
    """H, residual and sigma of the area's own measurements and of the messages ``heard``, up to four rows each."""
    H, r, sigma = [model.jacobian(x)], [model.residual(x)], [model.sigma]
    for n in model.area.neighbours:
        if (message := heard.get(n.area)) is not None:
            y, T = model.boundary(x, n)
            told = _telling(message)
            H.append(sp.csr_array(message.R[told] @ T))
            r.append(message.z[told] - message.R[told] @ y)
            sigma.append(np.ones(int(told.sum())))
    return sp.csr_array(sp.vstack(H, format="csr")), np.concatenate(r), np.concatenate(sigma)


def _telling(message: BoundaryInformation) -> np.ndarray:
    told: np.ndarray = abs(message.R).max(axis=1) > 0
    return told
