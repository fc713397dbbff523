"""Taps that the readings contradict: for each branch with ``tap_steps`` its tap as one more variable, in steps.

With ``s`` by how much one step moves the residuals r, and ``P`` the weights of that part of r which no state explains,
the multiplier ``s'P r`` has the variance ``M = s'P s`` under noise alone. So ``|s'P r| / M^(1/2)`` is the normalised
residual of the tap, and ``s'P r / M`` is the estimate of the steps by which it is off.
"""

from __future__ import annotations

import math

import numpy as np

from dsse_core.estimation.residuals import CRITICAL_REDUNDANCY, THRESHOLD, name_tap
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.area_model import with_tap
from dsse_core.linear.interface import Received
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows


def find_wrong_taps(model: AreaMeasurements, x: np.ndarray, received: Received) -> dict[str, float]:
    """``name_tap`` of each tap that stands out by a step or more -> its normalised residual, with THRESHOLD beside it.

    So a meter is removed only where it explains THRESHOLD^2 more of J than any tap: the voltmeter alone behind a tap
    explains as much as the tap.

    ``received``: the information of neighbours at ``x``. No other area needs to know of the tap. One that nothing
    checks, as a critical meter, is left out.
    """
    if not (branches := model.area.network.with_tap_steps):
        return {}
    solver = _on_rows(model)
    H, r, sigma = solver.stack(x, received)
    s = np.zeros((len(r), len(branches)))
    for k, branch in enumerate(branches):
        ends = (with_tap(model, branch.id, branch.tap + step) for step in (-branch.tap_steps, branch.tap_steps))
        below, above = (_on_rows(end).stack(x, received)[1] for end in ends)
        s[:, k] = (below - above) / 2
    weighted = s[: len(model.z)] / np.where(model.virtual, np.inf, model.sigma)[:, None]
    least = CRITICAL_REDUNDANCY * np.vecdot(weighted.T, weighted.T)
    left = solver.factor(H, sigma, model.free).solve(s, np.zeros((len(model.free), len(branches))))[0]
    multiplier, M, found = left.T @ r, np.vecdot(s.T, left.T), {}
    for k in np.flatnonzero(least < M).tolist():
        steps, normalized = round(multiplier[k] / M[k]), float(abs(multiplier[k]) / np.sqrt(M[k]))
        if steps and normalized > THRESHOLD:
            found[name_tap(branches[k].id, steps)] = math.hypot(normalized, THRESHOLD)
    return found


def _on_rows(model: AreaMeasurements) -> TableauSolver:
    return TableauSolver(model, SparseRows(model), "sparse")
