"""The network as a one-line diagram, coloured by the voltage that the areas have estimated."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.diagram import (
    MAX_DOTS,
    find_corners,
    line_widths,
    mark_boundaries,
    mark_switches,
    new_diagram,
    number_buses,
    show_phases,
)
from coordinator.show.figures.feeder_layout import lay_out
from coordinator.show.figures.style import GREY, VERMILLION, Drawing
from coordinator.watch.observe.causes import OF_STATUS
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.grid.gauge import describe_ungrounded

COLOUR_MAP = ListedColormap(colormaps["viridis"](np.linspace(0.15, 0.95, 256)))
"""Even steps of lightness, also for the colour-blind and for grey print; without the ends, which pages would hide."""
LABEL_IN = 0.25  # room for the number of a bus beside the colours, inches
LEAST_SPAN = 0.01  # p.u. between the ends of the colours: a flat profile has one colour


def draw_network(outcome: RunOutcome) -> Drawing:
    """Figure of the network; a branch has the colour of its ends' mean, grey where there is no fresh estimate.

    A bus with phases has the colour of the one that is nearest to a limit, or farthest beyond.
    """
    partition, network, limits = outcome.scenario.partition, outcome.scenario.network, outcome.scenario.operating_limits
    nodes = network.table.nodes
    is_shown = outcome.buses.fresh & ~network.is_dead
    of_nodes, vm = np.where(is_shown, outcome.comparison.decentralised.vm, np.nan), np.full(len(nodes.first), np.nan)
    worst = limits.find_worst(nodes.item, of_nodes)
    vm[nodes.item[worst]] = of_nodes[worst]
    dead = np.logical_and.reduceat(network.is_dead, nodes.first)
    layout = lay_out(network)
    known = np.flatnonzero(~np.isnan(vm))
    ends = [int(known[np.argmin(vm[known])]), int(known[np.argmax(vm[known])])] if len(known) else []
    figure, axes = new_diagram(layout, len(partition.boundaries) + len(ends))
    scale = _find_scale(vm[known], limits)
    branches = network.active_branches
    lines = [find_corners(network, layout, branch) for branch in branches]
    widths = line_widths(network)
    mean = (vm[network.table.f] + vm[network.table.t]) / 2
    is_dead = dead[network.table.f]
    for n_corner, style in ((3, "solid"), (2, "dashed")):
        for unknown in (False, True):
            chosen = [k for k, line in enumerate(lines) if len(line) == n_corner and np.isnan(mean[k]) == unknown]
            styles = np.where(is_dead, "dotted", style)[chosen].tolist()
            drawn = LineCollection([lines[k] for k in chosen], linewidths=widths[chosen], linestyles=styles)
            if unknown:
                drawn.set_color(GREY)
            else:
                drawn.set(array=mean[chosen], cmap=COLOUR_MAP, norm=scale)
            axes.add_collection(drawn)
    size = 30 if len(vm) <= MAX_DOTS else 4
    dots = axes.scatter(
        layout.place[known, 0],
        layout.place[known, 1],
        c=vm[known],
        s=size,
        cmap=COLOUR_MAP,
        norm=scale,
        zorder=3,
        linewidths=0,
    )
    outside = known[(vm[known] < limits.lowest_vm) | (vm[known] > limits.highest_vm)]
    if len(outside):
        x, y = layout.place[outside].T
        edges: dict[str, Any] = {"facecolors": "none", "edgecolors": VERMILLION, "label": "beyond the limits"}
        axes.scatter(x, y, s=4 * size, marker="^", zorder=4, **edges)
    in_doubt = {branch for cause in outcome.causes if cause.kind in OF_STATUS for branch in cause.branches}
    mark_switches(axes, network, layout, in_doubt)
    if dead.any():
        axes.plot([], [], color=GREY, linestyle="dotted", linewidth=2.5, label="without supply")
    axes.autoscale_view()
    mark_boundaries(axes, partition, layout, fill="none")
    show_phases(axes, network, layout)
    what = "magnitude" if nodes.is_balanced else "magnitude of the worst phase"
    if len(known):
        figure.colorbar(
            dots,
            ax=axes,
            label=f"voltage {what} (p.u.)",
            shrink=0.7,
            pad=LABEL_IN / figure.get_figwidth(),
            fraction=0.05,
            aspect=30,
        )
    figure.legend(loc="outside lower right", ncols=2, fontsize="small")
    ids = network.table.bus_id
    number_buses(axes, partition, layout, [int(ids[row]) for row in ends])
    numbered = "boundary buses and those of the lowest and the highest voltage have their numbers"
    caption = f"Estimated voltage {what} on the one-line diagram; {numbered}. Dashed branches close loops."
    if not nodes.is_balanced:
        caption += (
            " The worst phase of a bus is nearest to a limit, or farthest beyond. Thinner lines have fewer phases."
        )
    caption = f"{caption} {describe_ungrounded(network.gauge.ungrounded)}".strip()
    if dead.any():
        caption += f" Grey and dotted: {dead.sum()} buses without supply."
    if n_unknown := len(vm) - len(known) - int(dead.sum()):
        caption += f" Grey: {n_unknown} buses without a fresh estimate."
    return Drawing("network", "Voltages in the network", caption, figure)


def _find_scale(vm: np.ndarray, limits: OperatingLimits) -> Normalize:
    if len(vm) == 0:
        return Normalize(limits.lowest_vm, limits.highest_vm)
    low, high = float(vm.min()), float(vm.max())
    more = max(0.0, LEAST_SPAN - (high - low)) / 2
    return Normalize(low - more, high + more)
