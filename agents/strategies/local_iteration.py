"""An area's own steps between two messages: damped Gauss-Newton with its neighbours' information in.

It ends where a further step would change nothing. Neighbours are told earlier: once the state is as good as there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agents.strategies.angle_turns import turn
from dsse_core.area_model import AreaModel
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange import DAMPING, solve_step, solve_step_near, solve_steps
from dsse_core.kept_factor import ON_THE_WAY, KeptFactor, find_rest
from dsse_core.measurement import MeasurementKind

SETTLED_STEP = 1e-11  # p.u., rad: below it a further step changes nothing
TOLD_EARLY = 1e-6  # p.u., rad: after a smaller step neighbours are told, further ones change nothing of it
SETTLED_NEAR_START = 1e-6  # p.u., rad: while news is missing
STEPS_PER_NEWS = 40
UPHILL = 10.0  # times what the meters say against a state, and their number: a step that ends higher is halved
LEAST_SHARE = 1 / 64  # of a step
FULL_STEPS = 10  # at once; what takes longer swings around the answer, and half steps settle it

Heard = Mapping[str, BoundaryInformation]


class LocalIteration:
    """``x``: the state, shape (size,), p.u. and rad. ``steps_left``: until news is needed to go on."""

    def __init__(self) -> None:
        self.x = np.zeros(0)
        self.steps_left = 0
        self._start = self.x  # where the last one has ended, or the power flow before the first
        self._last_step = np.inf
        self._factor: KeptFactor | None = None
        self._is_released = False  # a state that rests on the newest messages, for neighbours to be told
        self._by_halves = False

    def begin_at(self, x: np.ndarray) -> None:
        """Start from state ``x``."""
        self.x = self._start = x

    def turn(self, model: AreaModel, angle: float) -> None:
        """Add ``angle`` (rad) to all angles."""
        if angle:
            self.x, self._start = turn(model, self.x, angle), turn(model, self._start, angle)

    def take_news(self, *, by_halves: bool = False) -> None:
        """From here to where readings and messages, some of which are new, lead.

        ``by_halves``: half a step, as where to all areas lead each other would swing.
        """
        self._by_halves = by_halves
        self._is_released = False
        if not by_halves:
            self._last_step = np.inf
        self.steps_left = 1 if by_halves else STEPS_PER_NEWS

    def go_on(self) -> None:
        """If the steps for the last news were not enough, there is time for more now."""
        if self.steps_left == 0 and self._last_step > ON_THE_WAY:
            self.steps_left = 1 if self._by_halves else STEPS_PER_NEWS

    def stop(self) -> None:
        """Take no step until there is news."""
        self.steps_left = 0

    def step(self, model: AreaModel, heard: Heard) -> bool:
        """One step or all that one factor serves for; whether neighbours should be told the state now."""
        self.steps_left -= 1
        dx, sizes = self._solve(model, heard)
        self.x = _with_positive_magnitudes(self.x + dx, len(model.area.network.buses))
        rest = find_rest([self._last_step, *sizes])
        self._last_step = sizes[-1]
        if rest <= SETTLED_STEP:
            self.steps_left = 0
            self._start = self.x
        if self.steps_left > 0 and (self._is_released or self._last_step > TOLD_EARLY):
            return False
        self._is_released = True
        return True

    def _solve(self, model: AreaModel, heard: Heard) -> tuple[np.ndarray, list[float]]:
        """All that one factor serves for, as far as it does not lead uphill; or half a step after too many."""
        if not self._by_halves and self.steps_left >= STEPS_PER_NEWS - FULL_STEPS:
            dx, sizes, self._factor = solve_steps(model, self.x, heard, self._last_step, SETTLED_STEP, self._factor)
            share = _find_share(model, self.x, dx, heard)
            return (dx, sizes) if share == 1 else (share * dx, [share * float(abs(dx).max())])
        dx = solve_step(model, self.x, heard, self._last_step) / 2
        return dx, [float(abs(dx).max(initial=0.0))]

    def step_near_start(self, model: AreaModel, heard: Heard) -> np.ndarray:
        """One step that the start guides while news is missing; what the area can say before all have been heard.

        Messages do not rest on that: half of the news misleads. What leads farther from the start than that is
        uncertain, misleads, too: all linearised there would end at voltages of next to nothing, and stay.
        """
        self.steps_left = 0
        self.x = x = self._unless_far(model, self._near_start(model, self.x, heard))
        for _ in range(FULL_STEPS):
            before, x = x, self._near_start(model, x, heard)
            if abs(x - before).max(initial=0.0) <= SETTLED_NEAR_START:
                break
        return self._unless_far(model, x)

    def _unless_far(self, model: AreaModel, x: np.ndarray) -> np.ndarray:
        """``x``, or the start where that is farther away than it is uncertain, or ``x`` no numbers."""
        voltages = slice(2 * len(model.area.network.buses))
        return x if abs(x - self._start)[voltages].max() <= DAMPING else self._start

    def _near_start(self, model: AreaModel, x: np.ndarray, heard: Heard) -> np.ndarray:
        step = solve_step_near(model, x, heard, self._start)
        return _with_positive_magnitudes(x + step, len(model.area.network.buses))


def _find_share(model: AreaModel, x: np.ndarray, dx: np.ndarray, heard: Heard) -> float:
    """How much of ``dx`` to go, in halves: with current magnitudes a step may lead far up from next to the minimum.

    Virtual measurements are not looked at: they are known so well that any step of a nonlinear grid offends them.
    """
    if MeasurementKind.CURRENT not in model.kinds:
        return 1.0
    limit, share = UPHILL * (_find_cost(model, x, heard) + len(model.z)), 1.0
    while share > LEAST_SHARE and not _find_cost(model, x + share * dx, heard) <= limit:
        share /= 2
    return share


def _find_cost(model: AreaModel, x: np.ndarray, heard: Heard) -> float:
    """What real meters and neighbours' information say against ``x``, chi-squared."""
    cost = float((((model.residual(x) / model.sigma)[~model.virtual]) ** 2).sum())
    for n in model.area.neighbours:
        if (message := heard.get(n.area)) is not None:
            cost += float(((message.R @ model.boundary_values(x, n) - message.z) ** 2).sum())
    return cost


def _with_positive_magnitudes(x: np.ndarray, n: int) -> np.ndarray:
    """The same phasors: a step may have led through zero."""
    through_zero = np.flatnonzero(x[n : 2 * n] < 0)
    x[n + through_zero] *= -1
    x[through_zero] += np.pi
    return x
