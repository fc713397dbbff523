"""JSON and TOML texts as trees, within limits of depth and work, each key once."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from typing import Any

DEEPEST_KEY = 8  # parts of a key of TOML that dots join
MOST_KEY_PARTS = 1_000_000  # of all headers and dotted keys; Python's reader takes 1 kB for each
MOST_DIGITS = 3000  # of an integer in base 16, 8 or 2, which Python reads at any length, but does not print
MOST_VALUES = 30_000_000  # of JSON; a network of a million buses has 10 million

STRINGS_AND_COMMENTS = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}+|\Z)'  # without an end: to where the reader stops
    r"|'''(?:[^']++|'(?!''))*+(?:'{3,5}+|\Z)"
    r'|"(?:[^"\\\n]++|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+",
    re.DOTALL,
)
HALF_OF_A_PAIR = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")
HEADER = re.compile(r"^[ \t]*+\[", re.MULTILINE)
DOTTED = re.compile(r"(?<![\w-])[\w-]++(?:[ \t]*+\.[ \t]*+[\w-]++)++([ \t]*+[=\]])?", re.ASCII)
"""Keys, and numbers with a point."""
LONG_INTEGER = re.compile(rf"0[xob](?<![\w-]0.)\w{{{MOST_DIGITS + 1}}}", re.ASCII)


def parse_json(text: str) -> Any:
    """The tree of a JSON text.

    Raises:
        ValueError: the text is no JSON, has a key twice in one object, nests too deeply, has too many values, half of a
            character, or an integer that Python does not hold.
    """
    values = sum(map(text.count, ",[{"))
    if values > MOST_VALUES:
        raise ValueError(f"it has {values:,} values, the limit is {MOST_VALUES:,}")
    try:
        with _integers_in_words():
            tree = json.loads(text, object_pairs_hook=_take_each_once)
        may_hold_half = "\\u" in text or not text.isascii()  # found in a tenth of the time
        if may_hold_half and HALF_OF_A_PAIR.search(text):
            # some readers leave out the half that stands alone, so that names change
            json.dumps(tree, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("it nests too deeply") from None
    except UnicodeEncodeError as error:
        raise ValueError(f"it holds half of a character, {error.object[error.start]!a}") from None
    return tree


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: the text is no TOML (with line and column), nests too deeply, has a key of too many parts or too
            many of them, or an integer or a date that Python does not hold.
    """
    _check_keys(text)
    try:
        with _integers_in_words():
            return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it nests too deeply") from None


@contextlib.contextmanager
def _integers_in_words() -> Iterator[None]:
    """A block in which Python's error for an integer of too many digits lacks the advice to raise that limit."""
    try:
        yield
    except ValueError as error:
        if type(error) is ValueError and "integer string conversion" in str(error):
            raise ValueError(f"it has an integer of more than {sys.get_int_max_str_digits():,} digits") from None
        raise


def _take_each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The table of a JSON object; of equal keys other readers take the first, the last or all.

    Raises:
        ValueError: a key is given twice.
    """
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"key {twice!r:.80} is given twice; keep one of them")
    return table


def _check_keys(text: str) -> None:
    """Counts the parts of keys before Python's reader, whose work grows with the square of a key's depth; refuses long
    integers.

    Up to the first mistake, where that reader stops, this function and the reader see the same strings and comments.

    Raises:
        ValueError: a key has too many parts, there are too many of them, or an integer is too long.
    """
    most, parts = max(line.count(".") for line in text.split("\n")), text.count("[") + 2 * text.count(".")
    if most < DEEPEST_KEY and parts <= MOST_KEY_PARTS and not LONG_INTEGER.search(text):
        return  # with no look at strings and comments
    bare = STRINGS_AND_COMMENTS.sub(_blank_out, text)
    if found := LONG_INTEGER.search(bare):
        line = bare.count("\n", 0, found.start()) + 1
        raise ValueError(f"it has an integer of more than {MOST_DIGITS:,} digits in base 16, 8 or 2 (at line {line})")
    total = len(HEADER.findall(bare))
    for key in DOTTED.finditer(bare):
        parts = key[0].count(".") + 1
        if parts > DEEPEST_KEY:
            line = bare.count("\n", 0, key.start()) + 1
            raise ValueError(f"a key of {parts:,} parts joined by dots, the limit is {DEEPEST_KEY} (at line {line})")
        total += parts if key[1] else 0
    if total > MOST_KEY_PARTS:
        raise ValueError(f"its headers and dotted keys have {total:,} parts, the limit is {MOST_KEY_PARTS:,}")


def _blank_out(found: re.Match[str]) -> str:
    """A string as one letter, which may be a part of a key; a comment as nothing; both with all their line ends."""
    return ("" if found[0].startswith("#") else "_") + "\n" * found[0].count("\n")
