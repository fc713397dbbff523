"""Figure of the gap to the centralised estimate after a scan: both axes logarithmic, from the first state on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import LogLocator, NullFormatter

from coordinator.lab.evaluation.convergence import gap_history
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.plot_text import name_places, plot_text
from coordinator.show.figures.style import (
    COLOURS,
    GREY,
    INK,
    LINES,
    MARKERS,
    PURPLE,
    Drawing,
    format_power_of_ten,
    new_figure,
    write_instead,
)

SMALLEST = 1e-16  # p.u. and degrees, stands for 0 on a logarithmic axis
SHORTEST_S = 1e-6
MAX_NAMED = 6  # areas
MAX_POINTS = 2000  # of the line of all areas
LONGEST_NAME = 24
PANELS = ("magnitude (p.u.)", "angle (degrees)")


@dataclass(frozen=True)
class GapCourse:
    """Gap of a run over time. ``areas``: name -> (n_state, 3). ``all_areas``: (n, 3), the largest of all areas.

    Columns: time since the scan (s), gap in magnitude (p.u.) and angle (degrees). A gap is nan where it is not known;
    that of all areas, until each has published a state. ``end_s``: time of the verdict. ``sigma``: the medians of the
    standard deviations of all buses, in the same units, as a scale for the gap. ``places``: the words for one and many.
    """

    areas: Mapping[str, np.ndarray]
    all_areas: np.ndarray
    end_s: float
    sigma: tuple[float, float]
    virtual: bool
    consensus: bool
    why_none: str
    places: tuple[str, str]

    @property
    def first_s(self) -> float | None:
        """Time of the first state with a known gap, s, at least SHORTEST_S; None if there is none."""
        known = [rows[~np.isnan(rows[:, 1:]).all(axis=1), 0] for rows in self.areas.values()]
        return min((max(float(times[0]), SHORTEST_S) for times in known if len(times)), default=None)


def find_course(outcome: RunOutcome) -> GapCourse:
    """Gap of a run over time, which counts from its scan."""
    scan = outcome.timing_s.get("plant_started", 0.0)
    areas = {name: rows - (scan, 0, 0) for name, rows in gap_history(outcome).items()}
    end = outcome.timing_s["verdict"] - scan
    virtual = outcome.verdict.virtual_s is not None
    of_buses = outcome.comparison.sigma
    sigma = _median(of_buses.vm), _median(np.degrees(of_buses.va))
    why = _why_no_gap(outcome)
    places = name_places(outcome.scenario.network)
    return GapCourse(areas, _find_largest(areas), end, sigma, virtual, outcome.verdict.consensus, why, places)


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _find_largest(areas: Mapping[str, np.ndarray]) -> np.ndarray:
    """The largest gap of all areas at each time of a state, at MAX_POINTS of these times at most."""
    times = np.unique(np.concatenate([rows[:, 0] for rows in areas.values()] or [np.zeros(0)]))
    if len(times) > MAX_POINTS:
        times = times[np.unique(np.geomspace(1, len(times), MAX_POINTS).astype(int) - 1)]
    largest = np.zeros((len(times), 2))
    for rows in areas.values():
        last = np.searchsorted(rows[:, 0], times, side="right") - 1
        known = np.vstack([rows[:, 1:], [[np.nan, np.nan]]])[last]  # before the first: row -1
        largest = np.maximum(largest, known)
    return np.column_stack([times, largest])


def draw_gap(outcome: RunOutcome) -> Drawing:
    """Figure of the gap of each area, in grey beyond MAX_NAMED areas, and of the largest of all."""
    course = find_course(outcome)
    figure, axes = new_figure(5.6, rows=2)
    few = len(course.areas) <= MAX_NAMED
    for column, axis in enumerate(axes, start=1):
        if not few:
            steps = [_as_steps(rows, column, course.end_s) for rows in course.areas.values()]
            lines = [np.column_stack(step) for step in steps if len(step[0])]
            axis.add_collection(
                LineCollection(lines, colors=GREY, linewidths=0.5, alpha=0.5, label="each area", rasterized=True)
            )
        for number, (name, rows) in enumerate(course.areas.items() if few else ()):
            shown = plot_text(name, LONGEST_NAME)
            _draw_steps(axis, rows, column, course.end_s, shown, number, marked=True)
        x, y = _as_steps(course.all_areas, column, course.end_s)
        axis.plot(x, y, color=INK, linewidth=2.2, alpha=0.35 if few else 1, label="largest of all areas", zorder=1.5)
    _finish(axes, [course])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")
    return Drawing("gap", "Gap to the centralised estimate", _describe(course), figure)


def draw_gaps_of(courses: Mapping[str, GapCourse]) -> Drawing:
    """Figure of the largest gap of all areas in several runs, by strategy."""
    figure, axes = new_figure(5.6, rows=2)
    for column, axis in enumerate(axes, start=1):
        for number, (name, course) in enumerate(courses.items()):
            _draw_steps(
                axis, course.all_areas, column, course.end_s, plot_text(name, LONGEST_NAME), number, marked=False
            )
    _finish(axes, list(courses.values()))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")
    caption = (
        "The largest difference to the centralised estimate of the same readings, of all areas and all "
        f"{next(iter(courses.values())).places[1]} that they see, against the time since the scan. A line begins when "
        "every area has published a state, and ends with the verdict."
    )
    return Drawing("gap", "Gap to the centralised estimate by strategy", caption, figure)


def _draw_steps(
    axis: Axes, rows: np.ndarray, column: int, end_s: float, label: str, number: int, *, marked: bool
) -> None:
    colour, line = COLOURS[number % len(COLOURS)], LINES[number % len(LINES)]
    x, y = _as_steps(rows, column, end_s)
    axis.plot(
        *(x, y),
        color=colour,
        linestyle=line,
        linewidth=1.4,
        label=label,
        marker=MARKERS[number % len(MARKERS)],
        markersize=4,
        # at states, not at the corners between them; or at the end of the line
        markevery=slice(0, max(len(x) - 2, 1), 2) if marked else slice(max(len(x) - 1, 0), None),
    )


def _as_steps(rows: np.ndarray, column: int, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a line that keeps each gap until the next state, the last until the end."""
    times = np.maximum(np.append(rows[:, 0], max(end_s, SHORTEST_S)), SHORTEST_S)
    if len(rows) == 0:
        return np.zeros(0), np.zeros(0)
    gaps = np.maximum(rows[:, column], SMALLEST)  # nan stays nan
    return np.repeat(times, 2)[1:-1], np.repeat(gaps, 2)


