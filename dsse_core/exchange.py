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
from dsse_core.kept_factor import KeptFactor, solve_steps_anew, solve_steps_on
from dsse_core.partition import Neighbour

DAMPING = 0.3  # tau, p.u. and rad: undamped steps diverge while transit power is seen through losses only
LARGEST_STEP = 0.1  # p.u. and rad, of any voltage
SMALL_STEP = 1e-3  # p.u. and rad; after a smaller one the damping falls in proportion


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
    less = min(1.0, last_step / SMALL_STEP)
    if not powers_too and model.tree:
        of_voltage = max(DAMPING**-2.0 * less, NOT_YET)
        if (dx := model.tree.step(x, heard, (of_voltage, NOT_YET_OF_POWER), x)) is not None:
            return _shorten(model, dx)
    most = np.full(len(model.free), DAMPING**-2.0) if powers_too else _damping(model)
    damping = np.maximum(most * less, least_information(model, model.free))
    return _shorten(model, sparse.solve_damped(model, x, heard, damping, np.zeros(len(damping))))


def solve_whole_step(model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """The Gauss-Newton step of the whole grid, shape (size,), where ``heard`` is all that is known beyond the area."""
    if model.tree and (dx := model.tree.step(x, heard, (NOT_YET, NOT_YET_OF_POWER), x)) is not None:
        return dx
    return sparse.solve_damped(model, x, heard, least_information(model, model.free), np.zeros(len(model.free)))


def solve_steps(
    model: AreaModel,
    x: np.ndarray,
    heard: Mapping[str, BoundaryInformation],
    last_step: float,
    enough: float,
    kept: KeptFactor | None,
) -> tuple[np.ndarray, list[float], KeptFactor | None]:
    """``solve_step`` and what follows on its factor, or all of it on the one ``kept`` before, where that serves.

    Their sum dx, max |dx| of each, and the factor. ``enough``: no further step where it is expected to be smaller. On
    the tree a factor costs no more than a step.
    """
    if model.tree:
        dx = solve_step(model, x, heard, last_step)
        return dx, [float(abs(dx).max(initial=0.0))], None
    if kept is not None and (solved := solve_steps_on(kept, model, x, heard, enough)) is not None:
        return solved
    damping = np.maximum(_damping(model) * min(1.0, last_step / SMALL_STEP), least_information(model, model.free))
    dx, sizes, kept = solve_steps_anew(model, x, heard, damping, enough)
    return _shorten(model, dx), sizes, kept


def solve_step_near(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], start: np.ndarray
) -> np.ndarray:
    """The step dx, shape (size,), where news is missing: ``start`` counts as measured, all voltages with sigma tau.

    Without it losses alone would tell what the missing neighbours should, and the state would run away.
    """
    if model.tree:
        dx = model.tree.step(x, heard, (DAMPING**-2.0, NOT_YET_OF_POWER), start)
        if dx is not None:
            return _shorten(model, dx)
    damping = _damping(model)
    return _shorten(model, sparse.solve_damped(model, x, heard, damping, damping * (x - start)[model.free]))


def _shorten(model: AreaModel, dx: np.ndarray) -> np.ndarray:
    """The part of the step that moves no voltage by more than LARGEST_STEP."""
    largest = float(abs(dx[: 2 * len(model.area.network.buses)]).max())
    return np.asarray(dx * min(1.0, LARGEST_STEP / max(largest, LARGEST_STEP)))


def _damping(model: AreaModel) -> np.ndarray:
    """Of voltages; nobody knows beforehand how large powers are."""
    return np.where(model.free < 2 * len(model.area.network.buses), DAMPING**-2.0, NOT_YET_OF_POWER)


def state_variance(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], *, near_start: bool = False
) -> np.ndarray:
    """diag(G^-1) with all messages in, shape (size,): at the fixed point that of the centralised estimate.

    ``near_start``: with the start as a measurement, as in ``solve_step_near``.
    """
    if model.tree:
        damping_on_tree = (DAMPING**-2.0 if near_start else NOT_YET, NOT_YET_OF_POWER)
        if (found := model.tree.variances(x, heard, damping_on_tree)) is not None:
            return found[0]
    damping = _damping(model) if near_start else least_information(model, model.free)
    return sparse.state_variance(model, x, heard, damping)


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
