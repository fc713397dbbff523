"""A watcher's view of a run as lines: one for each area, and below it the reasons for its quality."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from rich.console import Console
from rich.live import Live
from rich.text import Text

from agents.protocol.quality import DEGRADED, GOOD, QUALITIES, RELATIVE_ANGLE
from coordinator.watch.interrupts import Uninterrupted
from coordinator.watch.observe.causes import ALARM, Cause, write_lines
from coordinator.watch.observe.summary import Extent, Power, Summary
from coordinator.watch.observe.table_text import write_table
from coordinator.watch.observe.view import AreaView, Extreme, View
from dsse_core.printable import listed, printable, shortened
from dsse_core.results.table import Table
from dsse_core.split_identity import SHOWN, SplitIdentity

WIDTH = 80
MOST_LISTED = 12  # processes other than areas
MOST_AREAS = 200
MOST_NOTES = 3  # of an area
LONGEST_SENTENCE = 300  # characters; `dsse watch --json` has all sentences in full
COLUMNS = (("area", 16), ("quality", 14), ("age s", 6), ("voltage p.u.", 12))
LEAST_ROWS = 3  # of a table in a terminal with too few lines
WIDEST = 160  # characters; longer lines are hard to read
STYLES = {GOOD: "green", DEGRADED: "yellow", RELATIVE_ANGLE: "yellow"}  # every other quality is red


def format_view(
    view: View,
    tables: Iterable[Table] = (),
    causes: Sequence[Cause] = (),
    summary: Summary | None = None,
    *,
    most: int | None = None,
) -> str:
    """The causes, the view, and below it ``tables`` with ``most`` rows each, as lines of WIDTH characters at most."""
    lines = [text for text, _ in (*_write_causes(causes, WIDTH), *_write_view(view, WIDTH, summary))]
    for table in tables:
        lines += ["", *write_table(table, WIDTH, most)]
    return "\n".join(lines)


@contextmanager
def live_view() -> Iterator[Callable[[View, Iterable[Table], Sequence[Cause], Summary | None], None]]:
    """A function that shows a view in place, in colours, as much of it as the terminal holds."""
    console = Console()
    with Live(console=console, auto_refresh=False) as live:

        def update(view: View, tables: Iterable[Table], causes: Sequence[Cause], summary: Summary | None) -> None:
            width, height = min(console.width, WIDEST), console.height - 1  # the cursor stands in the last line
            lines = fit_view(view, list(tables), width, height, causes, summary)
            with Uninterrupted():  # a drawing cut short stays on the screen, and the next one begins in its last line
                live.update(Text("\n").join(Text(line, style=style) for line, style in lines), refresh=True)

        yield update


def fit_view(
    view: View,
    tables: Sequence[Table],
    width: int,
    height: int,
    causes: Sequence[Cause] = (),
    summary: Summary | None = None,
) -> list[tuple[str, str]]:
    """Lines and their styles, ``height`` at most: causes, areas, and as many rows of ``tables`` as fit.

    Where not all fits, the first cause stands alone, and areas of the worst quality come first.
    """
    beside = 3  # lines of a table beside its rows: an empty one, the heading, the number of rows left out
    room = height - len(tables) * (LEAST_ROWS + beside)
    of_view = list(_write_view(view, width, summary))
    lines = [*_write_causes(causes, width), *of_view]
    if len(lines) > room:
        first = [(line, "bold red") for cause in causes[:1] for line in _wrap(str(cause), width)]
        lines = [*first, *of_view]
    if len(lines) > room:
        shown = max(1, room - 1)
        rank = {quality: -k for k, quality in enumerate(QUALITIES)}
        worst_first = sorted(view.areas, key=lambda area: rank.get(area.quality, -len(rank)))
        lines = [*first, *_write_view(replace(view, areas=tuple(worst_first)), width, summary)]
        lines = [*lines[:shown], (f"... and {len(lines) - shown} lines more: --once shows all", "")]
    for k, table in enumerate(tables):
        rows = max(LEAST_ROWS, (height - len(lines)) // (len(tables) - k) - beside)
        lines += [("", ""), *((line, "") for line in write_table(table, width, rows))]
    return lines[: max(1, height)]


def _write_causes(causes: Sequence[Cause], width: int) -> Iterator[tuple[str, str]]:
    """Lines of all causes, the first one in the first line, each with its effects below it."""
    for cause, (what, *below) in write_lines(causes):
        colour = "red" if cause.severity == ALARM else "yellow"
        yield from ((line, f"bold {colour}" if cause is causes[0] else colour) for line in _wrap(what, width))
        yield from ((line, "") for text in below for line in _wrap(text.strip(), width, "  "))


def _write_view(view: View, width: int, summary: Summary | None) -> Iterator[tuple[str, str]]:
    """All lines of ``view`` with their styles, ``width`` characters at most."""
    qualities = [area.quality for area in view.areas]
    counts = [f"{qualities.count(quality)} {quality}" for quality in dict.fromkeys(qualities)]
    scan = max((area.scan for area in view.areas), default=0)
    title = f"run {view.run}, scan {scan}: {_count(len(qualities), 'area')}, {listed(counts) or 'nobody is there'}"
    yield from ((line, "bold") for line in _wrap(title, width))
    strangers = [f"{view.strangers} more are announced as areas and not shown"] if view.strangers else []
    of_grid = write_summary(summary) if summary else ()
    remarks = *of_grid, _write_others(view), *strangers, *view.duplicates[:MOST_LISTED], *view.other_versions
    for remark in (*remarks, *_write_splits(view.areas)):
        yield from ((line, "") for line in _wrap(remark, width))
    yield _columns([name for name, _ in COLUMNS], "worst norm. residual", width), "bold"
    for area in _choose_areas(view.areas):
        cells = [
            shortened(printable(area.name), COLUMNS[0][1]),
            shortened(printable(area.quality), COLUMNS[1][1]),
            "-" if area.age_s is None else _seconds(area.age_s),
            _write_band(area),
        ]
        worst = _write_worst(area.worst_meter)
        yield _columns(cells, worst, width), STYLES.get(area.quality, "red")
        for remark in _remarks(area, scan):
            yield from ((line, "") for line in _wrap(remark, width, "    "))
    if len(view.areas) > MOST_AREAS:
        yield f"... and {len(view.areas) - MOST_AREAS} areas more: --json has all", ""


def write_summary(summary: Summary) -> Iterator[str]:
    """Sentences on the voltages and loadings of the present, and on the powers of the grid."""
    voltage, loading, head, limits = summary.voltage, summary.loading, summary.head, summary.limits
    buses, branches = ("nodes", "conductors") if summary.has_phases else ("buses", "branches")
    yield _describe_extent(voltage, buses, ".4f", " p.u.", f"{limits.lowest_vm:g} to {limits.highest_vm:g}")
    if (unbalance := summary.unbalance).highest is not None:
        text = f"largest unbalance |V-| / |V+| {unbalance.highest.value:.2f} % at bus {printable(unbalance.highest.at)}"
        beyond = f"; above {limits.most_unbalance_percent:g} %: {listed([each.at for each in unbalance.worst])}"
        yield f"{text}{beyond if unbalance.outside else ''}"
    if loading.total:
        yield _describe_extent(loading, f"{branches} with a rating", ".1f", " %", f"{limits.most_loading_percent:g}")
    if summary.loss.total:
        powers = [("head", head), ("load", summary.load), ("generation", summary.generation), ("losses", summary.loss)]
        said = [f"{name} {power.p_kw:.1f}{_count_parts(power)}" for name, power in powers if power.p_kw is not None]
        yield f"power in kW: {', '.join(said) or 'not known'}"


def _describe_extent(extent: Extent, things: str, form: str, unit: str, limits: str) -> str:
    """A sentence that names the limits: without a scenario they need not be those of the run."""
    if extent.lowest is None or extent.highest is None:
        return f"of {extent.total} {things} none is known"
    counted = (
        f"{extent.total} {things}"
        if extent.known == extent.total
        else f"of {extent.total} {things} {extent.known} known"
    )
    band = f"{extent.lowest.value:{form}} to {extent.highest.value:{form}}{unit}"
    if not extent.outside:
        return f"{counted}, within {limits}{unit}: {band}"
    worst = ", ".join(f"{printable(each.at)} {each.value:{form}}" for each in extent.worst)
    return f"{counted}, {band}; {extent.outside} beyond {limits}{unit}: {worst}"


def _count_parts(power: Power) -> str:
    return "" if power.known == power.total else f" ({power.known} of {power.total} known)"


def _choose_areas(areas: Sequence[AreaView]) -> Sequence[AreaView]:
    """All areas, or the first MOST_AREAS: those not good, then good ones, then those that have never published."""
    if len(areas) <= MOST_AREAS:
        return areas
    return sorted(areas, key=lambda area: 2 if area.age_s is None else int(area.quality == GOOD))[:MOST_AREAS]


def _write_others(view: View) -> str:
    shown = view.others[:MOST_LISTED]
    more = len(view.others) - len(shown) + view.more_others
    return f"also there: {', '.join(shown) or 'nobody'}{f' and {more} more' if more else ''}"


def _write_splits(areas: Sequence[AreaView]) -> Iterator[str]:
    """The splits of the area files, with the areas of each where there are several, and next splits that lie ready."""
    names: dict[SplitIdentity, list[str]] = {}
    for area in areas:
        if area.split:
            names.setdefault(SplitIdentity(area.split, area.split_time, area.split_edited), []).append(area.name)
    whose = sorted(names, key=lambda split: split.age_order)
    if len(whose) == 1:
        yield f"area files: {whose[0]}"
    elif whose:
        parts = "; ".join(f"{split}: {listed(names[split], MOST_LISTED)}" for split in whose[:MOST_LISTED])
        yield f"area files of {len(whose)} splits: {parts}"
    ready: dict[str, list[str]] = {}
    for area in areas:
        if area.next_split:
            ready.setdefault(area.next_split, []).append(area.name)
    for digest, holders in list(ready.items())[:MOST_LISTED]:
        count = f"{len(holders)} of {len(areas)} areas"
        yield f"files of the next split {digest[:SHOWN]} lie ready in {count}: {listed(holders, MOST_LISTED)}"


def _remarks(area: AreaView, scan: int) -> Iterator[str]:
    """The scan of an area where it is not the newest, and its notes, the worst first."""
    if 0 < area.scan != scan:
        yield f"works on scan {area.scan}"
    if area.estimated and not area.freshness.fresh:
        yield f"its numbers are {area.freshness.value_age_s:.0f} s old"
    own_quality = f" (it said {area.said_quality})" if area.quality != area.said_quality else ""
    for k, note in enumerate(area.notes[:MOST_NOTES]):
        yield shortened(note, LONGEST_SENTENCE) + own_quality * (k == 0)
    if len(area.notes) > MOST_NOTES:
        yield f"and {len(area.notes) - MOST_NOTES} notes more: --json has all"


def _columns(cells: Sequence[str], last: str, width: int) -> str:
    padded = "  ".join(cell.ljust(wide) for cell, (_, wide) in zip(cells, COLUMNS, strict=True))
    return shortened(f"{padded}  {last}".rstrip(), width)


def _write_band(area: AreaView) -> str:
    if area.lowest_vm is None or area.highest_vm is None:
        return "-"
    return f"{area.lowest_vm.value:.3f}..{area.highest_vm.value:.3f}"


def _write_worst(worst: Extreme | None) -> str:
    return "-" if worst is None else f"{shortened(printable(worst.at), 20)} {worst.value:.1f}"


def _wrap(text: str, width: int, indent: str = "") -> list[str]:
    lines = textwrap.wrap(
        printable(text), max(width, 2 * len(indent) + 1), initial_indent=indent, subsequent_indent=indent
    )
    return lines or [indent]


def _seconds(value: float) -> str:
    """Seconds with one decimal; from 1e4 on, with an exponent."""
    return f"{value:.1f}" if abs(value) < 1e4 else f"{value:.0e}"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"
