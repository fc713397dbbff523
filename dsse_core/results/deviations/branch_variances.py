"""Variances of powers, currents and losses of a branch, from the covariance of power and voltage at one of its ends.

With the power ``S = p + j q`` into the branch and the voltage ``u`` at end k, o the other end, angles from k:

``v_o = (conj(S) / u - ykk u) / yko``, ``i_o = yoo conj(S) / (yko u) - det u / yko``, ``s_o = v_o conj(i_o)``.

No term is a difference of large numbers, however short the branch. With voltages at both ends terms would be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.grid.quantities import CURRENT_FLOOR
from dsse_core.results.flows import BranchModel


@dataclass(frozen=True)
class BranchGradients:
    """Derivatives of the quantities of each branch by p, q and ln u at one of its ends, shape (n_branch, 3) each.

    ``near``, ``far``: complex powers at that end and at the other; ``i_near``, ``i_far``: magnitudes of currents, nan
    where there is none; ``loss``: complex, near + far.
    """

    near: np.ndarray
    far: np.ndarray
    i_near: np.ndarray
    i_far: np.ndarray
    loss: np.ndarray


def find_gradients(branches: BranchModel, at_from: np.ndarray, s: np.ndarray, u: np.ndarray) -> BranchGradients:
    """The gradients by the end that ``at_from`` (n_branch,) names, True for from.

    ``s``, ``u`` (n_branch,): complex power and magnitude of the voltage there, p.u.
    """
    of = branches.two_ports
    yko = np.where(branches.in_service, np.where(at_from, of.yft, of.ytf), 1.0)
    ykk, yoo = (np.where(at_from, y, z) for y, z in ((of.yff, of.ytt), (of.ytt, of.yff)))
    i_near = s.conj() / u
    v_far = i_near / yko, -(ykk / yko) * u  # the parts that go with 1 / u and with u
    i_far = yoo / yko * i_near, -(of.det / yko) * u
    of_current = np.stack([1 / u, -1j / u, -i_near], axis=-1)  # di_near by p, q and ln u
    dv = of_current / yko[:, None]
    di = of_current * (yoo / yko)[:, None]
    dv[:, 2] += v_far[1]
    di[:, 2] += i_far[1]
    v, i = sum(v_far), sum(i_far)
    near = np.broadcast_to(np.array([1.0, 1j, 0.0]), dv.shape)
    far = dv * i.conj()[:, None] + v[:, None] * di.conj()
    return BranchGradients(
        near, far, differentiate_magnitude(i_near, of_current), differentiate_magnitude(i, di), near + far
    )


def differentiate_magnitude(i: np.ndarray, di: np.ndarray) -> np.ndarray:
    """The derivatives of |i|, (n, k), for those of the currents ``i`` (n,), complex; nan where no current flows."""
    size = np.where(abs(i) > CURRENT_FLOOR, abs(i), np.nan)[:, None]
    return np.asarray((i.conj()[:, None] * di).real / size)


def find_branch_variances(
    branches: BranchModel, at_from: np.ndarray, gradients: BranchGradients, covariance: np.ndarray
) -> np.ndarray:
    """Variances of P, Q, I at the from end, of P, Q, I at the to end, and of the loss, P and Q: (8, n_branch), p.u.

    ``covariance`` (n_branch, 3, 3): of p, q and ln u at the end that ``at_from`` names. 0 out of service.
    """
    near, far, loss = gradients.near, gradients.far, gradients.loss
    rows = [near.real, near.imag, gradients.i_near, far.real, far.imag, gradients.i_far, loss.real, loss.imag]
    found = np.stack([np.einsum("ki,kij,kj->k", row, covariance, row) for row in rows])
    swapped = found[[3, 4, 5, 0, 1, 2, 6, 7]]
    return np.where(branches.in_service, np.maximum(np.where(at_from, found, swapped), 0.0), 0.0)
