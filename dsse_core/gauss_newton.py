"""Step control of the Gauss-Newton iteration, numbers in, numbers out.

``decision.decide`` runs these functions as they stand here; the compiled loops on trees run the same source, compiled.
"""

from __future__ import annotations

import math

import numpy as np

# Gauss-Newton needs 3 to 6 steps. An iteration that takes longer swings around the answer or creeps towards it, as all
# do where current magnitudes are in use. ``choose_share`` then says how far a step goes.
FULL_STEPS = 10
MOST_STEPS = 50  # of one iteration; then it begins again at the flat start, and takes as many
MOST_SHARE = 8.0  # of a step that creeps; one that swings is taken to its inverse at least
FLOWS_KNOWN = 1e-4  # p.u. and rad; after a smaller step current magnitudes are used
LARGEST_STEP = 1e6  # p.u. or rad; beyond it the iteration has left every state of interest
# A longer step is shortened: a dead voltmeter must not throw all voltages to zero, where nothing converges.
MAX_DVM = 0.2  # p.u.
MAX_DVA = 1.0  # rad
FARTHEST_DVM = MOST_STEPS * MAX_DVM  # p.u.: all steps of a start, each as long as allowed, lead no farther
# The end, see ``next_step``; p.u. and rad but for the rate.
LAST_STEP = 1e-5  # the largest last step
REST = 1e-9  # the largest distance from the minimum after it
SLOWEST_RATE = 0.1  # only a smaller rate tells the size of the coming step
# A smaller rate does not last: quadratic convergence ends, and bad data and current magnitudes then set a rate of their
# own. Without this bound 3 of 1000 grids with gross errors were left 2e-8 from the minimum.
LEAST_RATE = 0.01
# Curvature that the last step has met moves J, and sets the coming rate. On IEEE 13 steps of 1e-5 with a rate of 0.002
# moved J by 0.005 to 0.7 of its limit; the rate after them was 0.05 to 0.5. On balanced feeders J moves by 0.002.
RATE_BY_J = 0.25
NO_STEP = 1e-10  # after a smaller step no other follows, whatever the step before was
# Share of the chi-square limit: a J so near to the limit is found more exactly before the verdict. On 500 random grids
# J at the verdict is at most 1e-5 of the limit from J at the end. Good readings of 100,000 buses have a J within 0.8 %
# of the limit.
NEAR_LIMIT = 1e-3

GO_ON, SHORTEN, USE_CURRENTS, FINAL, EVALUATE, LOST = range(6)  # verdicts on an iteration

# vm and va in network order, the residuals z - h(x), (n_meas,), J(x), and how many steps the iteration took.
Solution = tuple[np.ndarray, np.ndarray, np.ndarray, float, int]


def correct_step(share: float, stepped: bool, flows_known: bool, dva: float, dvm: float) -> tuple[int, float]:
    """The verdict on the step just taken, and its share of the Gauss-Newton step: GO_ON where it stands.

    LOST: it leads to no state. SHORTEN: of the step only the returned share is taken. USE_CURRENTS: flows are
    known, and current magnitudes are in use from now on.

    Args:
        share: the share of the Gauss-Newton step that was taken.
        stepped: the step is not corrected yet, and is not the last step.
        flows_known: current magnitudes are in use, or there are none.
        dva, dvm: largest change of an angle, rad, and of a magnitude, p.u., in the whole Gauss-Newton step.
    """
    largest = max(dva, dvm)
    if not largest <= LARGEST_STEP:
        return LOST, 0.0
    if stepped:
        most = 1.0 / max(1.0 / share, dva / MAX_DVA, dvm / MAX_DVM)
        if most < share:
            return SHORTEN, most
        if not flows_known and largest < FLOWS_KNOWN:
            return USE_CURRENTS, share
    return GO_ON, share


def is_out_of_reach(dvm: float) -> bool:
    """True where a step changes a magnitude by more, ``dvm`` p.u., than all shortened steps of a start, or by nan."""
    return not dvm <= FARTHEST_DVM


def are_magnitudes(vm: np.ndarray) -> bool:
    """True where all of ``vm``, p.u., are known to be above 0.

    A negative one is an image of a state at which an iteration that went astray can settle.
    """
    return bool(vm.min() > REST)


