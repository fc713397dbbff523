"""By how much an area turns all its angles, so that they count from the substation and as its neighbours' do.

Angles that nothing ties to the substation may be turned together at no cost; and full turns mean nothing.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import replace

import numpy as np

from dsse_core.area_model import AreaModel
from dsse_core.boundary_information import VA, BoundaryInformation
from dsse_core.measurement import MeasurementKind
from dsse_core.partition import Neighbour

TINY = 1e-30
LEAST_OF_ANGLE = np.pi**-2.0  # 1/rad^2: who knows an angle worse than half a turn knows nothing of it
FULL_TURN = 2 * np.pi


def turn(model: AreaModel, x: np.ndarray, angle: float) -> np.ndarray:
    """The state ``x`` with ``angle`` (rad) added to all its angles."""
    is_angle = np.arange(len(x)) < len(model.area.network.buses)
    return np.asarray(x + angle * is_angle)


def knows_angle(heard: BoundaryInformation) -> bool:
    """Whether what a neighbour says of the boundary's angle means anything; before it has heard all, it may not."""
    of_angle = heard.R[:, VA]
    return bool(of_angle @ of_angle >= LEAST_OF_ANGLE)


def find_turn_to_neighbour(model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: BoundaryInformation) -> float:
    """By how much ``neighbour`` would have us turn all angles, power and magnitude as they are, rad."""
    y = model.boundary_values(x, neighbour)
    of_angle = heard.R[:, VA]
    return float(of_angle @ (heard.z - heard.R @ y) / max(of_angle @ of_angle, TINY))


def find_turn_to_angle_meter(model: AreaModel, x: np.ndarray) -> float:
    """An angle meter too says where the substation's zero is, where the area does not see it; else 0, rad."""
    angles = np.flatnonzero(model.kinds == MeasurementKind.VA)
    if not angles.size or model.area.reference is not None:
        return 0.0
    most_exact = angles[np.argmin(model.sigma[angles])]
    return float(model.residual(x)[most_exact])


def agree_on_full_turns(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], referenced: Container[str]
) -> tuple[float, dict[str, BoundaryInformation]]:
    """Angles mean the same with 2 pi added: as the parent counts them, and children are read as we count.

    By how much to turn ``x``, and ``heard`` as it reads then. ``referenced``: neighbours whose angles count from the
    substation.
    """
    angle, agreed = 0.0, dict(heard)
    for n in sorted(model.area.neighbours, key=lambda n: not n.is_parent):
        if n.area not in referenced:
            continue
        told = heard[n.area]
        turns = round(find_turn_to_neighbour(model, x, n, told) / FULL_TURN)
        if turns and n.is_parent:
            angle = FULL_TURN * turns
            x = turn(model, x, angle)
        elif turns:
            agreed[n.area] = replace(told, z=told.z - FULL_TURN * turns * told.R[:, VA])
    return angle, agreed
