"""Errors of the estimates within the band of their standard deviations, bus by bus and phase by phase."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from coordinator.lab.evaluation.comparison import Comparison
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.plot_text import name_places, plot_text
from coordinator.show.figures.style import (
    CENTRALISED,
    DECENTRALISED,
    GREY,
    MAX_VECTOR,
    SKY,
    Drawing,
    new_figure,
    style_by_phase,
)
from dsse_core.grid.partition import Partition
from dsse_core.results.units import wrap_degrees

MAX_LABELS = 33
MAX_AREA_NAMES = 12
MAX_BOUNDARIES = 30
MAX_SHADED = 40
LETTERS_OF_AXIS = 110  # that fit side by side
BAND = 2.0  # standard deviations; 95 % of normal errors lie within
PANELS = ("magnitude {} (p.u.)", "angle {} (degrees)")


def draw_errors(outcome: RunOutcome) -> Drawing:
    """Figure of both estimates' errors; without a truth, of the decentralised estimate's gap to the centralised one."""
    comparison, order = outcome.comparison, order_nodes(outcome.comparison.partition)
    phase = comparison.partition.network.table.nodes.phase[order]
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
            _draw_marks(axis, central, CENTRALISED | {"label": "centralised estimate"})
        for chosen, style in style_by_phase("decentralised estimate", DECENTRALISED, phase):
            of_phase = np.full(len(error), np.nan)
            of_phase[chosen] = error[chosen]
            _draw_marks(axis, of_phase, style)
        axis.axhline(0, color="0.5", linewidth=0.6)
        axis.set_ylabel(panel.format(what))
        label_nodes(axis, comparison.partition, order, named=axis is axes[-1])
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
    """Draw the band over half a place to both sides of each node; no band where sigma is nan."""
    edges = np.arange(len(sigma) + 1) - 0.5
    half = BAND * np.append(sigma, sigma[-1:])
    axis.fill_between(
        edges, -half, half, step="post", color=SKY, alpha=0.3, linewidth=0, label=f"±{BAND:g} standard deviations"
    )


def _draw_marks(axis: Axes, values: np.ndarray, style: dict[str, Any]) -> None:
    smaller = {"markersize": 2.5} if len(values) > 200 else {}
    rasterized = len(values) > MAX_VECTOR
    axis.plot(np.arange(len(values)), values, linestyle="none", rasterized=rasterized, **style | smaller)


def _count_inside(error: np.ndarray, sigma: np.ndarray) -> tuple[int, int]:
    """Number of nodes with an error within the band, and number of nodes with a known error and deviation."""
    known = ~np.isnan(error) & ~np.isnan(sigma)
    return int((abs(error[known]) <= BAND * sigma[known]).sum()), int(known.sum())


def _describe(comparison: Comparison, inside: list[tuple[int, int]]) -> str:
    what = name_places(comparison.partition.network)[0]
    of_which = "to the truth" if comparison.knows_truth else "to the centralised estimate (the truth is not known)"
    counts = " and ".join(
        f"{n} of {total} {name}" for (n, total), name in zip(inside, ("magnitudes", "angles"), strict=True)
    )
    return (
        f"Difference of each {what}'s estimate {of_which}, and the band of ±{BAND:g} standard deviations that the "
        f"areas themselves state; {counts} lie within. Of normal errors 95 % do."
    )


def order_nodes(partition: Partition) -> np.ndarray:
    """Rows of all nodes, area after area, within an area by bus number."""
    number = {area.name: k for k, area in enumerate(partition.areas)}
    owner, buses = partition.owner_of_bus, partition.network.node_buses
    return np.array(sorted(range(len(buses)), key=lambda row: (number[owner[buses[row]]], buses[row])), dtype=np.int64)


def label_nodes(axis: Axes, partition: Partition, order: np.ndarray, named: bool = True) -> None:
    """Label the axis with bus numbers, shade every second area and mark boundary buses.

    A bus stands at the middle of its nodes. ``named``: with area names and a label of the axis. Bus numbers are thinned
    out, and the other marks left out, where there are too many."""
    of_nodes = np.array(partition.network.node_buses)[order]
    starts_bus = np.flatnonzero(np.append(True, of_nodes[1:] != of_nodes[:-1]))
    ends_bus = np.append(starts_bus[1:], len(of_nodes)) - 1
    buses, middle = of_nodes[starts_bus].tolist(), ((starts_bus + ends_bus) / 2).tolist()
    names, n = list(map(str, buses)), len(of_nodes)
    owners = [partition.owner_of_bus[bus] for bus in buses]
    letters = max(map(len, names)) + 1
    step = -(-len(names) // min(MAX_LABELS, LETTERS_OF_AXIS // letters))
    shown, least = [0], letters * n / LETTERS_OF_AXIS  # between buses, of which some have few nodes
    for k in range(step, len(names), step):
        shown += [k] if middle[k] - middle[shown[-1]] >= least else []
    axis.set_xticks([middle[k] for k in shown], [names[k] for k in shown], fontsize="small")
    axis.set_xlim(-0.7, n - 0.3)
    axis.grid(axis="y", alpha=0.3)
    ends = [k for k, owner in enumerate(owners) if k + 1 == len(owners) or owners[k + 1] != owner]
    starts = [0, *(end + 1 for end in ends[:-1])]
    for number, (first_bus, last_bus) in enumerate(zip(starts, ends, strict=True)):
        first, last = int(starts_bus[first_bus]), int(ends_bus[last_bus])
        if number % 2 and len(ends) <= MAX_SHADED:
            axis.axvspan(first - 0.5, last + 0.5, color=GREY, alpha=0.12, linewidth=0)
        if named and len(ends) <= MAX_AREA_NAMES:
            name = plot_text(owners[first_bus], max(3, LETTERS_OF_AXIS * (last + 1 - first) // n))
            place = ((first + last) / 2, 0)
            axis.annotate(
                name, place, (0, 4), ("data", "axes fraction"), "offset points", ha="center", fontsize="small"
            )
    boundaries = set(partition.boundaries if len(partition.boundaries) <= MAX_BOUNDARIES else ())
    for x, bus in zip(middle, buses, strict=True):
        if bus in boundaries:
            axis.axvline(x, color=GREY, linestyle=":", linewidth=1)
    if named:
        marked = ["dotted: boundary bus"] * bool(boundaries)
        marked += ["shaded: every second area"] * (1 < len(ends) <= MAX_SHADED)
        what = "bus" if partition.network.table.nodes.is_balanced else "bus, a mark for each phase"
        axis.set_xlabel(f"{what} ({'; '.join(marked)})" if marked else f"{what}, area after area")
