"""The pictures of a run: magnitudes and angles per bus, their errors, and the gap against time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coordinator.evaluation.comparison import Comparison, Voltages, wrapped_deg
from coordinator.evaluation.convergence import gap_history
from coordinator.evaluation.result import RunResult
from coordinator.report.plot_text import plot_text

TRUE: dict[str, Any] = {"color": "black", "marker": "o", "markerfacecolor": "none", "markersize": 7}
CENTRALISED: dict[str, Any] = {"color": "tab:blue", "marker": "x", "markersize": 6}
DECENTRALISED: dict[str, Any] = {"color": "tab:red", "marker": ".", "markersize": 6}
MAX_LABELS = 45
MAX_LEGEND = 10
SMALLEST = 1e-12  # what a logarithmic axis shows for 0


def draw_plots(result: RunResult) -> tuple[Path, ...]:
    """Draw ``magnitudes.png``, ``angles.png``, ``errors.png`` and ``gap.png`` into the run folder; their paths."""
    figures = {
        "magnitudes.png": _draw_states(result, "voltage magnitude (p.u.)", lambda voltages: voltages.vm),
        "angles.png": _draw_states(result, "voltage angle (degrees)", lambda voltages: np.degrees(voltages.va)),
        "errors.png": _draw_errors(result),
        "gap.png": _draw_gap(result),
    }
    for name, figure in figures.items():
        figure.savefig(result.folder / name, dpi=130)
    return tuple(result.folder / name for name in figures)


def _new_figure(result: RunResult, title: str, rows: int = 1) -> tuple[Figure, list[Axes]]:
    n = len(result.scenario.network.buses)
    figure = Figure(figsize=(min(max(8.0, 0.27 * n), 20.0), 4.6 + 2.2 * (rows - 1)), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0].tolist()
    scenario = result.scenario
    figure.suptitle(plot_text(f"{title}: {scenario.name}, {scenario.strategy}, seed {scenario.seed}"))
    return figure, axes


def _draw_states(result: RunResult, label: str, of: Callable[[Voltages], np.ndarray]) -> Figure:
    comparison, order = result.comparison, _bus_order(result.comparison)
    title = "True and estimated states" if comparison.knows_truth else "Estimated states"
    figure, (axis,) = _new_figure(result, title)
    x = np.arange(len(order))
    for name, voltages, style in (
        *([("true (power flow)", comparison.truth, TRUE)] if comparison.knows_truth else []),
        ("centralised WLS", comparison.centralised, CENTRALISED),
        ("decentralised", comparison.decentralised, DECENTRALISED),
    ):
        axis.plot(x, of(voltages)[order], linestyle="none", label=name, **style)
    axis.set_ylabel(label)
    _label_buses(axis, comparison, order)
    axis.legend(loc="best", framealpha=0.9)
    return figure


def _draw_errors(result: RunResult) -> Figure:
    comparison, order = result.comparison, _bus_order(result.comparison)
    what = "error" if comparison.knows_truth else "difference"
    figure, axes = _new_figure(result, f"{what.capitalize()}s of the estimates", rows=2)
    pairs = (
        ("centralised - true", comparison.centralised, comparison.truth, CENTRALISED | {"linestyle": "none"}),
        ("decentralised - true", comparison.decentralised, comparison.truth, DECENTRALISED | {"linestyle": "none"}),
        ("decentralised - centralised", comparison.decentralised, comparison.centralised, {"color": "0.45"}),
    )
    for name, one, other, style in pairs if comparison.knows_truth else pairs[-1:]:
        for axis, difference in zip(axes, (one.vm - other.vm, wrapped_deg(one.va - other.va)), strict=True):
            drawn = difference[order]
            if "marker" in style:
                axis.plot(drawn, label=name, **style)
            else:
                axis.step(np.arange(len(drawn)), drawn, where="mid", label=name, linewidth=1, **style)
    for axis, label in zip(axes, (f"magnitude {what} (p.u.)", f"angle {what} (degrees)"), strict=True):
        axis.axhline(0, color="0.3", linewidth=0.6)
        axis.set_ylabel(label)
        _label_buses(axis, comparison, order, named=axis is axes[-1])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")
    return figure


def _draw_gap(result: RunResult) -> Figure:
    """Per area, the largest gap to the centralised estimate after each state that it published."""
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    scenario = result.scenario
    title = f"Gap to the centralised estimate: {scenario.name}, {scenario.strategy}, seed {scenario.seed}"
    figure.suptitle(plot_text(title))
    end = result.timing_s["verdict"]
    for name, series in gap_history(result).items():
        times = series[:, 0].tolist()
        for axis, gap in zip(axes, (series[:, 1], series[:, 2]), strict=True):
            drawn = np.maximum(gap, SMALLEST).tolist()
            axis.step([*times, end], drawn + drawn[-1:] if drawn else [np.nan], where="post", label=name)
            axis.plot(times, drawn, linestyle="none", marker=".", color=axis.lines[-1].get_color())
    for axis, label in zip(axes, ("magnitude (p.u.)", "angle (degrees)"), strict=True):
        if any(np.isfinite(line.get_ydata()).any() for line in axis.lines):
            axis.set_yscale("log")
        else:  # nothing that a logarithm could scale
            axis.set_xlim(0, end)
            axis.set_yticks([])
            axis.text(0.5, 0.5, _why_no_gap(result), transform=axis.transAxes, ha="center", va="center")
        axis.set_ylabel(f"largest gap, {label}")
        axis.grid(alpha=0.3, which="both")
        if result.verdict.consensus:
            axis.axvline(end, color="0.3", linestyle=":", label="consensus noted")
    virtual = result.verdict.virtual_s is not None
    axes[-1].set_xlabel("virtual time (s)" if virtual else "time since the start of the run (s)")
    lines, labels = axes[0].get_legend_handles_labels()
    if len(labels) > MAX_LEGEND:  # every area is drawn; those that ended farthest off are named
        ends = {area.name: -(area.gap_vm_pu or 0.0) for area in result.area_results}
        named = sorted(labels, key=lambda label: ends.get(label, -np.inf))[:MAX_LEGEND]
        lines, labels = [lines[labels.index(label)] for label in named], named
    figure.legend(lines, labels, loc="outside lower center", ncols=6, fontsize="small")
    return figure


def _why_no_gap(result: RunResult) -> str:
    if not result.history:
        return "no area has published a state"
    if result.centralised_failure is not None:
        return "there is no centralised estimate"
    return "no area's angles count from the substation"


def _bus_order(comparison: Comparison) -> np.ndarray:
    """Rows of all buses, area after area, within an area by number."""
    names = [area.name for area in comparison.partition.areas]
    owner = comparison.partition.owner_of_bus
    buses = comparison.partition.network.buses
    return np.array(sorted(range(len(buses)), key=lambda row: (names.index(owner[buses[row].id]), buses[row].id)))


def _label_buses(axis: Axes, comparison: Comparison, order: np.ndarray, named: bool = True) -> None:
    """Bus numbers below, areas shaded in turn with their names, boundary buses as dotted lines."""
    buses, partition = comparison.partition.network.buses, comparison.partition
    ids = [buses[row].id for row in order]
    owners = [partition.owner_of_bus[bus] for bus in ids]
    step = -(-len(ids) // MAX_LABELS)
    axis.set_xticks(range(0, len(ids), step), [str(bus) for bus in ids[::step]], fontsize="small")
    axis.set_xlim(-0.7, len(ids) - 0.3)
    axis.grid(axis="y", alpha=0.3)
    for number, area in enumerate(dict.fromkeys(owners)):
        first, last = owners.index(area), len(owners) - 1 - owners[::-1].index(area)
        axis.axvspan(first - 0.5, last + 0.5, color="0.5", alpha=0.12 if number % 2 else 0.03, linewidth=0)
        if named and len(set(owners)) <= 12:
            axis.annotate(
                area,
                ((first + last) / 2, 0),
                (0, 4),
                ("data", "axes fraction"),
                "offset points",
                ha="center",
                color="0.3",
            )
    for bus in partition.boundaries:
        axis.axvline(ids.index(bus), color="0.4", linestyle=":", linewidth=1)
    if named:
        axis.set_xlabel("bus (dotted: boundary bus)")
