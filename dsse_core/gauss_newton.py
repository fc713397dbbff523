"""Step control of the Gauss-Newton iteration, numbers in, numbers out.

``decision.decide`` runs these functions as they stand here; the compiled loops on trees run the same source, compiled.
"""

from __future__ import annotations

import numpy as np

# Gauss-Newton needs 3 to 6 steps. An iteration that takes longer swings around the answer, as it does by current
# magnitudes with sigmas as large as their values. Half steps settle it.
FULL_STEPS = 10
MOST_STEPS = 25  # of one iteration; then it begins again at the flat start
MOST_STEPS_ANEW = 100  # of the iteration that begins again: half steps may shrink by 0.8 each, 60 of them to NO_STEP
FLOWS_KNOWN = 1e-4  # p.u. and rad; after a smaller step current magnitudes are used
LARGEST_STEP = 1e6  # p.u. or rad; beyond it the iteration has left every state of interest
# A longer step is shortened: a dead voltmeter must not throw all voltages to zero, where nothing converges.
MAX_DVM = 0.2  # p.u.
MAX_DVA = 1.0  # rad
FARTHEST_DVM = MOST_STEPS_ANEW * MAX_DVM  # p.u.: all steps of a start, each as long as allowed, lead no farther
# The end, see ``next_step``; p.u. and rad but for the rate.
LAST_STEP = 1e-5  # the largest last step
REST = 2e-9  # the largest distance from the minimum after it; after a step as small J is as exact as it gets
SLOWEST_RATE = 0.1  # only a smaller rate tells the size of the coming step
# A smaller rate does not last: quadratic convergence ends, and bad data and current magnitudes then set a rate of their
# own. Without this bound 3 of 1000 grids with gross errors were left 2e-8 from the minimum.
LEAST_RATE = 0.01
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


def next_step(
    steps: int,
    share: float,
    stepped: bool,
    before: float,
    largest: float,
    flows_known: bool,
    with_currents: bool,
    objective: float,
    limit: float,
    tolerance: float,
    most_steps: int,
) -> tuple[int, float, float]:
    """The verdict at a state that needs no correction, the share of the coming step, and the next ``before``.

    FINAL: the coming step is the last and is taken in full. EVALUATE: the same, but J is not below its limit. GO_ON:
    more steps are to come. LOST: the steps are used up.

    The end follows from the steps that were taken. Where convergence is linear the coming step is rate * largest, with
    rate = largest / before but LEAST_RATE at least. It must be below ``tolerance``, and the distance left after it,
    rate^2 * largest, below REST. Where convergence is quadratic, both are far less. With current magnitudes it is
    linear: the coming step itself must be below REST. The gain of a step is no measure: with short branches and small
    sigmas it lies below rounding.

    Args:
        steps: number of steps taken since the start.
        share: the share of the last Gauss-Newton step that was taken.
        stepped: the last step is not corrected.
        before, largest: size of the last step but one and of the last step, by their largest entry. ``before`` is 0
            where the two cannot be compared: other shares, or current magnitudes in only one of them.
        flows_known: current magnitudes are in use, or there are none.
        with_currents: current magnitudes are in use.
        objective, limit: J at the state, and its chi-square limit.
        tolerance: the most that the last step may move, p.u. and rad, where convergence is linear.
        most_steps: limit of ``steps``.
    """
    if stepped and flows_known and (largest <= REST or abs(objective - limit) >= NEAR_LIMIT * limit):
        is_last = largest < NO_STEP
        if not is_last and largest < SLOWEST_RATE * before:
            rate = max(largest / before, LEAST_RATE)
            is_last = rate * largest < tolerance and (rate if with_currents else rate * rate) * largest < REST
        if is_last:
            return (EVALUATE if objective >= limit else FINAL), 1.0, 0.0
    if steps >= most_steps:
        return LOST, 0.0, 0.0
    coming = 1.0 if steps < FULL_STEPS else 0.5
    return GO_ON, coming, largest if stepped and coming == share else 0.0
