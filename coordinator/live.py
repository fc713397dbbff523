"""The tables of areas that live in the terminal: of a run that goes on, and of a system that is watched."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table

from coordinator.progress import Progress
from coordinator.watch import View


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
    "heard s ago",
    "telemetry s old",
    "neighbours s old",
    "gap deg",
    "gap p.u.",
    "exchanges",
    "messages",
    "lost",
    "refused",
)


def build_view_table(view: View) -> Table:
    """What a watcher sees of a run; gaps are the largest to a neighbour at a bus that both publish."""
    below = "\n".join([f"also there: {', '.join(view.others) or 'nobody'}", *view.doubles])
    table = Table(title=f"run {view.run}", caption=below, title_justify="left")
    for heading in ("area", "state"):
        table.add_column(heading)
    for heading in WATCHED:
        table.add_column(heading, justify="right")
    table.add_column("notes")
    for area in view.areas:
        table.add_row(
            area.name,
            area.state,
            area.quality if area.quality == area.said_quality else f"{area.quality} (said {area.said_quality})",
            str(area.scan),
            "-" if area.age_s is None else f"{area.age_s:.1f}",
            f"{area.telemetry_age_s:.1f}",
            "-" if not area.ages_s else f"{max(area.ages_s.values()):.1f}",
            "-" if area.gap_va_deg is None else f"{area.gap_va_deg:.2g}",
            "-" if area.gap_vm_pu is None else f"{area.gap_vm_pu:.2g}",
            str(area.exchanges),
            str(area.messages),
            str(area.lost),
            str(sum(area.refused.values())),
            "; ".join(area.notes),
        )
    return table
