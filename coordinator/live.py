"""The table of areas that lives in the terminal while a run goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table

from coordinator.observer import Progress


@contextmanager
def live_table(title: str) -> Iterator[Callable[[Progress], None]]:
    """A function that shows a run's progress in place; the table vanishes with the block, the verdict follows it."""
    console = Console(stderr=True)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda progress: live.update(build_table(title, progress), refresh=True)


def build_table(title: str, progress: Progress) -> Table:
    """The areas at one moment; gaps are the largest to a neighbour at a boundary bus."""
    waiting = f"waits: {progress.obstacles[0]}" if progress.obstacles else "consensus"
    more = f" (and {len(progress.obstacles) - 1} more)" if len(progress.obstacles) > 1 else ""
    table = Table(title=f"{title}   {progress.elapsed_s:.1f} s", caption=waiting + more, title_justify="left")
    for heading in ("area", "state"):
        table.add_column(heading)
    for heading in ("scan", "exchanges", "gap deg", "gap p.u.", "messages", "lost"):
        table.add_column(heading, justify="right")
    for area in progress.areas:
        table.add_row(
            area.name,
            area.state,
            str(area.scan),
            str(area.exchanges),
            "-" if area.gap_va is None else f"{math.degrees(area.gap_va):.2g}",
            "-" if area.gap_vm is None else f"{area.gap_vm:.2g}",
            str(area.messages),
            str(area.lost),
        )
    return table
