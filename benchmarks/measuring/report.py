"""results.md, results.json and times.png of one comparison."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from benchmarks.estimates.batch import BatchRow, format_batches
from benchmarks.estimates.comparison import DrawRow, Row

NOTES = """\
- cold: the model from the tool's own input tables, then the estimate. warm: a second estimate on the same model, same
  readings, flat start. pandapower knows no model that is kept: its two figures are one. What the tool needs the first
  time in a process (imports, compilation) is not in.
- Times are medians; every tool was timed in turn with ours, in the same process. The ratio is its time divided by ours:
  above 1, ours is faster. Ratios differ from machine to machine, milliseconds more so.
- J is computed by one function for all. max dV: largest difference of a complex voltage from ours, p.u.
- Ours returns its complete result; power-grid-model is asked for node voltages only.
"""


def write_report(
    folder: Path,
    command: str,
    machine: Mapping[str, str],
    rows: Sequence[Row],
    draws: Sequence[DrawRow],
    batches: Sequence[BatchRow] = (),
) -> list[Path]:
    """Write the three files into ``folder``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown, data, plot = (folder / name for name in ("results.md", "results.json", "times.png"))
    markdown.write_text(format_report(command, machine, rows, draws, batches), encoding="utf-8")
    content = {
        "command": command,
        "machine": dict(machine),
        "estimates": [asdict(row) for row in rows],
        "random_draws": [asdict(row) for row in draws],
        "batches": [asdict(row) for row in batches],
    }
    data.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    _plot_times(plot, rows)
    return [markdown, data, plot]


def format_report(
    command: str,
    machine: Mapping[str, str],
    rows: Sequence[Row],
    draws: Sequence[DrawRow],
    batches: Sequence[BatchRow] = (),
) -> str:
    """The report as Markdown."""
    parts = ["# Benchmarks", f"`{command}`", "\n".join(f"- {name}: {text}" for name, text in machine.items())]
    parts += ["## Estimates", format_estimates(rows), NOTES.rstrip()]
    if batches:
        parts += ["## Batches of scans", format_batches(list(batches))]
    if draws:
        parts += ["## Random draws solved", format_draws(draws)]
        parts += [
            "The same draws of load level (0.3 to 1.1) and noise for all, from the flat start. At the minimum: J is "
            "within 1e-6 of the lowest that any of the tools found on that draw."
        ]
    return "\n\n".join(parts) + "\n"


def format_estimates(rows: Sequence[Row]) -> str:
    """One row per case and method, a column of ratios (cold / warm) for each back end of ours."""
    ours = list(dict.fromkeys(own for row in rows for own in row.ratios))
    head = ["buses", "set", "method", "cold ms", "warm ms", *(f"divided by {own}, cold / warm" for own in ours)]
    lines = [_line([*head, "iterations", "J", "max dV", "remark"]), "|" + "---|" * (len(head) + 4)]
    for row in rows:
        figures = [""] * len(head)  # as many as there are between the method and the remark
        if (outcome := row.outcome) is not None:
            ratios = [
                "" if own == row.method or own not in row.ratios else "{:.2g} / {:.2g}".format(*row.ratios[own])
                for own in ours
            ]
            figures = [
                f"{outcome.timing.cold_ms:.3g}",
                f"{outcome.timing.warm_ms:.3g}",
                *ratios,
                str(outcome.iterations or ""),
                f"{outcome.objective:.6f}",
                "" if outcome.difference is None or row.method in ours else f"{outcome.difference:.1e}",
            ]
        lines.append(_line([str(row.n_bus), row.set_name, row.method, *figures, row.remark]))
    return "\n".join(lines)


def format_ratios(rows: Sequence[Row], what: Literal["cold", "warm"] = "warm") -> str:
    """One row per measurement set and method, a column for each size: ms of ours, ratios of the others."""
    sizes = list(dict.fromkeys(row.n_bus for row in rows))
    ours = list(dict.fromkeys(own for row in rows for own in row.ratios))
    head = ["set", f"method; {what}, divided by " + " / ".join(ours), *(f"{n} buses" for n in sizes)]
    lines = [_line(head), "|" + "---|" * len(head)]
    for set_name, method in dict.fromkeys((row.set_name, row.method) for row in rows):
        found = {row.n_bus: row for row in rows if (row.set_name, row.method) == (set_name, method)}
        unit = f"{method}, ms" if method in ours else method
        lines.append(_line([set_name, unit, *(_ratio(found.get(n), method in ours, what) for n in sizes)]))
    return "\n".join(lines)


def _ratio(row: Row | None, is_ours: bool, what: Literal["cold", "warm"]) -> str:
    if row is None or row.outcome is None:
        return row.remark if row else ""
    if is_ours:
        timing = row.outcome.timing
        rounded = float(f"{timing.cold_ms if what == 'cold' else timing.warm_ms:.2g}")
        return f"{rounded:g}"  # no exponent from 100 on
    return " / ".join(f"{cold if what == 'cold' else warm:.2g}" for cold, warm in row.ratios.values())


def format_draws(draws: Sequence[DrawRow]) -> str:
    """One row per measurement set and method."""
    lines = [_line(["buses", "set", "method", "draws", "estimated", "at the minimum", "failures"]), "|" + "---|" * 7]
    for row in draws:
        figures = [str(row.tried), _share(row.estimated, row.tried), _share(row.at_minimum, row.tried)]
        cells = figures if row.tried else [""] * 3
        lines.append(_line([str(row.n_bus), row.set_name, row.method, *cells, row.remark]))
    return "\n".join(lines)


def _share(count: int, of: int) -> str:
    return f"{count} ({100 * count / of:.0f} %)" if of else ""


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plot_times(path: Path, rows: Sequence[Row]) -> None:
    """Warm time against size, one panel per measurement set."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sets = list(dict.fromkeys(row.set_name for row in rows))
    methods = list(dict.fromkeys(row.method for row in rows))
    figure = Figure(figsize=(5 * len(sets) + 1, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(sets), sharey=True, squeeze=False)[0]
    for axis, set_name in zip(axes, sets, strict=True):
        for k, method in enumerate(methods):
            points = [
                (row.n_bus, row.outcome.timing.warm_ms)
                for row in rows
                if row.outcome is not None and (row.set_name, row.method) == (set_name, method)
            ]
            n_bus, time_ms = zip(*points, strict=True) if points else ((), ())
            axis.plot(n_bus, time_ms, marker="osD^vPX"[k % 7], color=f"C{k}", label=method)
        axis.set(xscale="log", yscale="log", title=f"measurement set {set_name}", xlabel="buses")
        axis.grid(which="both", alpha=0.25)
    axes[0].set_ylabel("warm estimate, ms (median)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    figure.savefig(path, dpi=120)
