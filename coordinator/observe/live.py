"""The tables of areas that live in the terminal: of a run that goes on, and of a system that is watched."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from coordinator.observe.progress import Progress
from coordinator.observe.watch import View
from dsse_core.printable import listed, printable, shortened

MOST_LISTED = 12  # notes of an area, or processes that are no areas
LONGEST_CELL = 300  # characters of a sentence; `dsse watch --json` and the verdict have them whole


@contextmanager
def live_table(title: str) -> Iterator[Callable[[Progress], None]]:
    """A function that shows a run's progress in place; the table vanishes with the block, the verdict follows it."""
    console = Console(stderr=True)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda progress: live.update(build_table(title, progress), refresh=True)


def build_table(title: str, progress: Progress) -> Table:
    """The areas at one moment; mismatches are the largest with a neighbour at a boundary bus."""
    waiting = shortened(f"waits: {progress.obstacles[0]}", LONGEST_CELL) if progress.obstacles else "consensus"
    more = f" (and {len(progress.obstacles) - 1} more)" if len(progress.obstacles) > 1 else ""
    table = _new_table(f"{title}   {progress.elapsed_s:.1f} s", waiting + more)
    for heading in ("area", "state"):
        table.add_column(heading)
    for heading in ("scan", "exchanges", "mismatch deg", "mismatch p.u.", "messages", "lost"):
        table.add_column(heading, justify="right")
    for area in progress.areas:
        _add_row(
            table,
            area.name,
            area.state,
            str(area.scan),
            str(area.exchanges),
            "-" if area.mismatch_va is None else f"{math.degrees(area.mismatch_va):.2g}",
            "-" if area.mismatch_vm is None else f"{area.mismatch_vm:.2g}",
            str(area.messages),
            str(area.lost),
        )
    return table


@contextmanager
def live_view() -> Iterator[Callable[[View], None]]:
    """A function that shows what a watcher sees in place."""
    with Live(console=Console(), auto_refresh=False) as live:
        yield lambda view: live.update(build_view_table(view), refresh=True)


def format_view(view: View) -> str:
    """The table of ``build_view_table`` as plain text, as wide as it needs to be."""
    console = Console(width=200, color_system=None, highlight=False)
    with console.capture() as captured:
        console.print(build_view_table(view))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


WATCHED = (
    "quality",
    "scan",
    "age s",
    "telemetry s",
    "neighbours s",
    "mismatch deg",
    "mismatch p.u.",
    "exchanges",
    "messages",
    "lost",
    "rejected",
)


def build_view_table(view: View) -> Table:
    """What a watcher sees of a run; mismatches are the largest with a neighbour at a bus that both publish."""
    others = listed(view.others, MOST_LISTED) or "nobody"
    remarks = [shortened(word, LONGEST_CELL) for word in (*view.duplicates[:MOST_LISTED], *view.other_versions)]
    table = _new_table(f"run {view.run}", f"also there: {others}", *remarks)
    for heading in ("area", "state"):
        table.add_column(heading)
    for heading in WATCHED:
        table.add_column(heading, justify="right")
    table.add_column("notes")
    for area in view.areas:
        _add_row(
            table,
            area.name,
            area.state,
            area.quality if area.quality == area.said_quality else f"{area.quality} (said {area.said_quality})",
            str(area.scan),
            "-" if area.age_s is None else f"{area.age_s:.1f}",
            _age(area.telemetry_age_s),
            "-" if not area.ages_s else _age(max(area.ages_s.values())),
            "-" if area.mismatch_va_deg is None else f"{area.mismatch_va_deg:.2g}",
            "-" if area.mismatch_vm_pu is None else f"{area.mismatch_vm_pu:.2g}",
            str(area.exchanges),
            str(area.messages),
            str(area.lost),
            str(sum(area.rejected.values())),
            listed([shortened(note, LONGEST_CELL) for note in area.notes], MOST_LISTED, "; "),
        )
    return table


def _new_table(title: str, *below: str) -> Table:
    """A table with a title and lines below it, all of them text and never markup."""
    return Table(
        title=Text(printable(title), style="table.title"),
        caption=Text("\n".join(map(printable, below)), style="table.caption"),
        title_justify="left",
    )


def _add_row(table: Table, *cells: str) -> None:
    """A row of text, which is never markup."""
    table.add_row(*(Text(printable(cell)) for cell in cells))


def _age(seconds: float) -> str:
    """As an area states it, however absurd."""
    return f"{seconds:.1f}" if abs(seconds) < 1e6 else f"{seconds:.3g}"
