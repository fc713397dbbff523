"""A picture of a network's areas: a one-line diagram, a colour for each area, boundary buses and substation marked."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from coordinator.report.feeder_layout import Layout, lay_out
from coordinator.report.plot_text import plot_text
from dsse_core.grid.network import Branch
from dsse_core.grid.partition import Area, Partition

COLOURS = [f"tab:{name}" for name in ("blue", "orange", "green", "red", "purple", "brown", "pink", "olive", "cyan")]
MAX_DOTS = 600  # buses that are drawn as dots
MAX_BUS_NAMES = 60
MAX_AREA_NAMES = 60


def draw_areas(partition: Partition, path: Path) -> None:
    """Write a picture of the areas, in the format that the suffix of ``path`` names, such as ``.png``.

    Branches that close loops are dashed.
    """
    network = partition.network
    layout = lay_out(network)
    n_bus = len(network.buses)
    columns, rows = np.ptp(layout.place, axis=0)
    figure = Figure(figsize=(_inches(columns), _inches(rows) + 1), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_title(plot_text(f"{network.name}: {n_bus} buses in {len(partition.areas)} areas"))
    _draw_branches(axes, partition, layout)
    assert network.slack is not None  # a partition has a substation
    _mark(axes, layout, [network.row[bus] for bus in partition.boundaries], "boundary bus", "o", "white")
    _mark(axes, layout, [network.row[network.slack.bus]], "substation", "s", "black")
    if n_bus <= MAX_BUS_NAMES:
        for bus, place in zip(network.buses, layout.place, strict=True):
            axes.annotate(str(bus.id), place, (5, 4), textcoords="offset points", fontsize=7, zorder=5)
    if len(partition.areas) <= MAX_AREA_NAMES:
        _name_areas(axes, partition, layout)
    figure.legend(loc="outside lower right", ncols=2, fontsize="small")
    figure.savefig(path, dpi=150)


def _inches(length: float) -> float:
    """How much paper so many columns or rows get."""
    return float(np.clip(0.35 * length + 1, 3, 16))


def _draw_branches(axes: Axes, partition: Partition, layout: Layout) -> None:
    n_bus = len(layout.place)
    colours = _choose_colours(partition)
    for area in partition.areas:
        colour = colours[area.name]
        lines = [_find_corners(partition, layout, branch) for branch in area.network.branches]
        for n_corner, style in ((3, "solid"), (2, "dashed")):
            chosen = [line for line in lines if len(line) == n_corner]
            width = 2.5 if n_bus <= MAX_BUS_NAMES else 1.2
            axes.add_collection(LineCollection(chosen, colors=colour, linewidths=width, linestyles=style))
        if n_bus <= MAX_DOTS:
            owned = _rows_owned(partition, area)
            axes.plot(*layout.place[owned].T, linestyle="none", marker="o", markersize=4, color=colour)
    axes.autoscale_view()


def _find_corners(partition: Partition, layout: Layout, branch: Branch) -> np.ndarray:
    """Three: along the column of the inner bus, then along the row of the outer. Two if the branch closes a loop."""
    inner, outer = branch.from_bus, branch.to_bus
    if layout.upstream[inner] == outer:
        inner, outer = outer, inner
    one, other = layout.place[[partition.network.row[inner], partition.network.row[outer]]]
    if layout.upstream[outer] != inner:
        return np.array([one, other])
    return np.array([one, (one[0], other[1]), other])


def _rows_owned(partition: Partition, area: Area) -> list[int]:
    row, owner = partition.network.row, partition.owner_of_bus
    return [row[bus.id] for bus in area.network.buses if owner[bus.id] == area.name]


def _choose_colours(partition: Partition) -> dict[str, str]:
    """A colour for each area, another than those of the areas that it meets, as far as there are enough."""
    chosen: dict[str, str] = {}
    meeting: dict[str, set[str]] = {area.name: set() for area in partition.areas}
    for names in partition.boundaries.values():
        for name in names:
            meeting[name].update(names)
    for number, area in enumerate(partition.areas):
        taken = {chosen[name] for name in meeting[area.name] if name in chosen}
        in_turn = COLOURS[number % len(COLOURS) :] + COLOURS[: number % len(COLOURS)]
        chosen[area.name] = next((colour for colour in in_turn if colour not in taken), in_turn[0])
    return chosen


def _mark(axes: Axes, layout: Layout, rows: list[int], label: str, marker: str, fill: str) -> None:
    n_bus = len(layout.place)
    size = 8 if n_bus <= MAX_BUS_NAMES else 6 if n_bus <= MAX_DOTS else 4
    axes.plot(
        *layout.place[rows].T,
        linestyle="none",
        marker=marker,
        markersize=size,
        markerfacecolor=fill,
        markeredgecolor="black",
        label=label,
        zorder=4,
    )


def _name_areas(axes: Axes, partition: Partition, layout: Layout) -> None:
    """The name of each area at the middle one, counted by distance, of the buses that it owns."""
    colours = _choose_colours(partition)
    for area in partition.areas:
        owned = sorted(_rows_owned(partition, area), key=lambda row: tuple(layout.place[row]))
        axes.annotate(
            area.name,
            layout.place[owned[len(owned) // 2]],
            (0, -11),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            color=colours[area.name],
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": colours[area.name], "alpha": 0.85},
            zorder=6,
        )
