"""Standard deviations of what follows from an estimate, by its covariance; chosen by the estimate's back end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.estimation.estimator import EstimationResult
from dsse_core.results.branch_variances import find_branch_variances, find_gradients
from dsse_core.results.flows import BranchModel, build_branch_model, find_flows


@dataclass(frozen=True)
class Deviations:
    """Standard deviations in p.u. and rad. ``vm``, ``va`` (n_bus,). ``branches`` (8, n_branch): P, Q, I at the from
    end, P, Q, I at the to end, losses P and Q; of a current that does not flow nan. ``injections`` (2, n_bus): P, Q.
    """

    vm: np.ndarray
    va: np.ndarray
    branches: np.ndarray
    injections: np.ndarray


def find_deviations(result: EstimationResult, branches: BranchModel | None = None) -> Deviations:
    """Of all that follows from the estimate, linearised at its state; ``branches``: of its network, if there already.

    Radial back end: O(n_bus). Sparse: about the time of one more factorisation with four more unknowns per branch.
    """
    branches = branches or build_branch_model(result.network)
    v = result.vm * np.exp(1j * result.va)
    flows = find_flows(branches, v[branches.f], v[branches.t])
    if isinstance(result.plan.radial, str):
        from dsse_core.results.sparse_deviations import find_sparse_covariances

        at_from = np.ones(len(branches.f), dtype=bool)
        covariance = np.zeros((len(branches.f), 3, 3))
        covariance[branches.in_service], injections = find_sparse_covariances(result)
        gradients = find_gradients(branches, at_from, flows.s_from, result.vm[branches.f])
    else:
        from dsse_core.results.radial_deviations import RadialDeviations

        tree = RadialDeviations(result.plan.radial, branches, result.sigmas, result.vm, result.va)
        at_from, covariance = tree.at_from, tree.of_branches(len(branches.f))
        s = np.where(at_from, flows.s_from, flows.s_to)
        gradients = find_gradients(branches, at_from, s, result.vm[np.where(at_from, branches.f, branches.t)])
        injections = tree.of_injections(gradients)
    of_branches = find_branch_variances(branches, at_from, gradients, covariance)
    vm, va = result.state_sigma()
    return Deviations(vm, va, np.sqrt(of_branches), np.sqrt(injections))
