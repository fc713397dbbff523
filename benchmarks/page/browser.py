"""A headless Chromium that looks at a page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

CHROMIUM = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
WIDTH, HEIGHT = 1280, 900
PATIENCE_MS = 300_000


@contextmanager
def looking(*arguments: str) -> Iterator[Any]:
    """An empty page in a new browser that is started with ``arguments``.

    Raises:
        click.ClickException: there is no browser, or no package that drives it.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise click.ClickException(f"{error.name} is not installed; `pip install 'consensus-dsse[test]'`") from None
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    if path is None:
        raise click.ClickException("there is no Chromium: apt-get install chromium-headless-shell")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *arguments])
        try:
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.set_default_timeout(PATIENCE_MS)
            yield page
        finally:
            browser.close()


def choose_bus(page: Any, url: str, bus: int) -> None:
    """Open the page and have its ``bus`` shown, with its past."""
    page.goto(url)
    page.wait_for_selector("#areas tbody tr", state="attached")
    page.fill("#what", str(bus))
    page.keyboard.press("Enter")
    page.wait_for_selector("#past canvas")
