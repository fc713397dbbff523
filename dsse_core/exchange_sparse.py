"""The numbers of the exact exchange by sparse factorisation, for any area; see ``exchange`` for what they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from dsse_core.area_model import PRIOR_SIGMA, AreaModel, Matrix
from dsse_core.augmented import AugmentedFactor
from dsse_core.augmented_dense import DenseFactor
from dsse_core.boundary_information import (
    NOTHING_OF_VOLTAGE,
    ROUNDING,
    VA,
    BoundaryInformation,
    factor_information,
    factor_inverse,
    put_together,
)
from dsse_core.partition import Neighbour

NOT_YET = 1e-6  # information given to eliminated voltages that nothing determines yet
NOT_YET_OF_POWER = 1e-8  # the same of powers, which may be large
NO_LOAD_NOT_YET = 1e-18  # the same in the no-load model, relative to what the rows tell where that is less than 1
DRAWS = 32  # of which the mean square is a fifth of its expectation with a probability of 1e-7
NOTHING = 1e-30  # for variables that no row speaks of
MOST_TURNS = 4  # of the axes of (p, q)
DEGREES_OF_BOUNDARY = np.array([2.0, 2.0, 1.0, 0.0])  # the power k for which y grows as c^k, see AreaModel.degrees


def solve_damped(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], damping: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """The step dx, shape (size,), of ``(G + D) dx = b - pull``; ``damping``, diag(D), and ``pull`` (free,)."""
    H, r, sigma = stack_rows(model, x, heard)
    dx = np.zeros(model.size)
    dx[model.free] = factor_rows(H[:, model.free], sigma, damping).solve(r, pull)[1]
    return dx


def state_variance(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], damping: np.ndarray
) -> np.ndarray:
    """diag of ``(G + D)^-1``, shape (size,); ``damping`` (free,): the diagonal of D."""
    H, _, sigma = stack_rows(model, x, heard)
    variance = np.zeros(model.size)
    variance[model.free] = factor_rows(H[:, model.free], sigma, damping).state_variance()
    return variance


def variances(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[np.ndarray, np.ndarray]:
    """diag(G^-1), shape (size,), and diag(Omega) of the area's own measurements, shape (n_meas,) (eq. 3.22)."""
    H, _, sigma = stack_rows(model, x, heard)
    factor = _factor_undamped(model, H, sigma, model.free)
    of_state = np.zeros(model.size)
    of_state[model.free] = factor.state_variance()
    return of_state, factor.residual_variance()[: len(model.z)]


def sample_redundancy(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], rng: np.random.Generator
) -> np.ndarray:
    """diag(Omega) / sigma^2 of the area's own measurements, shape (n_meas,), from residuals of random readings.

    With S = Omega / (sigma sigma') a projection, readings of variance 1 leave residuals of variance S_ii: as the mean
    square of DRAWS of them it is found to a factor of two or so, and 0 to the square of round-off.
    """
    H, _, sigma = stack_rows(model, x, heard)
    factor = _factor_undamped(model, H, sigma, model.free)
    readings = sigma[:, None] * rng.standard_normal((len(sigma), DRAWS))
    s = factor.solve(readings, np.zeros((len(model.free), DRAWS)))[0][: len(model.z)]
    return np.asarray(((model.sigma[:, None] * s) ** 2).mean(axis=1))


def least_information(model: AreaModel, columns: np.ndarray) -> np.ndarray:
    """The damping of variables that nothing determines yet, shape of ``columns``."""
    return np.where(columns < 2 * len(model.area.network.buses), NOT_YET, NOT_YET_OF_POWER)


def factor_rows(H: Matrix, sigma: np.ndarray, damping: np.ndarray) -> AugmentedFactor | DenseFactor:
    if isinstance(H, np.ndarray):
        return DenseFactor(H, sigma, damping)
    return AugmentedFactor(sp.csr_array(H), sigma, damping)


