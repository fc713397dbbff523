"""What an estimate must keep to be relied on: the words that scenarios and agents share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StateLimits:
    """An estimate outside of these is ``degraded``.

    ``lowest_vm``, ``highest_vm``: the band of voltage magnitudes, p.u. ``most_removed``: the share of an area's meters
    that may be taken out as bad data; beyond it, it is not clear which of them are the bad ones. ``most_overdue``: the
    share of its meters with an interval whose reading may be missing or overdue.
    """

    lowest_vm: float = 0.5
    highest_vm: float = 1.5
    most_removed: float = 0.2
    most_overdue: float = 0.2


DEFAULT_LIMITS = StateLimits()
