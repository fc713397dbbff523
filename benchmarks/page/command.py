"""``python -m benchmarks.page tasks``, ``... day`` and ``... pictures``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.machine import describe_machine
from benchmarks.page.browser import choose_bus, looking
from benchmarks.page.day import COUNT, Sample, sample_day
from benchmarks.page.pictures import take_pictures
from benchmarks.page.server import serving
from benchmarks.page.tasks import CATEGORIES, Task, find_tasks

PACKAGES = ("starlette", "uvicorn", "playwright", "consensus-dsse")
MOST_MS = 50.0  # of one task: a longer one noticeably delays a click
BUS = 7
TURNS, TURN_MS = 4, 150  # of the mouse wheel over the drawing
UNTIMED = ("--disable-frame-rate-limit", "--disable-gpu-vsync")  # pictures as fast as they are made


@click.group()
def main() -> None:
    """Cost of a page for a browser and its server; areas are made up, and say something new at each moment."""


@main.command(context_settings={"show_default": True})
@click.argument("scenario")
@click.option("--seconds", type=click.FloatRange(1), default=10.0, help="How long each part of the page is looked at.")
@click.option("--longest", type=click.IntRange(1), default=10, help="Tasks that are listed.")
@figures_option
def tasks(scenario: str, seconds: float, longest: int, figures: str | None) -> None:
    """List the longest tasks of the browser's main thread, by its processor time, while SCENARIO is looked at.

    The page is opened, a bus chosen, the drawing zoomed, and each table scrolled to. Exit code 1: a task took more than
    50 ms.
    """
    machine = describe_machine(PACKAGES)
    with serving(scenario) as server, looking() as page:
        browser = page.context.browser
        browser.start_tracing(page=page, categories=list(CATEGORIES))
        choose_bus(page, server.url, BUS)
        page.wait_for_timeout(seconds * 1000)
        page.hover("#drawing")
        for _ in range(TURNS):
            page.mouse.wheel(0, -100)
            page.wait_for_timeout(TURN_MS)
        for part in ("#areas", "#meters", "#events"):
            page.locator(part).scroll_into_view_if_needed()
            page.wait_for_timeout(seconds * 1000)
        found = find_tasks(browser.stop_tracing())
        version = browser.version
    table = list_tasks(found, longest)
    click.echo(f"Chromium {version}, {scenario}, {len(found)} tasks\n\n{table}")
    if figures:
        write_section(figures, machine | {"Chromium": version}, table)
    if found and found[0].cpu_ms > MOST_MS:
        raise SystemExit(1)


def list_tasks(found: Sequence[Task], longest: int) -> str:
    """The first ``longest`` tasks as a Markdown table."""
    lines = [
        f"| {task.at_ms / 1000:.1f} | {task.cpu_ms:.1f} | {task.wall_ms:.0f} | "
        f"{', '.join(f'{name} {ms:.1f}' for name, ms in task.inside)} |"
        for task in found[:longest]
    ]
    return "\n".join(
        ["| after (s) | processor time (ms) | wall clock (ms) | of it (ms) |", "|---|---|---|---|", *lines]
    )


@main.command(context_settings={"show_default": True})
@click.option("--scenario", default="ieee33", help="Whose areas are made up.")
@click.option("--moments", type=click.IntRange(12), default=86_400, help="Of the server: one a second for 24 hours.")
@click.option("--samples", type=click.IntRange(2), default=24, help="Of memory, in even steps.")
@figures_option
def day(scenario: str, moments: int, samples: int, figures: str | None) -> None:
    """Watch the memory of a page and its server while the server makes MOMENTS, both as fast as they can."""
    machine = describe_machine(PACKAGES)
    with serving(scenario, is_hurried=True) as server, looking(*UNTIMED) as page:
        page.add_init_script(COUNT)
        choose_bus(page, server.url, BUS)
        lines = ["| moments | received | shown | heap of the page (MB) | nodes | listeners | server (MB) | after (s) |"]
        lines.append("|---|---|---|---|---|---|---|---|")
        click.echo("\n".join(lines))
        for sample in sample_day(page, server, moments, samples):
            lines.append(_row(sample))
            click.echo(lines[-1])
    if figures:
        write_section(figures, machine, "\n".join(lines))


@main.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--scenario", default="ieee33-lossy", help="Whose run on the simulator is shown.")
def pictures(folder: Path, scenario: str) -> None:
    """Take the pictures of the documents anew, into FOLDER; look at them before they are kept."""
    for path in take_pictures(folder, scenario):
        click.echo(path)


def _row(sample: Sample) -> str:
    return (
        f"| {sample.moments} | {sample.received} | {sample.shown} | {sample.heap_mb:.2f} | {sample.nodes} | "
        f"{sample.listeners} | {sample.server_mb:.1f} | {sample.after_s:.0f} |"
    )
