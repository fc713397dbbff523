"""Damages to a valid sample: to its bytes, its tokens, or one to three values at random places of its structure."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Iterator
from typing import Any

STEERING = (  # markup, orders to a terminal, formulas, made-up lines, letters in another order
    *("[/nope]", "[bold", "[link=http://192.0.2.1]x[/link]", ":smile:", "[[/]]", "\\[/x]"),
    *("\x1b]0;x\x07", "\x1b[2J", "\x9b31m", "\x7f", "\r", "\b\b\b", "a\nconsensus", "\tx"),
    *("$\\frac$", "$x", "\\$", "{x}", "%s", "\u202eevil", "\u2028x", "\ufeff", "\U000e0041"),
)
HOSTILE: tuple[Any, ...] = (
    *STEERING,
    *(0, 1, -1, 2, 2**31, 2**53, 2**63, 2**64 - 1, -(2**63), 10**12, 10**30),
    *(0.0, -0.0, 1e-320, 1e-12, 1e18, 1e300, -1e300, math.nan, math.inf, -math.inf),
    *("", "x", "\x00", "\x1b[2J", "é", "a" * 2000, "../../etc/passwd", "/dev/zero", "{", "1e999", "nan", "all"),
    *(None, True, False, [], {}, [[]], [1, "x"], {"a": 1}, {"": None}),
)
TOKENS = (
    "",
    "0",
    "-1",
    "nan",
    "inf",
    "1e400",
    "9" * 400,
    '"',
    "'",
    "[",
    "]",
    "{",
    "}",
    ";",
    ",",
    "=",
    "\n",
    "%",
    "#",
    "\x00",
)


def spoil_bytes(rng: random.Random, sample: bytes, other: bytes) -> bytes:
    """A few bytes changed, put in or taken out, the end cut off, or the end of ``other`` put in its place."""
    content = bytearray(sample)
    kind = rng.randrange(5)
    if kind == 0 and content:
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del content[rng.randrange(len(content) + 1) :]
    elif kind == 2:
        at = rng.randrange(len(content) + 1)
        content[at : at + rng.randint(0, 40)] = rng.randbytes(rng.randint(0, 40))
    elif kind == 3:
        return bytes(content[: rng.randrange(len(content) + 1)]) + other[rng.randrange(len(other) + 1) :]
    else:
        start = rng.randrange(len(content) + 1)
        piece = content[start : start + rng.randint(1, 200)]
        content[start:start] = piece * rng.randint(1, 20)
    return bytes(content)


def spoil_text(rng: random.Random, sample: str) -> str:
    """One to three words or numbers replaced by hostile ones, or by another of the same text."""
    words = list(re.finditer(r"[\w.+-]+", sample))
    for _ in range(rng.randint(1, 3)):
        if not words:
            return sample
        word = rng.choice(words)
        new = rng.choice((*TOKENS, rng.choice(words).group()))
        sample = sample[: word.start()] + new + sample[word.end() :]
        words = list(re.finditer(r"[\w.+-]+", sample)) if rng.random() < 0.5 else []
    return sample


def spoil_tree(rng: random.Random, tree: Any) -> Any:
    """``tree`` of lists and dicts, in place, with one to three values replaced, taken out or given another key."""
    for _ in range(rng.randint(1, 3)):
        places = list(_find_places(tree))
        if not places:
            return _copy(rng.choice(HOSTILE))
        parent, key = rng.choice(places)
        kind = rng.randrange(6)
        if kind == 0:
            del parent[key]
        elif kind == 1:
            other, other_key = rng.choice(places)
            parent[key] = _copy(other[other_key])
        elif kind == 2 and isinstance(parent, dict):
            parent[rng.choice(("x", "", "a b", "bus", "_class"))] = parent.pop(key)
        elif kind == 3 and isinstance(parent, list):
            parent.insert(rng.randrange(len(parent) + 1), _copy(parent[key]))
        else:
            parent[key] = _copy(rng.choice(HOSTILE))  # the next spoiling may change it
    return tree


def _find_places(tree: Any) -> Iterator[tuple[Any, Any]]:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield tree, key
        yield from _find_places(value)


def _copy(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _copy(value) for key, value in tree.items()}
    return [_copy(item) for item in tree] if isinstance(tree, list) else tree
