"""Consensus ADMM between areas: two sides of a boundary agree on its variables y by penalties.

Kekatos and Giannakis, Distributed Robust Power System State Estimation, IEEE Trans. Power Systems 28 (2013),
on the powers and voltages y of a boundary (``grid/boundary.py``) and with their multipliers eliminated: each side
minimises its own J plus ``1/2 |M^(1/2) (y - z)|^2`` at each of its boundaries, sends ``r = 2 y - z`` and takes the
other side's r into ``z <- z + relaxation (r - z)`` (Douglas-Rachford splitting; relaxation 1/2 is plain ADMM). At the
fixed point both y are equal and the gradients ``M (z - y)`` of the two sides cancel. That is the centralised estimate,
for any z at the start.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dsse_core.gauss_newton import MAX_DVM
from dsse_core.grid.meter_table import OF_POWER, QUANTITY
from dsse_core.grid.partition import Neighbour
from dsse_core.grid.quantities import Quantity
from dsse_core.linear.area_model import AreaModel
from dsse_core.linear.boundary_information import EXACT_SIGMA, BoundaryInformation
from dsse_core.linear.contributions import PRIOR_SIGMA

RELAXATION = 0.8  # 1/2 is plain ADMM; with 1 the iteration swings for ever where several children share a bus
VOLTMETER_SIGMA = 0.002  # p.u.; taken where an area has no voltmeter
POWER_METER_SIGMA = 0.01  # p.u.; taken where an area has no power meter
# A boundary's standard deviations are taken to lie above those of the area's meters divided by SPREAD; those of powers
# below the meters' times SPREAD, those of voltages below the meters' own.
SPREAD = 3.0


def compute_weight(model: AreaModel, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
    """The area's own information about each of the variables y, shape (d,), in units of which a penalty of 1 is good.

    The weight is the diagonal of ``L = R'R`` of the area's own meters alone, limited on both sides. Exact zero
    injections can make L infinite, and stiff penalties on both sides never move. An area without voltmeter knows
    nothing of vm.
    """
    R = model.linear.information(x, neighbour, {}).R
    power = _median_sigma(model, OF_POWER, POWER_METER_SIGMA)
    voltage = _median_sigma(model, QUANTITY == Quantity.VM, VOLTMETER_SIGMA)
    boundary = model.boundary_of(neighbour)
    largest = boundary.per_kind(SPREAD * power, SPREAD * power, voltage, voltage)
    least = boundary.per_kind(power, power, voltage, voltage) / SPREAD
    weight: np.ndarray = np.clip((R**2).sum(axis=0), largest**-2.0, least**-2.0)
    return weight


def solve_damped_step(model: AreaModel, x: np.ndarray, received: Mapping[str, BoundaryInformation]) -> np.ndarray:
    """The step dx, shape (size,), of ``(G + 1 / PRIOR_SIGMA^2) dx = b``, shortened to MAX_DVM at any voltage.

    Messages do not state the information of neighbours, so that transit power shows in losses only; undamped steps
    diverge.
    """
    dx = model.linear.step(x, received, PRIOR_SIGMA**-2.0)
    largest = float(abs(dx[: 2 * model.n_nodes]).max())
    return np.asarray(dx * min(1.0, MAX_DVM / max(largest, MAX_DVM)))


def pull(M: np.ndarray, z: np.ndarray) -> BoundaryInformation:
    """The penalty ``1/2 |M^(1/2) (y - z)|^2`` as information about y; ``M`` (d,) is diagonal, 0 leaves y alone."""
    root = np.sqrt(M)
    return BoundaryInformation(np.diag(root), root * z)


def _median_sigma(model: AreaModel, is_wanted: np.ndarray, default: float) -> float:
    """Median sigma of the area's real meters; ``default`` without such a meter. ``is_wanted``: of each of KINDS."""
    chosen = model.sigma[is_wanted[model.kinds] & (model.sigma > EXACT_SIGMA)]
    return float(np.median(chosen)) if chosen.size else default
