"""Errors of the estimates within the band of their standard deviations, bus by bus."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from coordinator.lab.evaluation.comparison import Comparison
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.bus_axis import label_buses, order_buses
from coordinator.show.figures.style import CENTRALISED, DECENTRALISED, MAX_VECTOR, SKY, Drawing, new_figure
from dsse_core.results.units import wrap_degrees

BAND = 2.0  # standard deviations; 95 % of normal errors lie within
PANELS = ("magnitude {} (p.u.)", "angle {} (degrees)")


def draw_errors(outcome: RunOutcome) -> Drawing:
    """Figure of both estimates' errors; without a truth, of the decentralised estimate's gap to the centralised one."""
    comparison, order = outcome.comparison, order_buses(outcome.comparison.partition)
    known = comparison.knows_truth
    reference = comparison.truth if known else comparison.centralised
    what = "error" if known else "gap"
    figure, axes = new_figure(5.6, rows=2)
    inside = []
    for axis, of, panel in zip(axes, ("vm", "va"), PANELS, strict=True):
        sigma = _in_unit(of, getattr(comparison.sigma, of))[order]
        error = _difference(of, comparison.decentralised, reference)[order]
        _draw_band(axis, sigma)
        if known:
            central = _difference(of, comparison.centralised, comparison.truth)[order]
            _draw_marks(axis, central, "centralised estimate", CENTRALISED)
        _draw_marks(axis, error, "decentralised estimate", DECENTRALISED)
        axis.axhline(0, color="0.5", linewidth=0.6)
        axis.set_ylabel(panel.format(what))
        label_buses(axis, comparison.partition, order, named=axis is axes[-1])
        inside.append(_count_inside(error, sigma))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")
    title = "Errors of the estimates" if known else "Difference to the centralised estimate"
    return Drawing("errors", title, _describe(comparison, inside), figure)


def _in_unit(of: str, values: np.ndarray) -> np.ndarray:
    return np.degrees(values) if of == "va" else values


def _difference(of: str, one: object, other: object) -> np.ndarray:
    difference = getattr(one, of) - getattr(other, of)
    return wrap_degrees(difference) if of == "va" else difference


def _draw_band(axis: Axes, sigma: np.ndarray) -> None:
    """Draw the band over half a bus to both sides of each bus; no band where sigma is nan."""
    edges = np.arange(len(sigma) + 1) - 0.5
    half = BAND * np.append(sigma, sigma[-1:])
    axis.fill_between(
        edges, -half, half, step="post", color=SKY, alpha=0.3, linewidth=0, label=f"±{BAND:g} standard deviations"
    )


def _draw_marks(axis: Axes, values: np.ndarray, label: str, style: dict[str, Any]) -> None:
    smaller = {"markersize": 2.5} if len(values) > 200 else {}
    rasterized = len(values) > MAX_VECTOR
    axis.plot(np.arange(len(values)), values, linestyle="none", label=label, rasterized=rasterized, **style | smaller)


def _count_inside(error: np.ndarray, sigma: np.ndarray) -> tuple[int, int]:
    """Number of buses with an error within the band, and number of buses with a known error and deviation."""
    known = ~np.isnan(error) & ~np.isnan(sigma)
    return int((abs(error[known]) <= BAND * sigma[known]).sum()), int(known.sum())


def _describe(comparison: Comparison, inside: list[tuple[int, int]]) -> str:
    of_which = "to the truth" if comparison.knows_truth else "to the centralised estimate (the truth is not known)"
    counts = " and ".join(
        f"{n} of {total} {name}" for (n, total), name in zip(inside, ("magnitudes", "angles"), strict=True)
    )
    return (
        f"Difference of each bus's estimate {of_which}, and the band of ±{BAND:g} standard deviations that the areas "
        f"themselves state; {counts} lie within. Of normal errors 95 % do."
    )
