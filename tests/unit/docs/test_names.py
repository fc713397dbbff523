"""Names of files, folders, constants, classes and functions that pages mention are those of the tree."""

from __future__ import annotations

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

from tests.support.pages import PAGES, ROOT, name_of

TEXT = (".py", ".toml", ".service", ".env", ".conf", ".cfg", ".ts", ".js", ".j2", ".yml", ".csv", "Makefile", "")
FOREIGN = {
    *("CPUSchedulingPolicy", "IPAddressAllow", "IPAddressDeny", "SlurmJobExecutor", "TLS_ACCEPT_THROTTLE_TIME"),
    *("REASON", "COMMANDS", "TOPIC", "PATH", "PLAN"),  # placeholders
}
PAST = ROOT / "CHANGELOG.md"  # names what there was


@cache
def files_of_the_tree() -> tuple[Path, ...]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return tuple(ROOT / line for line in listed.splitlines() if (ROOT / line).is_file())


@cache
def words_of_the_tree() -> frozenset[str]:
    """Every word of the sources, and of scripts and settings beside them."""
    texts = [path for path in files_of_the_tree() if path.suffix in TEXT or path.name in TEXT]
    return frozenset(word for path in texts for word in re.findall(r"\w+", path.read_text(encoding="utf-8")))


def spans_of(page: Path) -> list[str]:
    """Code spans of a page, outside fences."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"`([^`\n]+)`", text)


def names_of(page: Path) -> set[str]:
    """Constants, classes and called functions in the code spans of a page."""
    found: set[str] = set()
    for span in spans_of(page):
        found |= set(re.findall(r"\b[A-Z][A-Z0-9]*(?:_[A-Z0-9]+)+\b", span))
        found |= set(re.findall(r"\b[A-Z]+[a-z]+(?:[A-Z]+[a-z]*)+\b", span))
        found |= set(re.findall(r"\b([a-z]\w*_\w+)\(", span))
    return found - FOREIGN


def test_pages_name_things_of_the_tree():
    assert sum(len(names_of(page)) for page in PAGES) > 100
    assert len(words_of_the_tree()) > 5000


@pytest.mark.parametrize("page", [page for page in PAGES if page != PAST], ids=name_of)
def test_constants_classes_and_functions_that_a_page_names_exist(page: Path):
    assert names_of(page) - words_of_the_tree() == set()


@pytest.mark.parametrize("page", [page for page in PAGES if page != PAST], ids=name_of)
def test_modules_and_units_that_a_page_names_exist(page: Path):
    known = {path.name for path in files_of_the_tree()}
    named = {span for span in spans_of(page) if re.fullmatch(r"[\w@-]+\.(?:py|service|conf)", span)}
    assert named - known == set()


def test_a_name_that_is_gone_is_found(tmp_path: Path):
    gone = {"GONE" + "_LONG_AGO", "Gone" + "Class", "gone" + "_call"}
    page = tmp_path / "page.md"
    page.write_text("`MOST_STEPS` `AreaProtocol` " + " ".join(f"`{name}(x)`" for name in gone) + "\n")
    assert names_of(page) - words_of_the_tree() == gone
    assert names_of(page) - gone == {"MOST_STEPS", "AreaProtocol"}
