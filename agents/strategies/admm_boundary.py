"""The iteration at one boundary of strategy ``admm``: turns of the two sides, received and sent variables.

Both sides of a boundary count its iterations. A side goes on to iteration k + 1 when it has sent and received
iteration k, or when the other side is there already. So each side uses every r of the other exactly once, even if
messages are lost, repeated or overtaken: a message carries this r and the one before, and the two sides are never
further apart than that. A side that is further apart, because it has restarted, goes on from the r it receives: the
fixed point does not depend on the way to it.

Of two sides at the same iteration the owner goes first. Then each message is an answer that brings the next step
along. This takes half as many messages as when both sides send at the same time, and no more time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from agents.messages.boundary_arrays import Variables, find_wrong_length
from agents.messages.checks import Count, Numbers
from agents.messages.packing import BoundaryUpdate
from dsse_core.exchange.consensus_admm import RELAXATION, pull
from dsse_core.gauss_newton import NO_STEP
from dsse_core.grid.boundary import Boundary, Kind, boundary_of, find_wrong_name
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.boundary_information import BoundaryInformation


@dataclass(frozen=True, slots=True)
class AdmmMessage(BoundaryUpdate):
    """Message of the sender's ``iteration`` at a boundary: ``r = 2 y - z`` of its d ``variables`` y.

    ``r_before``: r of the iteration before, in case its message was lost. ``weight``: the sender's own information
    about each of y; the penalty is a multiple of it. ``unsettled``: the sender's z still moved in the step to
    ``iteration``. ``referenced``: the sender's side knows the substation's angle.
    """

    kind: ClassVar[str] = "admm"
    variables: Variables = field(kw_only=True)
    iteration: Count
    r: Numbers
    r_before: Numbers
    weight: Numbers
    unsettled: bool
    referenced: bool

    def find_misfit(self) -> str:
        """Sentence about names or lengths that contradict each other; empty if all fit."""
        if wrong := find_wrong_name(self.variables):
            return wrong
        boundary = boundary_of(self.variables)
        lengths = {name: (len(getattr(self, name)), (boundary.d,)) for name in ("r", "r_before", "weight")}
        return find_wrong_length(boundary, lengths)

    def falsified(self, falsify: Callable[[Numbers], Numbers]) -> Self:
        return replace(self, r=falsify(self.r), r_before=falsify(self.r_before))


class BoundaryIteration:
    """One side of the ``boundary`` to ``neighbour``, with d variables y.

    ``k``: number of the iteration. ``z`` (d,): the target that y is pulled to, None before anything is received.
    ``sent``, ``sent_before`` (d,): r of iterations k and k - 1. ``weight`` (d,): the area's own information about y.
    ``angle_known``: True where this side, without the neighbour, knows the substation's angle.
    ``unsettled``: True where z still moved in the step to iteration k.
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
        self._defers = False  # to the owner, the parent, which goes first

    @property
    def angle_received(self) -> bool:
        """True where the neighbour's side knows the substation's angle; else the boundary's angle exerts no pull."""
        return self.received is not None and self.received.referenced

    def find_turn(self, y: np.ndarray) -> float:
        """Turn of all angles of an area with ``y`` (d,) at which the pull on them adds up to 0.

        Where only the neighbour's side knows the boundary's angles, the area takes them over; elsewhere the turn is 0.
        """
        if self.z is None or not self.angle_received or self.angle_known:
            return 0.0
        return float(self._angle_shares @ (self.z - y))

    @property
    def terms(self) -> tuple[object, ...]:
        """Terms of the pull beside z."""
        return (self.weight.tolist(), self.received and self.received.weight, self.angle_received, self.angle_known)

    @property
    def is_owed(self) -> bool:
        """True where it is the turn of the neighbour, which has sent before."""
        return self.received is not None and self.received.iteration < self.k + self._defers

    def pull(self, penalty: float) -> BoundaryInformation | None:
        """The penalty on the area's y; None before anything is received."""
        if self.received is None or self.z is None:
            return None
        pulled = pull(penalty * self._joint_weight, self.z)
        if self.angle_received:
            return pulled
        R = pulled.R @ (np.eye(len(self.z)) - np.outer(self.is_angle, self._angle_shares))
        return BoundaryInformation(R, R @ self.z)  # it leaves a turn of all angles alone: in balanced grids the angle

    def step(self, y: np.ndarray) -> bool:
        """Go on to the next iteration, if it is this side's turn and worth it; True if so. ``y`` (d,): of the area."""
        if self.received is None or self.is_owed:
            return False
        ahead = self.received.iteration - self.k
        r = np.array(self.received.r_before if ahead == 1 else self.received.r)
        moves = self.z is None or self._distance(r, self.z) > NO_STEP
        invited = self.received.unsettled and not self.neighbour.is_parent
        if ahead == 0 and not (moves or invited or abs(self._reflect(y) - self.sent).max() > NO_STEP):
            return False
        self.k = self.received.iteration if ahead > 1 else self.k + 1
        self.z = r.copy() if self.z is None or ahead > 1 else self.z + RELAXATION * (r - self.z)
        if not self.angle_known:
            self.z[self.is_angle] = (r + self._without_turn(self.z - r))[self.is_angle]
        self.unsettled, self._defers = moves, False
        return True

    def set_sent(self, y: np.ndarray) -> None:
        """Set r of this iteration, for which the area has found ``y`` (d,)."""
        self.sent_before, self.sent = self.sent, self._reflect(y)

    def note_sent(self) -> None:
        """Note that r is on its way; a child whose z still moved then waits for its parent, the owner."""
        self._defers = self.unsettled and self.neighbour.is_parent

    def _distance(self, a: np.ndarray, b: np.ndarray) -> float:
        return float(abs(a - b if self.angle_received else self._without_turn(a - b)).max())

    def _reflect(self, y: np.ndarray) -> np.ndarray:
        if self.z is None:
            return y
        is_turned = self.is_angle & (not self.angle_received)
        reflected: np.ndarray = np.where(is_turned, y + self._without_turn(y - self.z), 2 * y - self.z)
        return reflected

    @property
    def _joint_weight(self) -> np.ndarray:
        """Weight of both sides (d,), the same on both once they have messages of each other."""
        return self.weight if self.received is None else np.maximum(self.weight, self.received.weight)

    @property
    def _angle_shares(self) -> np.ndarray:
        """Shares (d,) of angles in their mean, by the weight of both sides; 0 of other variables."""
        weight = self._joint_weight * self.is_angle
        shares: np.ndarray = weight / weight.sum()
        return shares

    def _without_turn(self, difference: np.ndarray) -> np.ndarray:
        """``difference`` (d,) with angles that have the mean 0: a turn of all angles makes no difference."""
        without: np.ndarray = difference - self.is_angle * (self._angle_shares @ difference)
        return without
