"""Normalised residuals of all meters, by kind of meter, with the limit above which a reading is suspect."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.plot_text import plot_text
from coordinator.show.figures.style import (
    BLUE,
    GREY,
    MAX_VECTOR,
    PURPLE,
    VERMILLION,
    Drawing,
    new_figure,
    style_by_phase,
    write_instead,
)
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.nodes import PHASES
from dsse_core.results.meters import REMOVED, read_in_own_units
from dsse_core.results.table import Table

MAX_NAMED = 8  # removed meters
SPREAD = 0.8  # part of a kind's width that its meters take


def draw_residuals(outcome: RunOutcome) -> Drawing:
    """Figure of each meter's normalised residual; where none is known, of |residual| / sigma of the meter."""
    meters, limit = outcome.meters, outcome.scenario.operating_limits.most_residual
    values, normalised = find_residuals(meters)
    removed = np.array([status == REMOVED for status in meters.status], dtype=bool)
    kinds = [kind for kind in MeasurementKind if kind in set(meters.kind) and not kind.is_virtual]
    figure, (axis,) = new_figure(4.2)
    x = _find_places(meters, kinds)
    used, style = np.flatnonzero(~removed), dict[str, Any](color=BLUE, marker=".", markersize=6)
    phase = np.array([PHASES.index(of) if of in PHASES else 0 for of in meters.phase], dtype=np.int64)
    for chosen, of_phase in style_by_phase("meter in use", style, phase[used]):
        _draw_marks(axis, x[used[chosen]], values[used[chosen]], of_phase)
    if removed.any():
        style = {"color": VERMILLION, "marker": "X", "markersize": 7, "label": "removed as bad data"}
        _draw_marks(axis, x[removed], values[removed], style)
        _name_removed(axis, x, values, meters, removed)
    if np.isnan(values).all():
        write_instead(axis, "no residual is known")
    else:
        axis.set_ylim(bottom=0, top=1.08 * max(limit, float(np.nanmax(values))))
    if normalised:
        axis.axhline(limit, color=PURPLE, linestyle="dashed", linewidth=1.5, label=f"limit, {limit:g}")
    for edge in range(1, len(kinds)):
        axis.axvline(edge - 0.5, color=GREY, linewidth=0.6, alpha=0.5)
    axis.set_xticks(range(len(kinds)), [kind.words.replace(" ", "\n") for kind in kinds], fontsize="small")
    axis.set_xlim(-0.5, len(kinds) - 0.5)
    by = "its standard deviation" if normalised else "the meter's standard deviation"
    axis.set_ylabel("normalised residual" if normalised else "residual by standard deviation of the meter")
    axis.grid(axis="y", alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")
    return Drawing("residuals", "Residuals of the meters", _describe(meters, values, by, normalised, limit), figure)


def find_residuals(meters: Table) -> tuple[np.ndarray, bool]:
    """Normalised residuals (n_meas,), nan where not known, and True; if none is known at all, |residual| / sigma and
    False."""
    normalised = np.asarray(meters.normalised_residual)
    if not np.isnan(normalised).all():
        return normalised, True
    own = read_in_own_units(meters)
    sigma = np.where(own["sigma"] > 0, own["sigma"], np.nan)
    return abs(own["residual"]) / sigma, False


def _find_places(meters: Table, kinds: list[MeasurementKind]) -> np.ndarray:
    """Positions of meters on the axis, (n_meas,): side by side within the width of their kind, in the table's order."""
    places = np.full(len(meters), np.nan)
    for number, kind in enumerate(kinds):
        rows = [k for k, of in enumerate(meters.kind) if of == kind]
        places[rows] = number + np.linspace(-SPREAD / 2, SPREAD / 2, len(rows)) * (len(rows) > 1)
    return places


def _draw_marks(axis: Axes, x: np.ndarray, y: np.ndarray, style: dict[str, Any]) -> None:
    axis.plot(x, y, linestyle="none", rasterized=len(x) > MAX_VECTOR, **style)


def _name_removed(axis: Axes, x: np.ndarray, values: np.ndarray, meters: Table, removed: np.ndarray) -> None:
    worst = sorted(np.flatnonzero(removed).tolist(), key=lambda k: -np.nan_to_num(values[k]))
    for k in worst[:MAX_NAMED]:
        if not np.isnan(values[k]):
            left = x[k] > axis.get_xlim()[1] / 2
            place, align = ((-7, 0), "right") if left else ((7, 0), "left")
            name = plot_text(meters.meter[k], 30)
            axis.annotate(name, (x[k], values[k]), place, textcoords="offset points", ha=align, va="center", fontsize=8)


def _describe(meters: Table, values: np.ndarray, by: str, normalised: bool, limit: float) -> str:
    known = int((~np.isnan(values)).sum())
    text = f"Each meter's reading minus estimate, as a multiple of {by}; {known} of {len(meters)} meters have one."
    if known == 0:
        return text
    largest = int(np.nanargmax(values))
    text += f" Largest: {values[largest]:.2f}, {meters.meter[largest]}."
    if normalised:
        above = int((values > limit).sum())
        text += f" {above} above the limit of {limit:g}, beyond which a reading is suspect."
    else:
        text += " Normalised residuals are not known: the areas' standard deviations differ from the centralised ones."
    return text
