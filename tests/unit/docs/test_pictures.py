"""Pictures of the pages are those that docs/pictures.py draws, or that the command beside them makes."""

from __future__ import annotations

import importlib.util
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.support.pages import PAGES, ROOT, name_of

SHOWN = [
    (page, found)
    for page in PAGES
    for found in re.finditer(r"!\[[^]]*\]\((\S+\.png)\)", page.read_text(encoding="utf-8"))
]
COMMAND = re.compile(r"(dsse (run|simulate|compare|sweep|thesis|serve)|python -m benchmarks|python docs/\w+\.py)\b")
BESIDE = 1200  # letters of a page before a picture, and after it
SPEC = importlib.util.spec_from_file_location("pictures_of_the_pages", ROOT / "docs" / "pictures.py")
assert SPEC is not None
assert SPEC.loader is not None
pictures = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = pictures
SPEC.loader.exec_module(pictures)


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_a_picture_is_as_it_is_drawn_and_is_shown_by_a_page(name: str):
    saved = (pictures.FIGURES / f"{name}.svg").read_text(encoding="utf-8")
    assert saved == pictures.PICTURES[name], "run: python docs/pictures.py"
    assert ET.fromstring(saved).tag.endswith("svg")
    assert any(f"figures/{name}.svg)" in page.read_text(encoding="utf-8") for page in PAGES)


@pytest.mark.parametrize(("page", "found"), SHOWN, ids=[f"{name_of(page)}-{found[1]}" for page, found in SHOWN])
def test_a_photograph_stands_beside_the_command_that_makes_it(page: Path, found: re.Match[str]):
    text = found.string
    assert COMMAND.search(text[max(0, found.start() - BESIDE) : found.end() + BESIDE])