def choose_share(
    steps: int, uses_currents: bool, share_before: float, square_before: float, square: float, turn: float
) -> float:
    """The share of the Gauss-Newton step that is taken next, by what the last two steps d_1 and d_2 have in common.

    Where convergence is linear the steps shrink as ``d_2 = (1 - share_1 M) d_1``. A share of 1 / m takes away the part
    of the error that belongs to the eigenvalue m of M. That of the largest part is found as Aitken does it: the share
    minimises ``|d_1 - share (d_1 - d_2) / share_1|``. So a swing (m > 2, a turn back) is shortened, and an iteration
    that creeps (m << 1) is drawn out. Current magnitudes set such eigenvalues: Gauss-Newton knows their curvature
    across the current only where the current is as read. Sums of all areas are known, so all choose the same share.

    Args:
        steps: number of steps taken since the start.
        uses_currents: current magnitudes are in use. Without them only late steps are shortened or drawn out.
        share_before: share_1.
        square_before, square, turn: d_1'd_1, d_2'd_2 and d_1'd_2 of all voltages, p.u. and rad. The first is 0 where
            the two cannot be compared.
    """
    is_late = steps >= FULL_STEPS
    if square_before <= 0.0:
        return 0.5 if is_late else 1.0  # after a step that was shortened, most of all where no start leads to an end
    if square < SLOWEST_RATE * SLOWEST_RATE * square_before or not (uses_currents or is_late):
        return 1.0
    along, change = share_before * (square_before - turn), square_before - 2.0 * turn + square
    if along <= 0.0 or along >= MOST_SHARE * change:
        return MOST_SHARE
    grid = MOST_SHARE * MOST_SHARE  # centre and areas round sums to the same share
    return max(1.0 / MOST_SHARE, math.floor(grid * along / change + 0.5) / grid)


def next_step(
    steps: int,
    share: float,
    stepped: bool,
    before: float,
    largest: float,
    flows_known: bool,
    with_currents: bool,
    objective: float,
    change: float,
    limit: float,
    tolerance: float,
    most_steps: int,
    coming: float,
) -> tuple[int, float, float]:
    """The verdict at a state that needs no correction, the share of the coming step, and the next ``before``.

    FINAL: the coming step is the last and is taken in full. EVALUATE: the same, but J is not below its limit. GO_ON:
    more steps are to come. LOST: the steps are used up.

    The end follows from the steps that were taken. Where convergence is linear the coming step is rate * largest. The
    rate is largest / before, but LEAST_RATE at least, and RATE_BY_J times the root of |change| / limit. The coming step
    must be below ``tolerance``, and the distance left after it, rate^2 * largest, below REST. Where convergence is
    quadratic, both are far less. With current magnitudes it is linear: the coming step itself must be below REST. A
    step below REST that is no shorter than the one before is rounding, and ends the iteration, too. The gain of a step
    is no measure: with short branches and small sigmas it lies below rounding. A J near its limit must lie farther from
    it than the last step has moved J.

    Args:
        steps: number of steps taken since the start.
        share: the share of the last Gauss-Newton step that was taken.
        stepped: the last step is not corrected.
        before, largest: size of the last step but one and of the last step, by their largest entry. ``before`` is 0
            where the two cannot be compared: other shares, or current magnitudes in only one of them.
        flows_known: current magnitudes are in use, or there are none.
        with_currents: current magnitudes are in use.
        objective, limit: J at the state, and its chi-square limit.
        change: of J by the last step; counts with ``before`` only.
        tolerance: the most that the last step may move, p.u. and rad, where convergence is linear.
        most_steps: limit of ``steps``.
        coming: share of the coming step if more are to come, see ``choose_share``.
    """
    if stepped and flows_known:
        is_last = largest < NO_STEP or 0.0 < before <= largest < REST
        if not is_last and largest < SLOWEST_RATE * before:
            rate = max(largest / before, LEAST_RATE, RATE_BY_J * math.sqrt(abs(change) / limit))
            is_last = rate * largest < tolerance and (rate if with_currents else rate * rate) * largest < REST
            is_last = is_last and abs(objective - limit) >= min(NEAR_LIMIT * limit, abs(change))
        if is_last:
            return (EVALUATE if objective >= limit else FINAL), 1.0, 0.0
    if steps >= most_steps:
        return LOST, 0.0, 0.0
    return GO_ON, coming, largest if stepped and coming == share else 0.0
