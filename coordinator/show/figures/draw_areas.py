"""Diagram of a network's areas: one-line, a colour for each area, boundary buses and substation marked."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from coordinator.show.figures.diagram import (
    MAX_DOTS,
    find_corners,
    line_widths,
    mark_boundaries,
    new_diagram,
    number_buses,
    show_phases,
)
from coordinator.show.figures.feeder_layout import Layout, lay_out
from coordinator.show.figures.plot_text import plot_text
from coordinator.show.figures.style import COLOURS, PAPER, save, styled
from dsse_core.grid.partition import Area, Partition

MAX_AREA_NAMES = 60
LONGEST_NAME = 24


def draw_areas(partition: Partition, path: Path) -> None:
    """Write a figure of the areas, in the format of the suffix of ``path``, such as ``.png``."""
    with styled():
        figure = make_areas_figure(partition)
        save(figure, path.with_suffix(""), [path.suffix.removeprefix(".")])


def make_areas_figure(partition: Partition) -> Figure:
    """Figure of the areas; branches that close loops are dashed, boundary buses always have their numbers."""
    network = partition.network
    layout = lay_out(network)
    figure, axes = new_diagram(layout, len(partition.boundaries))
    figure.suptitle(plot_text(f"{network.name}: {len(network.buses)} buses in {len(partition.areas)} areas"))
    colours = choose_colours(partition)
    _draw_branches(axes, partition, layout, colours)
    mark_boundaries(axes, partition, layout)
    show_phases(axes, network, layout)
    figure.legend(loc="outside lower right", ncols=2, fontsize="small")
    number_buses(axes, partition, layout)
    if len(partition.areas) <= MAX_AREA_NAMES:
        _name_areas(axes, partition, layout, colours)
    return figure


def _draw_branches(axes: Axes, partition: Partition, layout: Layout, colours: dict[str, str]) -> None:
    n_bus, network = len(layout.place), partition.network
    width = dict(zip(network.active_branch_ids, line_widths(network).tolist(), strict=True))
    for area in partition.areas:
        colour = colours[area.name]
        branches = area.network.active_branches
        lines = [find_corners(network, layout, branch) for branch in branches]
        for n_corner, style in ((3, "solid"), (2, "dashed")):
            chosen = [k for k, line in enumerate(lines) if len(line) == n_corner]
            widths = [width[branches[k].id] for k in chosen]
            drawn = LineCollection([lines[k] for k in chosen], colors=colour, linewidths=widths, linestyles=style)
            axes.add_collection(drawn)
        if n_bus <= MAX_DOTS:
            owned = _rows_owned(partition, area)
            axes.plot(*layout.place[owned].T, linestyle="none", marker="o", markersize=4, color=colour)
    axes.autoscale_view()


def _rows_owned(partition: Partition, area: Area) -> list[int]:
    row, owner = partition.network.row, partition.owner_of_bus
    return [row[bus.id] for bus in area.network.buses if owner[bus.id] == area.name]


def choose_colours(partition: Partition) -> dict[str, str]:
    """Area -> its colour, different from those of adjacent areas as far as there are enough colours."""
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


def _name_areas(axes: Axes, partition: Partition, layout: Layout, colours: dict[str, str]) -> None:
    """Write the name of each area at the middle one of the buses that it owns, in order of their columns."""
    for area in partition.areas:
        owned = sorted(_rows_owned(partition, area), key=lambda row: tuple(layout.place[row]))
        axes.annotate(
            plot_text(area.name, LONGEST_NAME),
            tuple(layout.place[owned[len(owned) // 2]].tolist()),
            (0, -13),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            color=colours[area.name],
            bbox={"boxstyle": "round,pad=0.15", "facecolor": PAPER, "edgecolor": colours[area.name], "alpha": 0.85},
            zorder=7,
        )
