"""The figure of a sweep: quantities against the first varied key, a line per strategy with the spread of its seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from coordinator.lab.studies.study_row import FIGURES, NO_CONSENSUS, StudyRow
from coordinator.lab.studies.sweep_plan import Task, number_of, place_of_value
from coordinator.show.figures.plot_text import plot_text
from coordinator.show.figures.style import (
    COLOURS,
    GREY,
    LINES,
    MARKERS,
    Drawing,
    format_power_of_ten,
    new_figure,
    styled,
)
from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import describe_unknown

SPREAD = (10, 90)  # percentiles between which the band lies
SMALLEST = 1e-16  # in the place of 0 on a logarithmic axis
LEAST_RATIO = 30.0  # of the largest to the smallest number on a logarithmic axis
MAX_LABELS = 12
MAX_KEYS = 2  # of an axis that its label names
DEFAULT = ("gap_vm_pu", "below_1e6_s")
UNITS = {"_vm_pu": ", magnitude (p.u.)", "_va_deg": ", angle (degrees)", "_s": " (virtual s)"}
WORDS = {
    "gap": "gap to the centralised\nestimate",
    "error": "error to the truth",
    "centralised_error": "error of the\ncentralised estimate",
    "end": "time of the verdict\n",
}
WORDS |= {f"below_1e{k}": f"time until the gap\nstays below 1e-{k}" for k in (3, 6, 8)}


def check_quantities(names: Sequence[str]) -> tuple[str, ...]:
    """The columns to draw: ``names``, DEFAULT if there are none.

    Raises:
        InvalidInputError: a name is no column with a figure.
    """
    if problems := [describe_unknown("quantity", name, FIGURES) for name in names if name not in FIGURES]:
        raise InvalidInputError("--quantity", problems)
    return tuple(dict.fromkeys(names)) or DEFAULT


def draw_sweep(
    axes_keys: Sequence[Sequence[str]], rows: Mapping[Task, StudyRow], quantities: Sequence[str] = DEFAULT
) -> Drawing:
    """Draws ``quantities`` of ``rows``, one below the other, against the keys of the first axis.

    A strategy has a line for each combination of values of the other axes.
    """
    with styled():
        return _draw_sweep(axes_keys, rows, quantities)


def _draw_sweep(
    axes_keys: Sequence[Sequence[str]], rows: Mapping[Task, StudyRow], quantities: Sequence[str]
) -> Drawing:
    figure, axes = new_figure(0.8 + 3.1 * len(quantities), rows=len(quantities))
    values = sorted({task.values[0] for task in rows}, key=place_of_value)
    numbers = [number_of(value) for value in values]
    x = [number for number in numbers if number is not None]
    if len(x) < len(numbers):
        x = list(map(float, range(len(values))))
        step = -(-len(values) // MAX_LABELS)
        axes[-1].set_xticks(x[::step], list(map(plot_text, values[::step])))
    others = [name_keys(keys) for keys in axes_keys[1:]]
    lines = sorted(
        {(task.strategy, task.values[1:]) for task in rows}, key=lambda line: (line[0], *map(place_of_value, line[1]))
    )
    for number, (strategy, of_others) in enumerate(lines):
        of_line = {task.values[0]: [] for task in rows}  # type: dict[str, list[StudyRow]]
        for task, row in rows.items():
            if (task.strategy, task.values[1:]) == (strategy, of_others):
                of_line[task.values[0]].append(row)
        of_value = [of_line[value] for value in values]
        name = ", ".join([strategy, *(f"{key} = {value}" for key, value in zip(others, of_others, strict=True))])
        for place, (axis, quantity) in enumerate(zip(axes, quantities, strict=True)):
            shown = name if place else _name_outcomes(name, of_value)
            _draw(axis, x, of_value, quantity, plot_text(shown), number)
    for axis, quantity in zip(axes, quantities, strict=True):
        if quantity.startswith("error_"):
            of_centre = [[row for task, row in rows.items() if task.values[0] == value] for value in values]
            _draw_centre(axis, x, of_centre, f"centralised_{quantity}")
        axis.set_ylabel(_name_quantity(quantity))
        _scale(axis)
        axis.legend(fontsize="small")
    axes[-1].set_xlabel(plot_text(name_keys(axes_keys[0])))
    seeds = len({task.seed for task in rows})
    spread = f"median and {SPREAD[0]} to {SPREAD[1]} % of {seeds} seed{'s' if seeds > 1 else ''}"
    axes[0].set_title(spread, fontsize="small", loc="left")
    shown = "; ".join(" ".join(_name_quantity(quantity).split()) for quantity in quantities)
    caption = (
        f"From top to bottom, the largest of all buses or areas: {shown}; against {', '.join(axes_keys[0])}. "
        f"Lines: medians; bands: {SPREAD[0]} to {SPREAD[1]} % of {seeds} seeds."
    )
    return Drawing("sweep", f"{', '.join(quantities)} against {name_keys(axes_keys[0])}", caption, figure)


def name_keys(keys: Sequence[str]) -> str:
    """The keys of an axis by name; of many, the first and the number of the others."""
    return ", ".join(keys) if len(keys) <= MAX_KEYS else f"{keys[0]} and {len(keys) - 1} others"


def _name_quantity(column: str) -> str:
    """The label of a column with its unit."""
    unit = next((unit for unit in UNITS if column.endswith(unit)), "")
    stem = column.removesuffix(unit)
    return WORDS.get(stem, stem) + UNITS.get(unit, "")


def _scale(axis: Axes) -> None:
    """Set a logarithmic scale where the numbers differ by LEAST_RATIO, else a linear one from 0 on."""
    drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axis.lines] or [np.zeros(0)])
    known = drawn[np.isfinite(drawn)]
    if len(known) and known.max() > LEAST_RATIO * known.min():
        axis.set_yscale("log")
        low, high = axis.get_ylim()
        axis.set_ylim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
        axis.yaxis.set_major_formatter(format_power_of_ten)
        axis.yaxis.set_minor_formatter(NullFormatter())
    elif len(known):
        axis.set_ylim(0, None)
    axis.grid(alpha=0.3)


def _find_percentiles(rows_of_value: Sequence[Sequence[StudyRow]], quantity: str) -> tuple[np.ndarray, int]:
    """Median and band (3, n_value), infinite where a run without the figure decides, and the number of these runs."""
    lines = np.full((3, len(rows_of_value)), np.nan)
    without = 0
    for column, rows in enumerate(rows_of_value):
        found = [getattr(row, quantity) for row in rows]
        without += found.count(None)
        if found:
            known = [np.inf if value is None else max(value, SMALLEST) for value in found]
            lines[:, column] = np.percentile(known, (SPREAD[0], 50, SPREAD[1]), method="inverted_cdf")
    return lines, without


def _draw(
    axis: Axes,
    x: Sequence[float],
    rows_of_value: Sequence[Sequence[StudyRow]],
    quantity: str,
    name: str,
    number: int,
) -> None:
    """Draws a line with its band. Runs without the figure count as infinitely large; the legend gives their number."""
    lines, without = _find_percentiles(rows_of_value, quantity)
    low, median, high = np.where(np.isinf(lines), np.nan, lines)
    high = np.where(np.isnan(high), np.nanmax(lines, initial=SMALLEST, where=np.isfinite(lines)), high)
    colour = COLOURS[number % len(COLOURS)]
    style: dict[str, Any] = {
        "color": colour,
        "marker": MARKERS[number % len(MARKERS)],
        "linestyle": LINES[number % len(LINES)],
    }
    label = f"{name} (never in {without} of {sum(map(len, rows_of_value))} runs)" if without else name
    axis.plot(np.array(x, dtype=float), median, markersize=4, label=label, **style)
    axis.fill_between(np.array(x, dtype=float), low, high, where=~np.isnan(low), color=colour, alpha=0.2, linewidth=0)


def _draw_centre(axis: Axes, x: Sequence[float], rows_of_value: Sequence[Sequence[StudyRow]], quantity: str) -> None:
    """Draws the median of the centralised estimate, which all strategies are compared with."""
    median = _find_percentiles(rows_of_value, quantity)[0][1]
    axis.plot(x, np.where(np.isinf(median), np.nan, median), color=GREY, linestyle="dotted", label="centralised")


def _name_outcomes(name: str, rows_of_value: Sequence[Sequence[StudyRow]]) -> str:
    """``name`` with the number of its runs without consensus, whose figures are not final."""
    outcomes = [row.outcome for rows in rows_of_value for row in rows]
    cut = outcomes.count(NO_CONSENSUS)
    return f"{name} (no consensus in {cut} of {len(outcomes)} runs)" if cut else name
