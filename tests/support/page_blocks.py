"""The code blocks of the pages: what is text, what is a command, and how a command is run.

An indented block, or one fenced as `sh`, holds commands; every other fence names its language. A comment before a block
of commands says how it is run: see MARKS. Without one it is run as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

MARKS = re.compile(
    r"<!-- (?:not run:\s+(?P<why_not>\S.*?)"  # the reason, e.g. what it needs
    r"|run instead:\s+(?P<instead>\S.*?)"  # the same on a smaller scale
    r"|exit code (?P<code>[1-9]\d*)"  # expected
    r"|in the background"  # each line runs until the end of the page
    r") -->",
    re.DOTALL,
)
LANGUAGES = {"json", "python", "text", "toml", "{toctree}", "{eval-rst}"}  # of fences that hold no commands


@dataclass(frozen=True)
class Block:
    """A block of commands: first line in its page, the commands, and the comment before it ("" without one)."""

    line: int
    text: str
    mark: str

    @property
    def is_run(self) -> bool:
        return not self.mark.startswith("<!-- not run")

    @property
    def is_in_background(self) -> bool:
        return self.mark.startswith("<!-- in the background")

    @property
    def commands(self) -> str:
        """What the shell is given."""
        found = MARKS.fullmatch(self.mark)
        return (found and found["instead"]) or self.text

    @property
    def code(self) -> int:
        """The exit code that is expected."""
        found = MARKS.fullmatch(self.mark)
        return int((found and found["code"]) or 0)


def find_blocks(page: Path) -> Iterator[Block]:
    """The blocks of commands of a page, in order. An unknown language or comment is an AssertionError."""
    mark = ""
    for token in MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8")):
        language = token.info.split(" ")[0]
        where = f"{page}:{token.map[0] + 1}" if token.map else str(page)
        if token.type == "html_block":
            mark = token.content.strip()
            continue
        if token.type == "code_block" or (token.type == "fence" and language == "sh"):
            assert not mark or MARKS.fullmatch(mark), f"{where}: nobody knows what {mark!r} asks for"
            yield Block(line=token.map[0] + 1 if token.map else 0, text=token.content, mark=mark)
        elif token.type == "fence":
            assert language in LANGUAGES, f"{where}: fence of language {language!r}, not of {LANGUAGES} or 'sh'"
        mark = ""
