"""What a watcher sees of a run as text, 80 columns wide: one line for each area, and below it why it is not good."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from agents.protocol.quality import DEGRADED, GOOD
from coordinator.observe.view import AreaView, Extreme, View
from dsse_core.printable import listed, printable, shortened
from dsse_core.results.table import Table

WIDTH = 80
MOST_LISTED = 12  # processes that are no areas
MOST_AREAS = 200
MOST_NOTES = 3  # of an area
LONGEST_SENTENCE = 300  # `dsse watch --json` has all sentences whole
COLUMNS = (("area", 16), ("quality", 14), ("age s", 6), ("voltage p.u.", 12))
SHOWN_OF_TABLE = 40  # rows in a terminal; --json has all
STYLES = {GOOD: "green", DEGRADED: "yellow"}  # every other quality is red


def format_view(view: View, tables: Iterable[Table] = (), most: int | None = None) -> str:
    """The view, and below it ``tables`` with ``most`` rows each, as lines of WIDTH characters at most."""
    lines = [text for text, _ in _write_view(view)]
    for table in tables:
        lines += ["", *_write_table(table, most)]
    return "\n".join(lines)


@contextmanager
def live_view() -> Iterator[Callable[[View, Iterable[Table]], None]]:
    """A function that shows what a watcher sees in place, in colours."""
    with Live(console=Console(), auto_refresh=False) as live:

        def update(view: View, tables: Iterable[Table]) -> None:
            text = Text("\n").join(Text(line, style=style) for line, style in _write_view(view))
            for table in tables:
                text.append("\n\n" + "\n".join(_write_table(table, SHOWN_OF_TABLE)))
            live.update(text, refresh=True)

        yield update


def _write_view(view: View) -> Iterator[tuple[str, str]]:
    """Lines and their styles."""
    qualities = [area.quality for area in view.areas]
    counts = [f"{qualities.count(quality)} {quality}" for quality in dict.fromkeys(qualities)]
    scan = max((area.scan for area in view.areas), default=0)
    title = f"run {view.run}, scan {scan}: {_count(len(qualities), 'area')}, {listed(counts) or 'nobody is there'}"
    yield from ((line, "bold") for line in _wrap(title))
    strangers = [f"{view.strangers} more are announced as areas and not shown"] if view.strangers else []
    for remark in (_write_others(view), *strangers, *view.duplicates[:MOST_LISTED], *view.other_versions):
        yield from ((line, "") for line in _wrap(remark))
    yield _columns([name for name, _ in COLUMNS], "worst normalised residual"), "bold"
    for area in _choose_areas(view.areas):
        cells = [
            shortened(printable(area.name), COLUMNS[0][1]),
            shortened(printable(area.quality), COLUMNS[1][1]),
            "-" if area.age_s is None else _seconds(area.age_s),
            _write_band(area),
        ]
        worst = _write_worst(area.worst_meter)
        yield _columns(cells, worst), STYLES.get(area.quality, "red")
        for remark in _remarks(area, scan):
            yield from ((line, "") for line in _wrap(remark, "    "))
    if len(view.areas) > MOST_AREAS:
        yield f"... and {len(view.areas) - MOST_AREAS} areas more: --json has all", ""


def _choose_areas(areas: Sequence[AreaView]) -> Sequence[AreaView]:
    """Where there are very many: those that are not good, then good ones, then those that have never said anything."""
    if len(areas) <= MOST_AREAS:
        return areas
    return sorted(areas, key=lambda area: 2 if area.age_s is None else int(area.quality == GOOD))[:MOST_AREAS]


def _write_others(view: View) -> str:
    shown = view.others[:MOST_LISTED]
    more = len(view.others) - len(shown) + view.more_others
    return f"also there: {', '.join(shown) or 'nobody'}{f' and {more} more' if more else ''}"


def _remarks(area: AreaView, scan: int) -> Iterator[str]:
    """Why it is no better, the worst first."""
    if 0 < area.scan != scan:
        yield f"works on scan {area.scan}"
    said = f" (it said {area.said_quality})" if area.quality != area.said_quality else ""
    for k, note in enumerate(area.notes[:MOST_NOTES]):
        yield shortened(note, LONGEST_SENTENCE) + said * (k == 0)
    if len(area.notes) > MOST_NOTES:
        yield f"and {len(area.notes) - MOST_NOTES} notes more: --json has all"


def _columns(cells: Sequence[str], last: str) -> str:
    padded = "  ".join(cell.ljust(width) for cell, (_, width) in zip(cells, COLUMNS, strict=True))
    return shortened(f"{padded}  {last}".rstrip(), WIDTH)


def _write_band(area: AreaView) -> str:
    if area.lowest_vm is None or area.highest_vm is None:
        return "-"
    return f"{area.lowest_vm.value:.3f}..{area.highest_vm.value:.3f}"


def _write_worst(worst: Extreme | None) -> str:
    return "-" if worst is None else f"{shortened(printable(worst.at), 20)} {worst.value:.1f}"


def _wrap(text: str, indent: str = "") -> list[str]:
    lines = textwrap.wrap(printable(text), WIDTH, initial_indent=indent, subsequent_indent=indent)
    return lines or [indent]


def _seconds(value: float) -> str:
    """However absurd."""
    return f"{value:.1f}" if abs(value) < 1e4 else f"{value:.0e}"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _write_table(table: Table, most: int | None) -> Iterator[str]:
    """The columns that fit, the first ``most`` rows."""
    shown = len(table) if most is None else min(most, len(table))
    known = [name for name in table.columns if not _is_unknown(table[name])]
    columns = [[name, *map(_cell, table[name][:shown])] for name in known]
    widths = [max(map(len, column)) for column in columns]
    fitting = int(np.searchsorted(np.cumsum([width + 2 for width in widths]), WIDTH + 2, side="right"))
    for row in zip(*columns[:fitting], strict=True):
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip()
    if shown < len(table):
        yield f"... and {len(table) - shown} rows more: --json has all"


def _is_unknown(column: np.ndarray | tuple[str, ...]) -> bool:
    """Whether no row has anything there."""
    return not isinstance(column, tuple) and column.dtype.kind == "f" and bool(np.isnan(column).all())


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.5g}"
    return shortened(printable(value), 24)
