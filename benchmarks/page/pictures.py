"""Pictures of the page for the documents: a run on the simulator, played back, in light, dark, print and on a phone."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from benchmarks.page.browser import choose_bus, looking

BUS = 18
BY_PHASE, BUS_BY_PHASE = "ieee13", 671  # a scenario with phases, and the bus that is selected
PHONE = {"width": 400, "height": 900}
SCREEN = {"width": 1280, "height": 820}


@contextmanager
def playing(scenario: str) -> Iterator[str]:
    """The address of a page that plays ``scenario``.

    Raises:
        click.ClickException: the server names no address.
    """
    words = [sys.executable, "-m", "coordinator", "serve", scenario, "--simulate", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            found = re.search(r"open (http\S+)", server.stdout.readline() if server.stdout else "")
            if found is None:
                raise click.ClickException(f"`dsse serve {scenario} --simulate` names no address to open")
            yield found[1]
        finally:
            server.terminate()


def take_pictures(folder: Path, scenario: str) -> list[Path]:
    """Write the pictures into ``folder``; their paths."""
    taken: list[Path] = []
    with playing(scenario) as url, looking() as page:

        def take(name: str, *, whole: bool = False) -> None:
            page.wait_for_timeout(500)  # another thread paints the feeder
            taken.append(folder / f"{name}.png")
            page.screenshot(path=taken[-1], full_page=whole)

        page.set_viewport_size(SCREEN)
        page.emulate_media(color_scheme="light")
        choose_bus(page, url, BUS)
        page.wait_for_selector("body[data-complete]")  # all of the run can be played
        _find_loss(page)
        take("page-playback")
        page.locator("#profile-section").scroll_into_view_if_needed()
        page.evaluate("document.querySelector('#profile-section').scrollIntoView()")
        take("page-tables")
        page.evaluate("scrollTo(0, 0)")
        page.emulate_media(color_scheme="dark")
        take("page-dark")
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        page.emulate_media(media="print", color_scheme="light")
        take("page-print", whole=True)
        page.evaluate("window.dispatchEvent(new Event('afterprint'))")
        page.emulate_media(media="screen")
        page.set_viewport_size(PHONE)
        take("page-narrow")
    with playing(BY_PHASE) as url, looking() as page:
        page.emulate_media(color_scheme="light")
        page.set_viewport_size(SCREEN)
        choose_bus(page, url, BUS_BY_PHASE)
        page.wait_for_selector("body[data-complete]")
        page.wait_for_selector("#meters-there tbody tr")
        take_part(page, folder / "page-phases.png", "#feeder", "#profile-section")
        taken.append(folder / "page-phases.png")
    return taken


def take_part(page: Any, path: Path, first: str, last: str) -> None:
    """Take a picture of the page from the element ``first`` down to ``last``."""
    page.wait_for_timeout(500)
    above, below = (page.locator(place).bounding_box() for place in (first, last))
    clip = {"x": 0, "y": above["y"], "width": SCREEN["width"], "height": below["y"] + below["height"] - above["y"]}
    page.screenshot(path=path, full_page=True, clip=clip)


def _find_loss(page: Any) -> None:
    """Go back from the end to a moment at which a message is lost, if there is one."""
    page.locator("#last").focus()
    for _ in range(int(page.locator("#moment").get_attribute("max"))):
        page.locator("#back").click()
        wanted = page.locator("#moment").input_value()
        page.wait_for_selector(f'body[data-moment="{wanted}"]')
        if page.locator("#messages >> text=lost").count():
            return
