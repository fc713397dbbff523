"""Every link of README, CONTRIBUTING and docs leads to a file, and to a heading where it names one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.pages import PAGES, ROOT, anchors_of, find_external_links, find_links, name_of


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


# Links to other sites: `make linkcheck` follows them; here, without a network, their form is checked.


def find_malformed(links: Iterable[str]) -> list[str]:
    """Links that are no plain https addresses, and those that differ from another only in case, slash or www."""
    listed = sorted(set(links))
    plain = [re.sub(r"^https?://(www\.)?", "", link).rstrip("/").lower() for link in listed]
    return [
        link
        for link, address in zip(listed, plain, strict=True)
        if urlsplit(link).scheme != "https"
        or not re.fullmatch(r"[a-z0-9-]+(\.[a-z0-9-]+)+", urlsplit(link).netloc)
        or re.search(r"\s", link)
        or plain.count(address) > 1
    ]


def test_links_to_other_sites_are_well_formed_and_alike_on_all_pages():
    links = [link for page in PAGES for link in find_external_links(page)]
    assert "https://semver.org/" in links
    assert find_malformed(links) == []


def test_a_malformed_link_to_another_site_is_found(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text(
        "[a](http://a.org) [b](https://b.org/x) <https://www.b.org/x/> <https://localhost> `https://code`\n"
    )
    assert find_malformed(find_external_links(page)) == [
        *("http://a.org", "https://b.org/x", "https://localhost", "https://www.b.org/x/")
    ]