def _factor_undamped(
    model: AreaModel, H: Matrix, sigma: np.ndarray, columns: np.ndarray
) -> AugmentedFactor | DenseFactor:
    """The factor of some columns of H, damped only where nothing determines a variable yet."""
    H = H[:, columns]
    if not model.no_load:
        return factor_rows(H, sigma, least_information(model, columns))
    H = _without_rounding(H)
    told = np.asarray((H * H).T @ sigma**-2.0)
    return factor_rows(H, sigma, np.where(told > 0, NO_LOAD_NOT_YET * np.minimum(told, 1.0), NOTHING))


def _without_rounding(H: Matrix) -> Matrix:
    """H with entries of 0 where rounding has left something of a derivative that is nothing.

    An angle meter must not seem to tell a magnitude: undetermined variables would be damped by 1e22 times less than
    others, and beside such an uncertainty whatever else is known of (p, q) drowns.
    """
    if isinstance(H, np.ndarray):
        size = abs(H)
        return np.where(size > ROUNDING * size.max(axis=1, keepdims=True, initial=0.0), H, 0.0)
    row = np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))
    size = abs(H.data)
    largest = np.zeros(H.shape[0])
    np.maximum.at(largest, row, size)
    return sp.csr_array((np.where(size > ROUNDING * largest[row], H.data, 0.0), H.indices, H.indptr), shape=H.shape)


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
    H, r, sigma = stack_rows(model, x, heard)
    B, dp = _responses_to_shift(model, x, neighbour, heard, H)
    y, T = model.boundary(x, neighbour)
    u = model.eliminated[neighbour.area]
    C = T[:2, u]
    factor = _factor_undamped(model, H, sigma, u)
    above, below = np.zeros((len(r), 5)), np.zeros((len(u), 5))
    above[:, :2], above[:, 2], below[:, 3:] = B, r, _full(C).T
    s, du = factor.solve(above, below)
    information = B.T @ s[:, :3]
    nothing = 0.0 if model.no_load else NOTHING_OF_VOLTAGE
    N, told_v = factor_information(information[:, :2], information[:, 2], nothing)
    W, S, A = _find_power(factor, C, s[:, 3:], du[:, 3:])
    P = factor_inverse(S)
    return put_together(y, P @ W.T, P @ (A.T @ B - W.T @ dp), P @ (A.T @ r), (N, told_v))


