"""What each neighbour is to hear of this side, computed anew only where that changes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dsse_core.area_model import AreaModel
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange import compute_information
from dsse_core.measurement import MeasurementKind
from dsse_core.partition import Neighbour

# p.u., rad: what it is told at. Between the ends of a short branch are 1e-4 p.u.: of these it is one part in a million.
SAME_STATE = 1e-10
# The same, where the state moves ever less, the next time by less than SAME_NEXT. With current magnitudes it may not:
# they bend so much that their residuals count, and each answer is a share of the last.
SAME_MESSAGE = 1e-7
SAME_NEXT = 1e-10  # p.u., rad


@dataclass(frozen=True)
class _Computed:
    """``information`` after the messages ``others`` of all but its addressee."""

    others: Mapping[str, BoundaryInformation]
    information: BoundaryInformation


class InformationToTell:
    """``moved``: neighbour -> how far the state had moved, p.u. and rad, when it was last computed for it."""

    def __init__(self) -> None:
        self.moved: dict[str, float] = {}
        self._at: dict[str, np.ndarray] = {}  # neighbour -> the state at which that was
        self._computed: dict[str, _Computed] = {}

    def forget(self) -> None:
        """New readings: nothing of what was computed holds."""
        self._computed = {}

    def find(
        self, model: AreaModel, x: np.ndarray, neighbour: Neighbour, heard: Mapping[str, BoundaryInformation]
    ) -> BoundaryInformation:
        """What was computed last, where neither the others' messages nor, but for rounding, the state has changed."""
        name = neighbour.area
        others = {other: message for other, message in heard.items() if other != name}
        before, at = self.moved.get(name, np.inf), self._at.get(name, np.zeros(0))
        moved = float(abs(x - at).max()) if at.shape == x.shape else np.inf
        if (last := self._computed.get(name)) is not None:
            ends = moved <= SAME_MESSAGE and moved * moved <= SAME_NEXT * before < np.inf
            ends = ends and MeasurementKind.CURRENT not in model.kinds
            if (moved <= SAME_STATE or ends) and _are_same(last.others, others):
                return last.information
        self.moved[name], self._at[name] = moved, x
        information = compute_information(model, x, neighbour, heard)
        self._computed[name] = _Computed(others, information)
        return information


def _are_same(some: Mapping[str, BoundaryInformation], others: Mapping[str, BoundaryInformation]) -> bool:
    if some.keys() != others.keys():
        return False
    return all((heard.R == others[name].R).all() and (heard.z == others[name].z).all() for name, heard in some.items())
