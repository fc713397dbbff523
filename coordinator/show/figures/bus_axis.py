"""An axis with a place for each bus: area after area, areas shaded in turn, boundary buses dotted."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from coordinator.show.figures.plot_text import plot_text
from coordinator.show.figures.style import GREY
from dsse_core.grid.partition import Partition

MAX_LABELS = 33
MAX_AREA_NAMES = 12
MAX_BOUNDARIES = 30
MAX_SHADED = 40
LETTERS_OF_AXIS = 110  # that fit side by side


def order_buses(partition: Partition) -> np.ndarray:
    """Rows of all buses, area after area, within an area by bus number."""
    number = {area.name: k for k, area in enumerate(partition.areas)}
    owner, ids = partition.owner_of_bus, partition.network.table.bus_id.tolist()
    return np.array(sorted(range(len(ids)), key=lambda row: (number[owner[ids[row]]], ids[row])), dtype=np.int64)


def label_buses(axis: Axes, partition: Partition, order: np.ndarray, named: bool = True) -> None:
    """Label the axis with bus numbers, shade every second area and mark boundary buses.

    ``named``: with area names and a label of the axis. Bus numbers are thinned out, and the other marks left out, where
    there are too many."""
    ids = partition.network.table.bus_id[order].tolist()
    owners = [partition.owner_of_bus[bus] for bus in ids]
    letters = max(len(str(bus)) for bus in ids) + 1
    step = -(-len(ids) // min(MAX_LABELS, LETTERS_OF_AXIS // letters))
    axis.set_xticks(range(0, len(ids), step), [str(bus) for bus in ids[::step]], fontsize="small")
    axis.set_xlim(-0.7, len(ids) - 0.3)
    axis.grid(axis="y", alpha=0.3)
    ends = [k for k, owner in enumerate(owners) if k + 1 == len(owners) or owners[k + 1] != owner]
    starts = [0, *(end + 1 for end in ends[:-1])]
    for number, (first, last) in enumerate(zip(starts, ends, strict=True)):
        if number % 2 and len(ends) <= MAX_SHADED:
            axis.axvspan(first - 0.5, last + 0.5, color=GREY, alpha=0.12, linewidth=0)
        if named and len(ends) <= MAX_AREA_NAMES:
            name = plot_text(owners[first], max(3, LETTERS_OF_AXIS * (last + 1 - first) // len(ids)))
            place = ((first + last) / 2, 0)
            axis.annotate(
                name, place, (0, 4), ("data", "axes fraction"), "offset points", ha="center", fontsize="small"
            )
    boundaries = set(partition.boundaries if len(partition.boundaries) <= MAX_BOUNDARIES else ())
    for number, bus in enumerate(ids):
        if bus in boundaries:
            axis.axvline(number, color=GREY, linestyle=":", linewidth=1)
    if named:
        marked = ["dotted: boundary bus"] * bool(boundaries)
        marked += ["shaded: every second area"] * (1 < len(ends) <= MAX_SHADED)
        axis.set_xlabel(f"bus ({'; '.join(marked)})" if marked else "bus, area after area")
