"""Convergence of the areas to the centralised estimate: the gap of each over time, and when it becomes small."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from coordinator.lab.evaluation.comparison import rows_of
from coordinator.lab.evaluation.result import RunOutcome
from dsse_core.results.units import wrap_degrees


def gap_history(outcome: RunOutcome) -> dict[str, np.ndarray]:
    """Area -> array of shape (n_state, 3), one row for each state that it published.

    Columns: time (s), the largest differences to the centralised estimate over all nodes that the area sees in
    magnitude (p.u.) and angle (degrees; nan while angles do not count from the substation, and both nan where
    there is no centralised estimate).
    """
    central, partition = outcome.comparison.centralised, outcome.comparison.partition
    rows = {area.name: rows_of(partition, area.name) for area in partition.areas}
    found: dict[str, list[tuple[float, float, float]]] = {area.name: [] for area in partition.areas}
    for sample in outcome.history:
        at = rows[sample.area]
        vm = abs(np.array(sample.vm) - central.vm[at]).max()
        va = abs(wrap_degrees(np.array(sample.va) - central.va[at])).max() if sample.referenced else math.nan
        found[sample.area].append((sample.time, float(vm), float(va)))
    return {name: np.array(gaps).reshape(-1, 3) for name, gaps in found.items()}


def find_time_below(gaps: Mapping[str, np.ndarray], limit: float) -> float | None:
    """The time (s) from which on the gap of every area stays within ``limit`` (p.u. and rad); None if there is none."""
    times = []
    for series in gaps.values():
        above = ~(np.maximum(series[:, 1], np.radians(series[:, 2])) <= limit)  # nan is above
        if len(series) == 0 or above[-1]:
            return None
        times.append(float(series[np.flatnonzero(above)[-1] + 1 if above.any() else 0, 0]))
    return max(times, default=None)
