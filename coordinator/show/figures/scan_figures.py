"""Figures of many scans: voltages, power and quality over time, the voltage profile as bands, meters removed most."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from coordinator.show.figures.feeder_profile import find_distances
from coordinator.show.figures.plot_text import name_places, plot_text
from coordinator.show.figures.style import (
    BLUE,
    GREEN,
    MAX_VECTOR,
    PURPLE,
    VERMILLION,
    Drawing,
    new_figure,
    style_by_phase,
    styled,
    write_instead,
)
from dsse_core.grid.network import Network
from dsse_core.results.scans import ScanTables
from dsse_core.results.table import Table
from scenarios.scenario import Scenario

MOST_METERS = 20  # in the figure of those removed most
MOST_NAMES = 8  # of scans without times, below an axis
BESIDE = 0.006  # shift of a phase from the one before it, by the width of the profile
OUTER, INNER = (0, 100), (5, 95)  # percentiles between which the bands of the profile lie


@dataclass(frozen=True)
class ScanSeries:
    """Quantities of the scans in ``tables`` of ``scenario``, in their order; nan where a scan has no estimate."""

    scenario: Scenario
    tables: ScanTables

    @property
    def network(self) -> Network:
        return self.scenario.network

    @property
    def has_times(self) -> bool:
        """True where the times of all scans are known."""
        return not np.isnat(self.tables.scans.time).any()

    @cached_property
    def vm(self) -> np.ndarray:
        """Voltage magnitudes, p.u., (n_scan, n_nodes)."""
        return self.by_scan(self.tables.buses, "vm_pu")

    @cached_property
    def head(self) -> np.ndarray:
        """Powers that the substation injects, kW and kvar, (2, n_scan)."""
        assert self.network.slack is not None
        nodes = self.network.nodes_at(self.network.slack.bus)
        return np.array([self.by_scan(self.tables.buses, name)[:, nodes].sum(axis=1) for name in ("p_kw", "q_kvar")])

    @cached_property
    def loss_kw(self) -> np.ndarray:
        """Losses of the whole network, (n_scan,)."""
        return np.asarray(self.by_scan(self.tables.areas, "loss_kw").sum(axis=1))

    @property
    def removals(self) -> Counter[str]:
        """Number of scans of which each meter was removed, the most first."""
        found = Counter(meter for meters in self.tables.scans.removed_meters for meter in meters.split())
        return Counter(dict(found.most_common()))

    def by_scan(self, table: Table, name: str) -> np.ndarray:
        """A column of a table with as many rows for each scan, (n_scan, n_row)."""
        return np.asarray(table[name]).reshape(len(self.tables.scans), -1)

    def name_of(self, row: int) -> str:
        """Name of a scan."""
        return str(self.tables.scans.scan[row])


def draw_scans(course: ScanSeries) -> tuple[Drawing, ...]:
    """All figures, in the order of the report."""
    with styled():
        return tuple(draw(course) for draw in (_draw_voltages, _draw_bands, _draw_power, _draw_quality, _draw_removed))


def _draw_voltages(course: ScanSeries) -> Drawing:
    figure, (axis,) = new_figure(3.8)
    vm, limits = course.vm, course.scenario.operating_limits
    known = ~np.isnan(vm).all(axis=1)
    for name, percentile, colour in (("highest", 100, VERMILLION), ("median", 50, BLUE), ("lowest", 0, GREEN)):
        values = np.full(len(vm), np.nan)
        values[known] = np.percentile(vm[known], percentile, axis=1)
        _draw_line(axis, course, values, label=f"{name} of all {name_places(course.network)[1]}", color=colour)
    for number, limit in enumerate((limits.lowest_vm, limits.highest_vm)):
        axis.axhline(limit, color=PURPLE, linestyle="dashed", linewidth=1.5, label="" if number else "limits")
    _finish(axis, course, "voltage magnitude (p.u.)")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="small")
    return Drawing("voltages", "Voltages over time", _describe_voltages(course), figure)


def _describe_voltages(course: ScanSeries) -> str:
    vm, limits, bus = course.vm, course.scenario.operating_limits, course.network.node_names
    if np.isnan(vm).all():
        return "No scan has an estimate."
    words = []
    for name, at in (("Lowest", np.nanargmin(vm)), ("Highest", np.nanargmax(vm))):
        row, k = np.unravel_index(at, vm.shape)
        words.append(f"{name}: {vm[row, k]:.4f} p.u. at bus {bus[k]}, scan {course.name_of(int(row))}.")
    beyond = int(((vm < limits.lowest_vm) | (vm > limits.highest_vm)).any(axis=1).sum())
    words.append(f"{beyond} of {len(vm)} scans have a bus beyond {limits.lowest_vm:g} or {limits.highest_vm:g} p.u.")
    if partly := int(np.isnan(vm).any(axis=1).sum()):
        words.append(f"Not all buses are known in {partly} of them.")
    return " ".join(words)


def _draw_bands(course: ScanSeries) -> Drawing:
    figure, (axis,) = new_figure(4.2)
    distance, x_label = find_distances(course.network)
    distance = distance[course.network.table.nodes.item]
    seen, limits = ~np.isnan(course.vm).all(axis=0), course.scenario.operating_limits
    known, distance, phase = course.vm[:, seen], distance[seen], course.network.table.nodes.phase[seen]
    large: dict[str, Any] = {"rasterized": len(distance) > MAX_VECTOR}
    of_median = {"color": VERMILLION, "marker": "_", "markersize": 6}
    for place, (chosen, style) in enumerate(style_by_phase("median", of_median, phase)):
        of_phase, colour = known[:, chosen], style["color"] if phase.any() else BLUE
        x = distance[chosen] + place * BESIDE * np.ptp(distance)
        for (low, high), width, label in ((OUTER, 1.0, "all scans"), (INNER, 3.5, "nine of ten scans")):
            ends = np.nanpercentile(of_phase, [low, high], axis=0)
            axis.vlines(x, *ends, color=colour, alpha=0.5, linewidth=width, label="" if place else label, **large)
        axis.plot(x, np.nanmedian(of_phase, axis=0), linestyle="none", **style, **large)
    if not seen.any():
        write_instead(axis, "no scan has an estimate")
    for number, limit in enumerate((limits.lowest_vm, limits.highest_vm)):
        axis.axhline(limit, color=PURPLE, linestyle="dashed", linewidth=1.5, label="" if number else "limits")
    axis.set_xlabel(x_label)
    axis.set_ylabel("voltage magnitude (p.u.)")
    axis.margins(0.03, 0.06)
    axis.grid(alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="small")
    what = name_places(course.network)[0]
    caption = (
        f"Voltage of every {what} in all scans against its distance from the substation: range, 5 to 95 %, median."
    )
    return Drawing("profile", "Voltage profile of all scans", caption, figure)


def _draw_power(course: ScanSeries) -> Drawing:
    figure, (powers, losses) = new_figure(5.0, rows=2)
    for values, label, colour in zip(course.head, ("P (kW)", "Q (kvar)"), (BLUE, VERMILLION), strict=True):
        _draw_line(powers, course, values, label=label, color=colour)
    powers.set_ylabel("from the substation\n(kW, kvar)")
    powers.grid(alpha=0.3)
    _draw_line(losses, course, course.loss_kw, label="losses (kW)", color=GREEN)
    _finish(losses, course, "losses (kW)")
    figure.legend(*powers.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize="small")
    caption = "Power that the substation injects, and the losses of the whole network."
    if not np.isnan(course.head[0]).all():
        row = int(np.nanargmax(course.head[0]))
        caption += f" Most: {course.head[0, row]:.1f} kW, scan {course.name_of(row)}."
    return Drawing("power", "Power over time", caption, figure)


def _draw_quality(course: ScanSeries) -> Drawing:
    figure, (objective, removed) = new_figure(5.0, rows=2)
    scans = course.tables.scans
    _draw_line(objective, course, scans.objective, label="J, after the removal of bad data", color=BLUE)
    limit = scans.chi_square_limit
    _draw_line(objective, course, np.where(np.isfinite(limit), limit, np.nan), label="limit", color=PURPLE)
    objective.set_ylabel("J")
    objective.grid(alpha=0.3)
    failed = np.array([status == "failed" for status in scans.status], dtype=bool)
    x, style = _places(course), dict[str, Any](linestyle="none", markersize=4)
    removed.plot(x[~failed], scans.removed[~failed], marker=".", color=VERMILLION, label="removed meters", **style)
    if failed.any():
        removed.plot(x[failed], np.zeros(failed.sum()), marker="X", color=PURPLE, label="no estimate", **style)
    removed.set_ylim(bottom=-0.3)
    removed.yaxis.set_major_locator(MaxNLocator(integer=True))
    _finish(removed, course, "removed meters")
    handles = [line for axis in (objective, removed) for line in axis.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize="small")
    clean = int((scans.removed[~failed] == 0).sum())
    caption = f"{clean} of {len(scans)} scans estimated without bad data, {failed.sum()} without an estimate; "
    caption += f"in {int(scans.bad_data_left.sum())} bad data are left."
    return Drawing("quality", "Quality over time", caption, figure)


def _draw_removed(course: ScanSeries) -> Drawing:
    most = course.removals.most_common(MOST_METERS)
    figure, (axis,) = new_figure(1.2 + 0.24 * max(len(most), 3))
    if most:
        names, counts = zip(*reversed(most), strict=True)
        axis.barh([plot_text(name, 40) for name in names], counts, color=VERMILLION)
        axis.set_xlabel("scans of which the meter was removed")
        axis.tick_params(axis="y", labelsize="small")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    else:
        write_instead(axis, "no meter was removed")
    caption = f"{len(course.removals)} meters were removed as bad data, {course.removals.total()} readings in all."
    return Drawing("removed", "Meters removed most", caption, figure)


def _places(course: ScanSeries) -> np.ndarray:
    """Place of each scan on the axis of time: its time, or its number where times are unknown."""
    return np.asarray(course.tables.scans.time) if course.has_times else np.arange(len(course.tables.scans))


def _draw_line(axis: Axes, course: ScanSeries, values: np.ndarray, **style: Any) -> None:
    marker = "." if len(values) < 3 else None
    axis.plot(_places(course), values, linewidth=1.0, marker=marker, **style)


def _finish(axis: Axes, course: ScanSeries, label: str) -> None:
    """Labels both axes; scans without times have their names below the axis."""
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    axis.margins(x=0.01)
    if course.has_times:
        axis.set_xlabel("time (UTC)")  # matplotlib chooses the form of the dates
        return
    count = len(course.tables.scans)
    shown = np.unique(np.linspace(0, count - 1, min(count, MOST_NAMES)).round().astype(int))
    axis.set_xticks(shown, [plot_text(course.name_of(row), 16) for row in shown.tolist()], fontsize="small")
    axis.set_xlabel("scan")
