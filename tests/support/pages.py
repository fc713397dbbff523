"""The pages that a reader of the repository sees: their links, headings and commands."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
LINK = re.compile(r"\]\(([^()\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def find_links(page: Path) -> list[str]:
    """Targets of links and pictures outside code, those to other sites left out."""
    text = re.sub(r"`[^`\n]*`", "`", FENCE.sub("", page.read_text()))
    return [link for link in LINK.findall(text) if "://" not in link and not link.startswith("mailto:")]


def find_external_links(page: Path) -> list[str]:
    """Addresses at other sites, in links, pictures and between angle brackets, outside code."""
    text = re.sub(r"`[^`\n]*`", "`", FENCE.sub("", page.read_text()))
    found = [*LINK.findall(text), *re.findall(r"<([a-z]+://[^<>]+)>", text)]
    return [link for link in found if "://" in link]


def anchors_of(page: Path) -> set[str]:
    """The names that GitHub gives to the headings of a page, repeated ones numbered."""
    found: list[str] = []
    for heading in re.findall(r"^#{1,6} +(.+?) *$", FENCE.sub("", page.read_text()), re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", text).replace(" ", "-")
        number = sum(re.fullmatch(rf"{re.escape(slug)}(-\d+)?", name) is not None for name in found)
        found.append(slug if number == 0 else f"{slug}-{number}")
    return set(found)


def find_commands(page: Path) -> Iterator[list[str]]:
    """The words after ``dsse`` of every command line of a page, in code blocks and in code spans."""
    text = page.read_text()
    blocks = re.sub(r"\\\n\s*", "", text)
    lines = [line.strip() for line in blocks.splitlines() if re.match(r"    |\s*dsse ", line)]
    lines += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text) if re.match(r"dsse\s", span)]
    for line in lines:
        for part in re.split(r"&&|;", line.partition("   #")[0]):
            words = part.replace(r"\|", "|").strip()
            if found := re.match(r"(?:sudo (?:-u \S+ )?)?(?:\w+=\S+ )?(?:\S*/)?dsse (.+)$", words):
                yield shlex.split(found[1])
