"""H of an estimate as a dense array, for references by dense algebra."""

import numpy as np

from dsse_core.estimation.result import EstimationResult


def rows_of(result: EstimationResult) -> np.ndarray:
    """H(x) at the state of ``result``, columns of the variables that are unknown, (n_meas, n_free)."""
    linear = result.linear
    return linear.rows.jacobian(np.concatenate([result.va, result.vm])).toarray()[:, linear.model.free]
