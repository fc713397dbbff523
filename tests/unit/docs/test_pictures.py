"""Pictures of the pages are those that docs/pictures.py draws."""

from __future__ import annotations

import importlib.util
import sys
import xml.etree.ElementTree as ET

import pytest

from tests.support.pages import PAGES, ROOT

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
