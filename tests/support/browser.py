"""A headless Chromium that a test drives, and the page that it looks at."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.dsse_command import free_port
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import DEADLINE_S, wait_until

CHROMIUM = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


def find_chromium() -> str:
    """Where the browser is; without one the test is skipped, where ``CI`` is true it fails."""
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    if path is None and os.environ.get("CI") == "true":
        pytest.fail("there is no Chromium: apt-get install chromium-headless-shell")
    if path is None:
        pytest.skip("there is no Chromium: apt-get install chromium-headless-shell")
    return path


@contextmanager
def browsing(*, may_complain: bool = False, **options: Any) -> Iterator[Any]:
    """A page in a new browser; an error on its console or in its scripts fails the test, unless it ``may_complain``."""
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        try:
            page = browser.new_page(**({"viewport": {"width": 1280, "height": 900}} | options))
            errors: list[str] = []
            page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.set_default_timeout(DEADLINE_S * 1000)
            yield page
            assert may_complain or errors == []
        finally:
            browser.close()


def serve(system: SystemByHand, *arguments: object) -> str:
    """Start ``dsse serve`` as ``page``; the address to open."""
    system.start("page", "serve", *arguments, "--listen", f"127.0.0.1:{free_port()}")
    line = re.compile(r"open (http\S+)\n")
    wait_until(lambda: line.search(system.read_log("page")) is not None)
    found = line.search(system.read_log("page"))
    assert found
    return found[1]


def open_play(page: Any, url: str) -> None:
    """Open a page that plays back, and wait until all of it can be played and its end is shown."""
    page.goto(url)
    page.wait_for_selector("body[data-complete]", timeout=DEADLINE_S * 1000)
    last = page.locator("#moment").get_attribute("max")
    page.wait_for_selector(f'body[data-moment="{last}"]', timeout=DEADLINE_S * 1000)


def cell_of(page: Any, area: str, title: str) -> str:
    """What the table of areas says of ``area`` in the column ``title``.

    ``inner_text`` would be empty while the table is off the screen, where the browser lays nothing out.
    """
    columns = page.locator("#areas thead th").all_text_contents()
    row = page.locator("#areas tbody tr", has=page.locator("button", has_text=re.compile(f"^{re.escape(area)}$")))
    return str(row.locator("td").nth(columns.index(title)).text_content())


def show_moment(page: Any, number: int) -> None:
    """Move the slider of a playback there, and wait until all parts of the page show that moment."""
    page.evaluate(f"document.querySelector('#moment').value = {number}")
    page.locator("#moment").dispatch_event("input")
    wait_for_moment(page, number)


def wait_for_moment(page: Any, number: int) -> None:
    """Until all parts of the page show it, not only those that come first."""
    wait_until(lambda: page.evaluate("document.body.dataset.moment") == str(number))


def keep_picture(page: Any, name: str) -> None:
    """A screenshot for the docs, where ``DSSE_PICTURES`` names a folder."""
    if folder := os.environ.get("DSSE_PICTURES"):
        page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)
