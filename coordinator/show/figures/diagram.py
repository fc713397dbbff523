"""Parts of one-line diagrams of networks: the figure, lines from bus to bus, marks, bus numbers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coordinator.show.figures.feeder_layout import Layout
from coordinator.show.figures.labels import label_points
from coordinator.show.figures.style import GREY, INK, PAPER, VERMILLION, fix_layout
from dsse_core.grid.network import Branch, Network
from dsse_core.grid.partition import Partition

MAX_DOTS = 600  # buses that are drawn as dots
MAX_BUS_NAMES = 60
SMALLEST_IN, LARGEST_IN = 3.0, 16.0
MANY_LABELS = 150  # more labels need a larger figure
THINNER = {1: 0.36, 2: 0.64, 3: 1.0}  # width of a line with so many phases, by that of three


def new_diagram(layout: Layout, n_label: int) -> tuple[Figure, Axes]:
    """Figure for ``layout``, larger where ``n_label`` bus numbers need more room; and its axes."""
    columns, rows = np.ptp(layout.place, axis=0)
    width, height = _inches(columns), _inches(rows) + 1
    more = max(1.0, (n_label / MANY_LABELS) ** 0.5)
    figure = Figure(figsize=(width * more, height * more), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    return figure, axes


def _inches(length: float) -> float:
    """Size of so many columns or rows, inches."""
    return float(np.clip(0.35 * length + 1, SMALLEST_IN, LARGEST_IN))


def find_corners(network: Network, layout: Layout, branch: Branch) -> np.ndarray:
    """Corners of a branch's line, (3, 2): along the column of the inner bus, then along the row of the outer.

    A branch that closes a loop is a straight line, (2, 2)."""
    inner, outer = branch.from_bus, branch.to_bus
    if layout.upstream[inner] == outer:
        inner, outer = outer, inner
    one, other = layout.place[[network.row[inner], network.row[outer]]]
    if layout.upstream[outer] != inner:
        return np.array([one, other])
    return np.array([one, (one[0], other[1]), other])


def line_widths(network: Network) -> np.ndarray:
    """Width of the line of each branch in service, points, (n_active,): of one with fewer than three phases less."""
    widest = 2.5 if len(network.buses) <= MAX_BUS_NAMES else 1.2
    if network.table.nodes.is_balanced:
        return np.full(len(network.table.active), widest)
    return widest * np.array([THINNER[count] for count in _count_phases(network)])


def _count_phases(network: Network) -> list[int]:
    """Number of phases, at most 3, of each branch in service of a network with phases."""
    n, ports = len(network.table.active), network.table.ports
    return [min(int(count), 3) for count in np.bitwise_count(ports.sets[:n])]


def show_phases(axes: Axes, network: Network, layout: Layout) -> None:
    """Explains the widths of lines, and names the phases of branches that lack some; nothing of a balanced network."""
    if network.table.nodes.is_balanced:
        return
    counts, widest = _count_phases(network), float(line_widths(network).max())
    for count in sorted(set(counts), reverse=True):
        label = {3: "three phases", 2: "two phases", 1: "one phase"}[count]
        axes.plot([], [], color=GREY, linewidth=widest * THINNER[count] / max(THINNER[n] for n in counts), label=label)
    if len(network.buses) > MAX_BUS_NAMES:
        return
    for branch, count in zip(network.active_branches, counts, strict=True):
        if count < 3 and branch.primitive:
            corners = find_corners(network, layout, branch)
            middle = (corners[-2] + corners[-1]) / 2
            written = axes.annotate(
                branch.primitive.from_phases,
                tuple(middle.tolist()),
                (0, -2),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=7,
                fontstyle="italic",
                color=INK,
                zorder=6,
            )
            written.set_in_layout(False)


def mark_size(n_bus: int) -> float:
    """Size of the marks of boundary buses and of the substation, points."""
    return 8.0 if n_bus <= MAX_BUS_NAMES else 6.0 if n_bus <= MAX_DOTS else 4.0


def mark_boundaries(axes: Axes, partition: Partition, layout: Layout, fill: str = PAPER) -> None:
    """Draw boundary buses as rings, filled with ``fill``, and the substation as a square."""
    network = partition.network
    assert network.slack is not None  # a partition has a substation
    if partition.boundaries:
        _mark(axes, layout, [network.row[bus] for bus in partition.boundaries], "boundary bus", "o", fill)
    _mark(axes, layout, [network.row[network.slack.bus]], "substation", "s", INK)


def mark_switches(axes: Axes, network: Network, layout: Layout, in_doubt: Collection[str] = ()) -> None:
    """Draw switches as squares in the middle of their branches: filled if closed; open ones with a thin dashed line;
    those whose status is ``in_doubt`` in a frame.
    """
    closed = {switch for switch, is_closed in network.switches.items() if is_closed}
    opened, doubted = network.switches.keys() - closed, network.switches.keys() & {*in_doubt}
    frame: dict[str, Any] = {
        "markersize": 9,
        "markeredgewidth": 2,
        "markerfacecolor": "none",
        "markeredgecolor": VERMILLION,
    }
    for switches, label, style in (
        (closed, "closed switch", {"markersize": 4, "markerfacecolor": INK, "markeredgecolor": INK}),
        (opened, "open switch", {"markersize": 4, "markerfacecolor": PAPER, "markeredgecolor": INK}),
        (doubted, "status in doubt", frame),
    ):
        corners = [find_corners(network, layout, network.branch(switch)) for switch in sorted(switches)]
        if not corners:
            continue
        for line in corners if switches is opened else ():
            axes.plot(*line.T, color=INK, linewidth=0.8, linestyle="dashed", zorder=1)
        middles = np.array([(line[-2] + line[-1]) / 2 for line in corners])
        axes.plot(*middles.T, linestyle="none", marker="s", label=label, zorder=5, **style)


def _mark(axes: Axes, layout: Layout, rows: list[int], label: str, marker: str, fill: str) -> None:
    style: dict[str, Any] = {"color": INK, "marker": marker, "markerfacecolor": fill, "markeredgecolor": INK}
    axes.plot(
        *layout.place[rows].T,
        linestyle="none",
        markersize=mark_size(len(layout.place)),
        markeredgewidth=0.8,
        label=label,
        zorder=4,
        **style,
    )


def number_buses(axes: Axes, partition: Partition, layout: Layout, more: Sequence[int] = ()) -> None:
    """Write the numbers of boundary buses, the substation and ``more``; of all buses up to MAX_BUS_NAMES.

    This fixes the layout of the figure.
    """
    figure, network = axes.figure, partition.network
    assert isinstance(figure, Figure)
    assert network.slack is not None
    fix_layout(figure)
    n_bus = len(layout.place)
    wanted = list(dict.fromkeys([network.slack.bus, *more, *partition.boundaries]))
    obstacles = layout.place if n_bus <= MAX_DOTS else layout.place[[network.row[bus] for bus in wanted]]
    if n_bus <= MAX_BUS_NAMES:
        wanted = list(dict.fromkeys([*wanted, *network.row]))
    places = layout.place[[network.row[bus] for bus in wanted]]
    label_points(axes, places, list(map(str, wanted)), obstacles, mark_size(n_bus), all_of_them=True)
