"""The figure of a sweep: gap and time against the varied key, one line per strategy with the spread of its seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from coordinator.lab.studies.study_row import NO_CONSENSUS, StudyRow
from coordinator.lab.studies.sweep_plan import Task
from coordinator.show.figures.plot_text import plot_text
from coordinator.show.figures.style import COLOURS, LINES, MARKERS, Drawing, format_power_of_ten, new_figure, styled
from dsse_core.files.bounded_parsing import parse_toml

SPREAD = (10, 90)  # percentiles between which the band lies
SMALLEST = 1e-16  # in the place of 0 on a logarithmic axis
MAX_LABELS = 12


def draw_sweep(key: str, rows: Mapping[Task, StudyRow]) -> Drawing:
    """Draws ``rows``: above, the final gap to the centralised estimate; below, the time until it stays under 1e-6."""
    with styled():
        return _draw_sweep(key, rows)


def _draw_sweep(key: str, rows: Mapping[Task, StudyRow]) -> Drawing:
    figure, (above, below) = new_figure(7.0, rows=2)
    values = sorted({task.value for task in rows}, key=place_of_value)
    numbers = [_number(value) for value in values]
    x = [number for number in numbers if number is not None]
    if len(x) < len(numbers):
        x = list(map(float, range(len(values))))
        step = -(-len(values) // MAX_LABELS)
        below.set_xticks(x[::step], list(map(plot_text, values[::step])))
    for number, strategy in enumerate(dict.fromkeys(task.strategy for task in sorted(rows, key=lambda t: t.strategy))):
        of_value = [[r for t, r in rows.items() if (t.value, t.strategy) == (v, strategy)] for v in values]
        _draw(above, x, of_value, lambda row: row.gap, _name_outcomes(strategy, of_value), number)
        _draw(below, x, of_value, lambda row: row.below_1e6_s, strategy, number)
    above.set_ylabel("final gap to the centralised\nestimate (p.u. or rad)")
    below.set_ylabel("virtual time until the gap\nstays below 1e-6 (s)")
    below.set_xlabel(plot_text(key))
    for axis in (above, below):
        if any(np.isfinite(line.get_ydata()).any() for line in axis.lines):  # a logarithmic scale needs a value
            axis.set_yscale("log")
            low, high = axis.get_ylim()
            axis.set_ylim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
            axis.yaxis.set_major_formatter(format_power_of_ten)
            axis.yaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small")
    seeds = len({task.seed for task in rows})
    spread = f"median and {SPREAD[0]} to {SPREAD[1]} % of {seeds} seed{'s' if seeds > 1 else ''}"
    above.set_title(spread, fontsize="small", loc="left")
    caption = (
        f"Above, the final largest difference to the centralised estimate; below, the time until it stays below "
        f"1e-6 in all areas; against {key}. Lines: medians; bands: {SPREAD[0]} to {SPREAD[1]} % of {seeds} seeds."
    )
    return Drawing("sweep", "Gap and time against the varied key", caption, figure)


def _draw(
    axis: Axes,
    x: Sequence[float],
    rows_of_value: Sequence[Sequence[StudyRow]],
    figure_of: Callable[[StudyRow], float | None],
    name: str,
    number: int,
) -> None:
    """Draws a line with its band. Runs without the figure count as infinitely large; the legend gives their number."""
    lines = np.full((3, len(x)), np.nan)
    without = 0
    for column, rows in enumerate(rows_of_value):
        found = [figure_of(row) for row in rows]
        without += found.count(None)
        if found:
            known = [np.inf if value is None else max(value, SMALLEST) for value in found]
            lines[:, column] = np.percentile(known, (SPREAD[0], 50, SPREAD[1]), method="inverted_cdf")
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


def _name_outcomes(strategy: str, rows_of_value: Sequence[Sequence[StudyRow]]) -> str:
    """``strategy`` with the number of its runs without consensus, whose gap is not final."""
    outcomes = [row.outcome for rows in rows_of_value for row in rows]
    cut = outcomes.count(NO_CONSENSUS)
    return f"{strategy} (no consensus in {cut} of {len(outcomes)} runs)" if cut else strategy


def _number(value: str) -> float | None:
    try:
        found = parse_toml(f"value = {value}")["value"]
    except ValueError:
        return None
    return float(found) if type(found) in (int, float) else None


def place_of_value(value: str) -> tuple[bool, float, str]:
    """Key for sorting values: numbers in their order, then words."""
    number = _number(value)
    return (number is None, number or 0.0, value)
