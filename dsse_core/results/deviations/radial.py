"""Covariances of quantities that follow from the state of a tree, from its selected inverse; letters as in
``radial.kernel``.

Given the multipliers and the voltage of a bus, z = (lam, x), the powers into the branches below it are independent of
each other: ``f_c = -X_c z`` and a rest with the covariance ``V_c = (D_c^-1)_ff``. So the sum of any of them has the
covariance ``sum V_c + (sum X_c) S (sum X_c)'``.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.estimation.radial import RadialInverse
from dsse_core.estimation.residuals import LEAST_REDUCTION
from dsse_core.radial.plan import RadialPlan
from dsse_core.results.deviations.branch_variances import BranchGradients
from dsse_core.results.flows import BranchModel


class RadialDeviations:
    """Covariances on the tree of ``plan``, by its selected ``inverse`` at vm (n_bus,), network order."""

    def __init__(self, plan: RadialPlan, branches: BranchModel, inverse: RadialInverse, vm: np.ndarray) -> None:
        self._plan, self._vm, self._inverse = plan, vm, inverse
        f, t = plan.number[branches.f], plan.number[branches.t]
        self.at_from = plan.parent[t] == f  # of branches in service: whether the from side is above
        self._child = np.where(self.at_from, t, f)[branches.in_service]
        self._branch = np.flatnonzero(branches.in_service)
        self._X = inverse.factor[:, :16].reshape(-1, 4, 4)
        self._XS = self._X @ inverse.S[plan.parent]
        self._ff = self._XS[:, 2:] @ self._X[:, 2:].transpose(0, 2, 1) + self._X[:, 2:, :2]

    def of_branches(self, n_branch: int) -> np.ndarray:
        """Covariance of p, q and ln u at the end above of each branch, (n_branch, 3, 3); 0 out of service."""
        covariance = np.zeros((n_branch, 3, 3))
        covariance[self._branch] = self._at_parent(self._child)
        return covariance

    def _at_parent(self, child: np.ndarray) -> np.ndarray:
        """Covariance of p, q and ln u at the end above of the branches over the buses ``child`` (k,), by number,
        (k, 3, 3); numbers without meaning for the root, which has no such branch.
        """
        found = np.empty((len(child), 3, 3))
        found[:, :2, :2] = self._ff[child]
        found[:, :2, 2] = found[:, 2, :2] = -self._XS[child, 2:, 3]
        found[:, 2, 2] = self._inverse.S[self._plan.parent[child], 3, 3]
        return found

    def of_sums(self, by_ends: sp.csr_array, by_buses: sp.csr_array) -> np.ndarray:
        """Variances of sums, (n_sum,), with the derivatives ``by_ends`` (n_sum, 3 n_branch), by p, q and ln u at the
        ends above of branches, and ``by_buses`` (n_sum, n_bus), by ln vm.
        """
        from dsse_core.radial.inverse import find_variances_of_sums

        child, n = self._child, len(self._plan.parent)
        columns = np.full((by_ends.shape[1] // 3, 3), -1)
        columns[self._branch] = np.stack([3 * child, 3 * child + 1, 3 * self._plan.parent[child] + 2], axis=1)
        of_ends = by_ends.data, columns.ravel()[by_ends.indices], by_ends.indptr
        of_buses = by_buses.data, 3 * self._plan.number[by_buses.indices] + 2, by_buses.indptr
        whole = sp.csr_array(of_ends, shape=(by_ends.shape[0], 3 * n))
        whole = sp.csr_array(whole + sp.csr_array(of_buses, shape=whole.shape))
        inverse = self._inverse
        at = self._plan.parent, inverse.weights, inverse.factor, inverse.more, inverse.S[0]
        found: np.ndarray = find_variances_of_sums(*at, whole.indptr, whole.indices, whole.data)
        return found

    def of_injections(self, gradients: BranchGradients) -> np.ndarray:
        """Variances of P and Q that the buses inject, (2, n_bus), network order, p.u."""
        plan, inverse = self._plan, self._inverse
        n, R = len(plan.parent), inverse.weights[:, 2:4]
        metered = R - inverse.omega[:, 2:4]
        by_meter = (R >= 0) & (metered >= LEAST_REDUCTION * R)
        others = np.flatnonzero(~by_meter.all(axis=1))
        metered[others] = np.where(by_meter[others], metered[others], self._by_branches(gradients, others))
        found = np.empty((2, n))
        found[:, plan.order] = np.maximum(metered, 0.0).T
        return found

    def _by_branches(self, gradients: BranchGradients, buses: np.ndarray) -> np.ndarray:
        """Variances, (k, 2), of the sum of the powers into the branches below each of ``buses`` (k,), by number, into
        the branch above it and into its shunt.
        """
        plan, S = self._plan, self._inverse.S[buses]
        place = np.full(len(plan.parent), -1)
        place[buses] = np.arange(len(buses))
        X, V = np.zeros((len(buses), 2, 4)), np.zeros((len(buses), 2))
        below = 1 + np.flatnonzero(place[plan.parent[1:]] >= 0)
        above = place[plan.parent[below]]
        np.add.at(X, above, self._X[below, 2:])
        np.add.at(V, above, np.stack([self._X[below, 2, 0], self._X[below, 3, 1]], axis=1))
        XS = X @ S
        shunt = 2 * plan.admittance[buses, 7] * self._vm[plan.order[buses]] ** 2
        h = np.stack([shunt.real, shunt.imag], axis=1)
        own, own_z = self._at_own_end(gradients, buses)
        total = own + V + np.einsum("nij,nij->ni", XS, X) + h**2 * S[:, 3, 3][:, None]
        total += 2 * (h * (own_z[:, :, 3] - XS[:, :, 3]) - np.einsum("nij,nij->ni", own_z, X))
        return np.asarray(total)

    def _at_own_end(self, gradients: BranchGradients, buses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variances, (k, 2), of the powers into the branch above each of ``buses`` (k,), at the bus, and their
        covariance with z of the bus, (k, 2, 4); 0 at the root.
        """
        branch = np.full(len(self._plan.parent), -1)
        branch[self._child] = self._branch
        far = np.append(gradients.far, np.zeros((1, 3)), axis=0)[branch[buses]]
        G, C = np.stack([far.real, far.imag], axis=1), self._at_parent(buses)
        return np.einsum("nij,njk,nik->ni", G, C, G), G @ self._with_z(C, buses)

    def _with_z(self, C: np.ndarray, buses: np.ndarray) -> np.ndarray:
        """Covariance of (f, dvm_p / vm_p) of each of ``buses`` (k,) with its own z = (lam, x), (k, 3, 4)."""
        inverse, X, XS = self._inverse, self._X[buses], self._XS[buses]
        t0, t1, qr, qi = inverse.factor[buses, 20:].T
        one, none = np.ones_like(t0), np.zeros_like(t0)
        T, Z = (np.stack(of, axis=1).reshape(-1, 2, 2) for of in ([one, none, t0, t1], [-qi, qr, -qr, -qi]))  # T', Z'
        found = np.empty((len(X), 3, 4))
        found[:, :2, :2] = XS[:, 2:] @ X[:, :2].transpose(0, 2, 1) + X[:, :2, :2].transpose(0, 2, 1)
        found[:, 2, :2] = -XS[:, :2, 3]
        with_parent = -XS[:, 2:, 2:], inverse.S[self._plan.parent[buses], 3, 2:][:, None]
        found[:, :2, 2:] = with_parent[0] @ T + self._ff[buses] @ Z
        found[:, 2:, 2:] = with_parent[1] @ T + C[:, 2:, :2] @ Z
        found[:, :, :2] *= (inverse.weights[buses, 2:4] >= 0)[:, None]  # no meter, no multiplier
        return found
