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
from dsse_command import free_port
from system_by_hand import SystemByHand
from waiting import wait_until

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
            said: list[str] = []
            page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: said.append(str(error)))
            page.set_default_timeout(30_000)
            yield page
            assert may_complain or said == []
        finally:
            browser.close()


def serve(system: SystemByHand, *arguments: object) -> str:
    """Start ``dsse serve`` as ``page``; the address to open."""
    system.start("page", "serve", *arguments, "--listen", f"127.0.0.1:{free_port()}")
    wait_until(lambda: "open http" in system.said("page"))
    found = re.search(r"open (http\S+)", system.said("page"))
    assert found
    return found[1]


def keep_picture(page: Any, name: str) -> None:
    """A screenshot for the docs, where ``DSSE_PICTURES`` names a folder."""
    if folder := os.environ.get("DSSE_PICTURES"):
        page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)
