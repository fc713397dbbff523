"""The iteration at one boundary of strategy ``admm``: whose turn it is, what is taken in, what is sent.

A boundary's iterations are counted by both its sides. A side goes on to iteration k + 1 when it has sent and received
iteration k, or when the other side is there already; so each side uses every r of the other exactly once, whatever
is lost, repeated or overtaken: a message carries this r and the one before, and the two sides are never further
apart than that. A side that is, because it has restarted, goes on from what it receives: the fixed point does not
depend on how it was reached.

Of two sides that are at the same iteration the owner goes first, and then each message is an answer that brings the
next step along: half as many messages as when both send at a time, and no longer a way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from agents.messages.boundary_variables import find_wrong_length
from agents.messages.checks import Count, Names, Numbers
from agents.messages.packing import BoundaryUpdate
from dsse_core.exchange.consensus_admm import RELAXATION, pull
from dsse_core.grid.boundary import Boundary, Kind, boundary_of, find_wrong_name
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.boundary_information import BoundaryInformation

MOVED = 1e-10  # p.u., rad: what of z or r is worth another iteration


@dataclass(frozen=True, slots=True)
class AdmmMessage(BoundaryUpdate):
    """What the sender states in its ``iteration`` at a boundary: ``r = 2 y - z`` of its d ``variables`` y.

    ``r_before``: that of the iteration before, should its message have been lost. ``weight``: the sender's own
    information about each of y, which the penalty is a multiple of. ``referenced``: the sender's side knows the
    substation's angle.
    """

    kind: ClassVar[str] = "admm"
    variables: Names = field(kw_only=True)
    iteration: Count
    r: Numbers
    r_before: Numbers
    weight: Numbers
    unsettled: bool
    referenced: bool

    def find_misfit(self) -> str:
        """What fields cannot be together; empty if they can."""
        if wrong := find_wrong_name(self.variables):
            return wrong
        boundary = boundary_of(self.variables)
        lengths = {name: (len(getattr(self, name)), (boundary.d,)) for name in ("r", "r_before", "weight")}
        return find_wrong_length(boundary, lengths)

    def falsified(self, falsify: Callable[[Numbers], Numbers]) -> Self:
        return replace(self, r=falsify(self.r), r_before=falsify(self.r_before))


class BoundaryIteration:
    """One side of the ``boundary`` to ``neighbour``, with d variables y.

    ``k``: number of the iteration. ``z`` (d,): what y is pulled to, None before anything is received. ``sent``,
    ``sent_before`` (d,): r of iterations k and k - 1. ``weight`` (d,): the area's own information about y.
    ``angle_known``: whether this side, without the neighbour, knows the substation's angle.
    ``unsettled``: whether z was still moving in the step to iteration k.
    """

    def __init__(self, neighbour: Neighbour, boundary: Boundary) -> None:
        self.neighbour = neighbour
        self.boundary = boundary
        self.is_angle = np.isin(np.arange(boundary.d), boundary.places[Kind.VA])
        self.weight = np.ones(boundary.d)
        self.angle_known = False
        self.received: AdmmMessage | None = None
        self.k = 0
        self.z: np.ndarray | None = None
        self.sent = self.sent_before = np.zeros(boundary.d)
        self.unsettled = True
        self._defers = False  # to the owner, which knows that it is to go first

    @property
    def angle_received(self) -> bool:
        """Whether the neighbour's side knows the substation's angle; if not, the boundary's is none of its business."""
        return self.received is not None and self.received.referenced

    @property
    def angle_to_follow(self) -> float | None:
        """The boundary's angle where only the neighbour's side knows it: then it is taken, not negotiated."""
        follows = self.angle_received and not self.angle_known
        return float(self.z[self.is_angle][0]) if follows and self.z is not None else None

    @property
    def terms(self) -> tuple[object, ...]:
        """What the pull depends on beside z."""
        return (self.weight.tolist(), self.received and self.received.weight, self.angle_received, self.angle_known)

    @property
    def is_owed(self) -> bool:
        """Whether it is the turn of the neighbour, which has sent before."""
        return self.received is not None and self.received.iteration < self.k + self._defers

    def pull(self, penalty: float) -> BoundaryInformation | None:
        """The penalty on the area's y; None before anything is received."""
        if self.received is None or self.z is None:
            return None
        M = penalty * np.maximum(self.weight, self.received.weight)
        return pull(np.where(self.is_angle & (not self.angle_received), 0.0, M), self.z)

    def step(self, y: np.ndarray) -> bool:
        """Go on to the next iteration, if it is this side's turn and worth it; ``y`` (d,): the area's at present."""
        if self.received is None or self.is_owed:
            return False
        ahead = self.received.iteration - self.k
        r = np.array(self.received.r_before if ahead == 1 else self.received.r)
        moves = self.z is None or self._distance(r, self.z) > MOVED
        invited = self.received.unsettled and not self.neighbour.is_parent
        if ahead == 0 and not (moves or invited or abs(self._reflect(y) - self.sent).max() > MOVED):
            return False
        self.k = self.received.iteration if ahead > 1 else self.k + 1
        self.z = r.copy() if self.z is None or ahead > 1 else self.z + RELAXATION * (r - self.z)
        if not self.angle_known:
            self.z[self.is_angle] = r[self.is_angle]
        self.unsettled, self._defers = moves, False
        return True

    def set_sent(self, y: np.ndarray) -> None:
        """Settle what is sent of this iteration, for which the area has found ``y`` (d,)."""
        self.sent_before, self.sent = self.sent, self._reflect(y)

    def note_sent(self) -> None:
        """What is sent is on its way."""
        self._defers = self.unsettled and self.neighbour.is_parent

    def _distance(self, a: np.ndarray, b: np.ndarray) -> float:
        return float(np.where(self.is_angle & (not self.angle_received), 0.0, abs(a - b)).max())

    def _reflect(self, y: np.ndarray) -> np.ndarray:
        return y if self.z is None else np.where(self.is_angle & (not self.angle_received), y, 2 * y - self.z)
