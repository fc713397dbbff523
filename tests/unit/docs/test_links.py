"""Every link of README, CONTRIBUTING and docs leads to a file, and to a heading where it names one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import PAGES, ROOT, anchors_of, find_links, name_of


def find_dead_links(page: Path) -> list[str]:
    dead = []
    for link in find_links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors_of(target)):
            dead.append(link)
    return dead


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_link_leads_nowhere(page: Path):
    assert find_dead_links(page) == []


def test_a_missing_page_and_a_missing_heading_are_dead_links(tmp_path: Path):
    other = tmp_path / "other.md"
    other.write_text("# A heading: `code`, words\n\n```text\n# no heading\n```\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](other.md#a-heading-code-words) [b](other.md#no-heading) [c](gone.md) ![d](gone.png) `[e](code.md)`"
    )
    assert find_dead_links(page) == ["other.md#no-heading", "gone.md", "gone.png"]


def test_no_page_of_the_docs_is_missing_from_the_index():
    docs = ROOT / "docs"
    index = (docs / "index.md").read_text().split()
    pages = {str(page.relative_to(docs).with_suffix("")) for page in PAGES if docs in page.parents}
    assert {page for page in pages if not page.startswith("reference/api/")} - {"index"} - set(index) == set()


ROOMS = "agents|benchmarks|coordinator|deploy|dsse_core|scenarios|tests"


def test_pages_name_only_modules_that_exist():
    named = {
        (name_of(page), path.rstrip("/"))
        for page in PAGES
        for path in re.findall(
            r"`((?:agents|benchmarks|coordinator|deploy|dsse_core|scenarios|tests)/[\w/.*@-]+)", page.read_text()
        )
    }
    assert len(named) > 60
    assert [(page, path) for page, path in sorted(named) if not any(ROOT.glob(path))] == []
