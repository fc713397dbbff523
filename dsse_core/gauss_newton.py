"""The numbers of a Gauss-Newton iteration that ``decision`` decides by, and the compiled iteration on a tree, too."""

from __future__ import annotations

import numpy as np

# Gauss-Newton needs 3 to 6 steps; what takes longer swings around the answer, as current magnitudes make it
# do that are as uncertain as they are large, and half steps settle it.
FULL_STEPS = 10
MOST_STEPS = 25  # of one iteration; then it begins anew at the flat start, where
MOST_STEPS_ANEW = 100  # are taken: half steps may shrink by a rate of 0.8 only, and NO_STEP is then 60 away
FLOWS_KNOWN = 1e-4  # p.u. and rad; after a smaller step current magnitudes are used
LARGEST_STEP = 1e6  # p.u. or rad; beyond it the iteration has left every state of interest
# A longer step is shortened: a dead voltmeter must not throw all voltages to zero, where nothing converges.
MAX_DVM = 0.2  # p.u.
MAX_DVA = 1.0  # rad
# The end, see ``is_last``; p.u. and rad but for the rate.
LAST_STEP = 1e-5  # what the last step may be
REST = 2e-9  # what may be left after it
SLOWEST_RATE = 0.1  # a rate says what is to come only where it is small
# Nor does a smaller one last: what is quadratic ends, and then bad data and current magnitudes set a rate of their own.
# Without it 3 of 1000 grids with gross errors were left 2e-8 from the minimum.
LEAST_RATE = 0.01
NO_STEP = 1e-10  # after a smaller step nothing is to come, whatever the one before was
# Of the chi-square limit: J so near to it is found more exactly first. On 500 random grids the J that is decided by was
# at most 1e-5 of the limit from that at the end; of good readings of 100,000 buses J is within 0.8 % of the limit.
NEAR_LIMIT = 1e-3
SURE_STEP = 1e-9  # p.u. and rad: after a smaller step J is as exact as it gets

# vm and va in network order, the residuals z - h(x), (n_meas,), J(x), and how many steps the iteration took.
Solution = tuple[np.ndarray, np.ndarray, np.ndarray, float, int]


def is_last(step: float, before: float, with_currents: bool, tolerance: float) -> bool:
    """Whether the step to come is the last one, evaluated by the two taken before it, each by its largest entry.

    ``before`` is 0 where there is no such step: the two must have been taken with the same share of their length and
    both with or both without current magnitudes. Where convergence is linear the step to come is rate * step, rate =
    step / before but LEAST_RATE at least, and must be below ``tolerance``; what is left after it, rate^2 * step, below
    REST. Where convergence is quadratic, both are far less. With current magnitudes it is linear: the step to come
    itself must be below REST. What a step gains is not asked: with short branches and small sigmas that lies below
    rounding.
    """
    if step < NO_STEP:
        return True
    if not step < SLOWEST_RATE * before:
        return False
    rate = max(step / before, LEAST_RATE)
    return rate * step < tolerance and (rate if with_currents else rate * rate) * step < REST
