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

import numpy as np

from dsse_core import exchange_sparse as sparse
from dsse_core.area_model import AreaModel
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange_sparse import NOT_YET, NOT_YET_OF_POWER, least_information
from dsse_core.partition import Neighbour

DAMPING = 0.3  # tau, p.u. and rad
LARGEST_STEP = 0.1  # p.u. and rad, of any voltage


def solve_whole_step(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """The Gauss-Newton step of the whole grid, shape (size,), where ``heard`` is all that is known beyond the area."""
    if model.tree and (dx := model.tree.step(x, heard, (NOT_YET, NOT_YET_OF_POWER), x)) is not None:
        return dx
    return sparse.solve_damped(model, x, heard, least_information(model, model.free), np.zeros(len(model.free)))


def solve_damped_step(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """The step dx, shape (size,), ``(G + D) dx = b``, D = 1 / tau^2 for all variables, of LARGEST_STEP at most.

    Where messages do not tell what neighbours know, undamped steps diverge: transit power is seen through losses only.
    """
    damping = np.maximum(np.full(len(model.free), DAMPING**-2.0), least_information(model, model.free))
    return _shorten(model, sparse.solve_damped(model, x, heard, damping, np.zeros(len(damping))))


def _shorten(model: AreaModel, dx: np.ndarray) -> np.ndarray:
    """The part of the step that moves no voltage by more than LARGEST_STEP."""
    largest = float(abs(dx[: 2 * len(model.area.network.buses)]).max())
    return np.asarray(dx * min(1.0, LARGEST_STEP / max(largest, LARGEST_STEP)))


def state_variance(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """diag(G^-1) with all messages in, shape (size,): at the fixed point that of the centralised estimate."""
    if model.tree and (found := model.tree.variances(x, heard, (NOT_YET, NOT_YET_OF_POWER))) is not None:
        return found[0]
    return sparse.state_variance(model, x, heard, least_information(model, model.free))


def find_variances(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]
) -> tuple[np.ndarray, np.ndarray]:
    """``state_variance`` and, shape (n_meas,), diag(Omega) of the area's own measurements (eq. 3.22)."""
    if model.tree and (found := model.tree.variances(x, heard, (NOT_YET, NOT_YET_OF_POWER))) is not None:
        return found
    return sparse.variances(model, x, heard)


def compute_information(
    model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: Mapping[str, BoundaryInformation]
) -> BoundaryInformation:
    """What ``neighbour`` is to hear: everything but y eliminated, its own message left out."""
    if model.tree and (told := model.tree.information(x, neighbour, heard)) is not None:
        return told
    return sparse.compute_information(model, x, neighbour, heard)