def _find_power(
    factor: AugmentedFactor | DenseFactor, C: Matrix, A: np.ndarray, du: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is known of (p, q), with v given: W, S, (2, 2), and A, (rows, 2).

    S is the covariance of ``W'(p, q)``, and ``W'C du = A'r`` for residuals r. W turns the axes: beside a combination
    that is as good as unknown the other one would drown in rounding, so both are solved for by themselves. ``A``,
    ``du``: the solution for W = 1.
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


def _responses_to_shift(
    model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: Mapping[str, BoundaryInformation], H: Matrix
) -> tuple[np.ndarray, np.ndarray]:
    """How all rows H of ``stack_rows``, shape (rows, 2), and (p, q) at the boundary, shape (2, 2), answer to dv.

    dvm scales all voltages of the area alike, dva turns all its angles (but a reference): then powers answer with
    2 s / vm_b and 0 exactly. Moving bus b alone would change flows by dv / z and leave M, a difference of such
    changes, to rounding.
    """
    (vm_column, va_column), fixed, m = model.voltage_columns(neighbour), model.fixed, len(model.z)
    vm_b = float(x[vm_column])
    B = np.zeros((H.shape[0], 2))
    B[:m, 0], B[model.angles, 1] = model.degrees * model.predict(x) / vm_b, 1.0
    dy, dp = np.zeros((4, 2)), np.zeros((2, 2))
    dy[VA, 1] = 1.0
    end = m
    for n in model.area.neighbours:
        dy[:, 0] = model.boundary_values(x, n) * DEGREES_OF_BOUNDARY / vm_b
        if n.area == neighbour.area:
            dp[:, 0], dp[:, 1] = dy[:2, 0], -model.boundary(x, n)[1][:2, fixed].sum(axis=1)
        elif (message := heard.get(n.area)) is not None:
            first, end = end, end + len(message.rows[0])
            B[first:end] = message.rows[0] @ dy
    if model.prior is not None:
        n_bus = len(model.area.network.buses)
        B[end : end + n_bus, 1], B[end + n_bus :, 0] = 1.0, x[n_bus : 2 * n_bus] / vm_b
    if fixed.size:
        B[:, 1] -= H[:, fixed].sum(axis=1)
        if va_column in fixed:  # the reference itself: it does not move
            B[:, 1] = dp[:, 1] = 0.0
    return B, dp


def stack_rows(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[Matrix, np.ndarray, np.ndarray]:
    """H, residual and sigma of the area's own measurements and of the messages ``heard``, up to four rows each."""
    if model.dense:
        told = [(*heard[n.area].rows, *model.boundary(x, n)) for n in model.area.neighbours if n.area in heard]
        H: Matrix = np.concatenate([model.jacobian(x), *(R @ T for R, _, _, T in told)])
        r = np.concatenate([model.residual(x), *(z - R @ y for R, z, y, _ in told)])
    else:
        rows, of_messages = _stack_messages(model, x, heard)
        H = sp.csr_array(sp.vstack([model.jacobian(x), rows], format="csr"))
        r = np.concatenate([model.residual(x), of_messages])
    sigma = np.ones(len(r))
    sigma[: len(model.z)] = model.sigma
    return (H, r, sigma) if model.prior is None else _with_prior(model, model.prior, x, H, r, sigma)


def _with_prior(
    model: AreaModel, prior: np.ndarray, x: np.ndarray, H: Matrix, r: np.ndarray, sigma: np.ndarray
) -> tuple[Matrix, np.ndarray, np.ndarray]:
    """The rows of ``stack_rows`` and one for each voltage, angles first, that ``prior`` gives."""
    n_voltages = 2 * len(model.area.network.buses)
    rows = sp.eye_array(n_voltages, model.size, format="csr")
    r = np.concatenate([r, (prior - x)[:n_voltages]])
    sigma = np.concatenate([sigma, np.full(n_voltages, PRIOR_SIGMA)])
    if isinstance(H, np.ndarray):
        return np.concatenate([H, rows.toarray()]), r, sigma
    return sp.csr_array(sp.vstack([H, rows], format="csr")), r, sigma


def _stack_messages(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[sp.csr_array, np.ndarray]:
    """Rows and residual of the messages ``heard`` alone; all sparse rows at once, as an area may have many children."""
    rows: list[tuple[np.ndarray, np.ndarray]] = []  # numbers, and the columns that they belong to
    r = [np.zeros(0)]
    for n in model.area.neighbours:
        if (message := heard.get(n.area)) is None:
            continue
        R, z = message.rows
        if n.is_parent:
            y, T = model.boundary(x, n)
            rows.append((np.asarray(R @ T), np.arange(model.size)))
        else:
            columns = np.array(model.boundary_columns(n))
            y = x[columns]
            rows.append((R, columns))
        r.append(z - R @ y)
    if not rows:
        return sp.csr_array((0, model.size)), r[0]
    told = [part != 0 for part, _ in rows]
    data = np.concatenate([part[is_told] for (part, _), is_told in zip(rows, told, strict=True)])
    at = np.concatenate([np.broadcast_to(columns, k.shape)[k] for (_, columns), k in zip(rows, told, strict=True)])
    ends = np.cumsum(np.concatenate([[0], *(is_told.sum(axis=1) for is_told in told)]))
    return sp.csr_array((data, at, ends), shape=(len(ends) - 1, model.size)), np.concatenate(r)


def _full(C: Matrix) -> np.ndarray:
    return C if isinstance(C, np.ndarray) else np.asarray(C.toarray())
