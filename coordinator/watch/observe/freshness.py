"""Freshness of the numbers of an area: the quality and age that each carries, and those that count as known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from agents.messages.packing import StateMessage
from agents.protocol.quality import DEGRADED, GOOD, NONE, RELATIVE_ANGLE
from dsse_core.results.table import Freshness, mark_rows

OF_THE_PRESENT = frozenset((GOOD, DEGRADED, RELATIVE_ANGLE))  # qualities
NOT_KNOWN = Freshness(NONE, math.nan, fresh=False)


def find_freshness(quality: str, telemetry_age_s: float, *, has_estimate: bool) -> Freshness:
    """The freshness of all numbers of a state of ``quality``, which is stale where its area is gone or silent."""
    if not has_estimate:
        return NOT_KNOWN._replace(quality=quality)
    return Freshness(quality, telemetry_age_s, quality in OF_THE_PRESENT)


def freshness_of_state(state: StateMessage) -> Freshness:
    """The freshness of the numbers of ``state`` at its publication, as its area sees it."""
    return find_freshness(state.quality, state.telemetry_age, has_estimate=bool(state.buses))


def describe_freshness(areas: Iterable[str], freshness: Mapping[str, Freshness]) -> dict[str, Any]:
    """Columns ``quality``, ``value_age_s`` and ``fresh`` of rows whose numbers are of ``areas``."""
    place = {area: k for k, area in enumerate(freshness)}
    of = np.fromiter((place.get(area, len(place)) for area in areas), dtype=np.int64)
    return mark_rows([*freshness.values(), NOT_KNOWN], of)
