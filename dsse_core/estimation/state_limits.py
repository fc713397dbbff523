"""Limits that an estimate must keep to be relied on; scenarios and agents share them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StateLimits:
    """Limits of an estimate; outside of them it is ``degraded``.

    ``lowest_vm``, ``highest_vm``: the band of voltage magnitudes, p.u. ``most_removed``: the share of an area's meters
    that may be taken out as bad data; beyond it the test cannot tell bad meters from good ones. ``most_overdue``: the
    largest share of meters with a missing or overdue reading, among the area's meters with an interval.
    """

    lowest_vm: float = 0.5
    highest_vm: float = 1.5
    most_removed: float = 0.2
    most_overdue: float = 0.2


DEFAULT_LIMITS = StateLimits()
