"""Freshness of the numbers of an area: the quality and age that each carries, and those that count as known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.messages.packing import StateMessage
from agents.protocol.quality import DEGRADED, GOOD, NONE, RELATIVE_ANGLE
from dsse_core.results.table import Table

FRESH = frozenset((GOOD, DEGRADED, RELATIVE_ANGLE))  # qualities of a state that describes the present


@dataclass(frozen=True, slots=True)
class Freshness:
    """Quality and age of all numbers of an area at one moment; without an estimate the age is nan.

    ``value_age_s``: time since the area has received the telemetry on which they rest, s.
    """

    quality: str = NONE
    value_age_s: float = math.nan

    @property
    def is_fresh(self) -> bool:
        """True for numbers of the present, which count as known; others are shown with their age."""
        return self.quality in FRESH and not math.isnan(self.value_age_s)


NOT_KNOWN = Freshness()


def find_freshness(quality: str, telemetry_age_s: float, *, has_estimate: bool) -> Freshness:
    """The freshness of numbers of a state of ``quality``, which is stale where its area is gone or silent."""
    return Freshness(quality, telemetry_age_s if has_estimate else math.nan)


def freshness_of_state(state: StateMessage) -> Freshness:
    """The freshness of the numbers of ``state`` at its publication, as its area sees it."""
    return find_freshness(state.quality, state.telemetry_age, has_estimate=bool(state.buses))


def add_freshness(
    title: str, table: Table, areas: Iterable[str], freshness: Mapping[str, Freshness], **more: Sequence[str]
) -> Table:
    """``table`` with the columns of ``describe_freshness`` and ``more``."""
    return Table(title, {name: table[name] for name in table.columns} | describe_freshness(areas, freshness) | more)


def describe_freshness(areas: Iterable[str], freshness: Mapping[str, Freshness]) -> dict[str, Any]:
    """Columns ``quality``, ``value_age_s`` and ``fresh`` of rows whose numbers are of ``areas``."""
    of_rows = [freshness.get(area, NOT_KNOWN) for area in areas]
    return {
        "quality": [each.quality for each in of_rows],
        "value_age_s": np.array([each.value_age_s for each in of_rows], dtype=float),
        "fresh": np.array([each.is_fresh for each in of_rows], dtype=bool),
    }
