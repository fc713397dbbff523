"""What a published state is worth, in one word. docs/quality.md says what each promises."""

from __future__ import annotations

from collections.abc import Sequence

from agents.hearing import Hearing
from agents.strategies.interface import Estimate

GOOD, DEGRADED, RELATIVE_ANGLE, STALE, NONE = "good", "degraded", "relative-angle", "stale", "none"
UNOBSERVABLE = "unobservable"


def judge_quality(
    estimate: Estimate | None, doubts: bool, hearing: Hearing, neighbours: Sequence[str], gone: set[str], now: float
) -> str:
    """The worst that holds at time ``now``.

    ``doubts``: the strategy says that something is missing, or that a neighbour contradicts. ``gone``: the neighbours
    whose processes have ended.
    """
    if estimate is None:
        return NONE
    if hearing.is_late(now):
        return STALE
    if not estimate.referenced:
        return RELATIVE_ANGLE
    sound = estimate.checked and estimate.settled and not doubts
    return GOOD if sound and not gone and not hearing.find_old(neighbours, now) else DEGRADED
