"""The table of areas in the terminal, renewed during a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from coordinator.watch.interrupts import Uninterrupted
from coordinator.watch.observe.progress import Progress
from dsse_core.printable import printable, shortened

LONGEST_CELL = 300  # characters of a sentence; `dsse watch --json` and the verdict have it in full


@contextmanager
def live_table(title: str) -> Iterator[Callable[[Progress], None]]:
    """A function that shows a run's progress in place; the table vanishes at the end of the block."""
    console = Console(stderr=True)
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def update(progress: Progress) -> None:
            with Uninterrupted():  # a drawing cut short stays on the screen, and the next one begins in its last line
                live.update(build_table(title, progress), refresh=True)

        yield update


def build_table(title: str, progress: Progress) -> Table:
    """Table of the areas at one moment; mismatches are the largest with a neighbour at a boundary bus."""
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