def _finish(axes: Sequence[Axes], courses: Sequence[GapCourse]) -> None:
    """Set logarithmic axes from before the first known gap to the verdict, with the standard deviation as a line.

    A panel without a known gap shows the reason instead.
    """
    first = min((course.first_s for course in courses if course.first_s is not None), default=None)
    for column, (axis, label) in enumerate(zip(axes, PANELS, strict=True), start=1):
        axis.set_ylabel(f"largest gap,\n{label}")
        if any(np.isfinite(line.get_ydata()).any() for line in axis.lines):
            sigma = _median(np.array([course.sigma[column - 1] for course in courses]))
            _scale_gaps(axis, sigma, f"standard deviation (median {courses[0].places[0]})")
        else:
            reasons = {course.why_none for course in courses}
            write_instead(axis, reasons.pop() if len(reasons) == 1 else "no gap is known")
            continue
        if len(courses) == 1 and courses[0].consensus:
            axis.axvline(courses[0].end_s, color=INK, linestyle=(0, (1, 2)), linewidth=1.2, label="consensus noted")
    axes[-1].set_xlabel("virtual time since the scan (s)" if courses[0].virtual else "time since the scan (s)")
    if first is not None:  # all panels share their x axis
        axes[-1].set_xscale("log")
        axes[-1].set_xlim(first / 2, max(course.end_s for course in courses) * 1.15)
        axes[-1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes[-1].xaxis.set_major_formatter("{x:g}")
        axes[-1].xaxis.set_minor_formatter(NullFormatter())


def _scale_gaps(axis: Axes, sigma: float, label: str) -> None:
    """Scale the axis between powers of ten, so that at least two have labels; ``sigma`` as a line called ``label``, if
    it is known.
    """
    axis.set_yscale("log")
    if sigma > 0:
        axis.axhline(sigma, color=PURPLE, linestyle=(0, (5, 2)), linewidth=1.2, label=label)
    low, high = axis.get_ylim()
    axis.set_ylim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
    axis.yaxis.set_major_formatter(format_power_of_ten)
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)


def _why_no_gap(outcome: RunOutcome) -> str:
    if not outcome.history:
        return "no area has published a state"
    if outcome.centralised_failure is not None:
        return "there is no centralised estimate"
    return "no area's angles count from the substation"


def _describe(course: GapCourse) -> str:
    text = (
        "The largest difference of each area to the centralised estimate of the same readings, over all "
        f"{course.places[1]} that it sees, after each state that it has published. Both axes are logarithmic; time "
        "counts from the scan."
    )
    known = course.all_areas[~np.isnan(course.all_areas[:, 1])]
    if len(known) == 0:
        return text
    last = f"{known[-1, 1]:.1e} p.u."
    return f"{text} All areas have a state from {known[0, 0]:.3g} s on; at the end the largest gap is {last}"
