"""What both back ends of the estimate share: which steps are shortened, and when the iteration has ended."""

from __future__ import annotations

import numpy as np

# Gauss-Newton needs 3 to 6 steps; what takes longer swings around the answer, as current magnitudes make it
# do that are as uncertain as they are large, and half steps settle it.
FULL_STEPS = 10
FLOWS_KNOWN = 1e-4  # p.u. and rad; after a smaller step current magnitudes are used
LARGEST_STEP = 1e6  # p.u. or rad; beyond it the iteration has left every state of interest
# A longer step is shortened: a dead voltmeter must not throw all voltages to zero, where nothing converges.
MAX_DVM = 0.2  # p.u.
MAX_DVA = 1.0  # rad
# Of the degrees of freedom, that is, of what J is on average: what the last step may still gain, |H dx|^2 in units of
# sigma. It is the squared norm of the gradient in the metric of the state's covariance, without scale and unit.
GRADIENT = 1e-6

# vm and va in network order, the residuals z - h(x), (n_meas,), J(x), and how many steps it took.
Solution = tuple[np.ndarray, np.ndarray, np.ndarray, float, int]
