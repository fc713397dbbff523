"""The page's own code makes elements and text of what it is sent, and never markup."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from coordinator.show.web.app import STATIC

MAKES_MARKUP = (
    "innerHTML",
    "outerHTML",
    "insertAdjacentHTML",
    "document.write",
    "createContextualFragment",
    "DOMParser",
    "eval(",
    "new Function",
    "srcdoc",
    "javascript:",
    ".html(",
    "setHTML",
)


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.js")), ids=lambda path: path.name)
def test_no_script_of_the_page_makes_markup_of_text(path: Path) -> None:
    text = path.read_text()
    assert [word for word in MAKES_MARKUP if word in text] == []
    assert not re.search(r"set(?:Timeout|Interval)\(\s*[\"'`]", text)


def test_the_page_itself_has_no_script_or_style_between_its_lines() -> None:
    text = (STATIC / "index.html").read_text()
    assert re.findall(r"<script(?![^>]*\ssrc=)|<style|\sstyle=|\son\w+=", text) == []
