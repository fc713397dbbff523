"""A command on a page is run by `make docs-commands` unless a comment before its block says why not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.page_blocks import find_blocks
from tests.support.pages import PAGES, name_of


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_block_of_a_page_is_of_unknown_language_or_marked_in_unknown_words(page: Path):
    assert [block for block in find_blocks(page) if not block.text.strip()] == []


def test_most_pages_with_commands_are_run():
    blocks = [block for page in PAGES for block in find_blocks(page)]
    assert sum(block.is_run for block in blocks) > 0.7 * len(blocks) > 14


def write(folder: Path, text: str) -> Path:
    page = folder / "page.md"
    page.write_text(text)
    return page


def test_a_new_block_without_a_comment_is_run(tmp_path: Path):
    page = write(tmp_path, "Text.\n\n    dsse one\n\nText.\n\n```sh\ndsse two\n```\n\n1. Item\n\n       dsse three\n")
    assert [(block.text, block.is_run, block.code) for block in find_blocks(page)] == [
        ("dsse one\n", True, 0),
        ("dsse two\n", True, 0),
        ("dsse three\n", True, 0),
    ]


def test_a_comment_says_how_the_next_block_is_run_and_no_other(tmp_path: Path):
    page = write(
        tmp_path,
        "<!-- not run: needs root -->\n    reboot\n\nText.\n\n    dsse one\n\n<!-- exit code 1 -->\n    dsse two\n\n"
        "<!-- run instead: dsse short -->\n    dsse long\n\n<!-- in the background -->\n    dsse router\n",
    )
    reboot, one, two, long, router = find_blocks(page)
    assert (reboot.is_run, one.is_run, one.code, two.code) == (False, True, 0, 1)
    assert (long.commands, router.is_in_background, two.is_in_background) == ("dsse short", True, False)


@pytest.mark.parametrize(
    "text",
    ["<!-- not run -->\n    dsse one\n", "<!-- later -->\n    dsse one\n", "```bash\ndsse one\n```\n", "```\nx\n```\n"],
    ids=["no reason", "unknown comment", "unknown language", "no language"],
)
def test_a_block_that_might_escape_is_an_error(text: str, tmp_path: Path):
    with pytest.raises(AssertionError, match=r"page\.md:\d"):
        list(find_blocks(write(tmp_path, text)))
