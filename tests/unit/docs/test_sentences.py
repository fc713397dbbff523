"""Sentences of the pages name their subject: area, agent, meter, process, never who, nobody, somebody."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.pages import PAGES, name_of

WITHOUT_SUBJECT = re.compile(
    r"\b(?:nobody|somebody|everybody|anybody|whoever|whom|someone|no one|befall\w*|from the begin|it is to \w+s)\b"
    r"|(?<!person )(?<!attacker )(?<!user )(?<!reader )(?<!host itself, )\bwho\b"
    r"|\|\s*(?:who|what)\s*\|"  # head of a column
    r"|^(?:#+ )?(?:Who|What is rejected\?|Whether)\b",
    re.IGNORECASE | re.MULTILINE,
)
WRITTEN_BY_COMMANDS = re.compile(r"<!-- figures .*?<!-- end -->", re.DOTALL)


def find_missing_subjects(page: Path) -> list[str]:
    """Lines without code in which a sentence leaves out its subject."""
    text = WRITTEN_BY_COMMANDS.sub("", page.read_text(encoding="utf-8"))
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"`[^`]*`", "``", text)
    return [line for line in text.splitlines() if not line.startswith("    ") and WITHOUT_SUBJECT.search(line)]


def sentences_of(page: Path) -> list[str]:
    """Sentences outside code, tables and comments."""
    text = re.sub(r"^```.*?^```|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:- |\d+\. |\|))", re.sub(r"`[^`]*`", "``", text))
    prose = [part for part in parts if not part.startswith(("|", "    "))]
    return [" ".join(found.split()) for part in prose for found in re.split(r"(?<=[.!?:])\s+", part)]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_sentence_begins_with_its_subject(page: Path):
    prose = [re.sub(r"^(?:- |\d+\. )", "", text) for text in sentences_of(page) if not text.startswith("#")]
    assert [text for text in prose if re.match(r"(?:What|Whether|Who|Whoever)\b", text)] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_sentence_is_read_once(page: Path):
    assert [text for text in sentences_of(page) if len(text.split()) > 50 or text.count(";") > 2] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_of_a_page_name_their_subject(page: Path):
    assert find_missing_subjects(page) == []


def test_a_sentence_without_a_subject_is_found(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text(
        "Nobody waits.\n\nAn attacker who listens.\n\nWho speaks first decides.\n\n`nobody`\n\n| what | b |\n"
    )
    assert find_missing_subjects(page) == ["Nobody waits.", "Who speaks first decides.", "| what | b |"]
