"""Limits of an estimate that areas keep to, and limits of operation, by which pages, alarms and reports judge it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.estimation.residuals import THRESHOLD
from dsse_core.limits import NotNegative, Positive, Probability


@dataclass(frozen=True, slots=True)
class StateLimits:
    """Limits of an estimate; outside of them it is ``degraded``."""

    lowest_vm: NotNegative = 0.5
    """Lower end of the band of voltage magnitudes, p.u."""
    highest_vm: Positive = 1.5
    """Upper end, p.u."""
    most_removed: Probability = 0.2
    """Share of an area's meters that may be taken out as bad data; beyond it the test cannot tell bad from good."""
    most_overdue: Probability = 0.2
    """Share of meters that may have a missing or overdue reading, among the area's meters with an interval."""


DEFAULT_LIMITS = StateLimits()


@dataclass(frozen=True, slots=True)
class OperatingLimits:
    """Limits of a grid in operation; what exceeds them is shown as a violation, and the estimate is as good as before.

    Magnitudes in p.u., loading in percent of the rating, unbalance in percent.
    """

    lowest_vm: NotNegative = 0.9
    highest_vm: Positive = 1.1
    most_loading_percent: Positive = 100.0
    most_residual: Positive = THRESHOLD
    """Largest normalised residual of a meter in use."""
    most_unbalance_percent: Positive = 3.0
    """Largest |V-| / |V+| of a three-phase bus; EN 50160 asks for 2, in places 3."""

    def find_worst(self, of: np.ndarray, vm: np.ndarray) -> np.ndarray:
        """The rows of ``vm`` (n,), nan where not known, one for each bus: of its magnitudes the nearest to a limit, or
        the farthest beyond. ``of`` (n,): the buses. In order of these; without those that have no known magnitude.
        """
        known = np.flatnonzero(~np.isnan(vm))
        inside = np.minimum(self.highest_vm - vm[known], vm[known] - self.lowest_vm)
        rows = known[np.lexsort((inside, of[known]))]
        return rows[np.unique(of[rows], return_index=True)[1]]


DEFAULT_OPERATING_LIMITS = OperatingLimits()
