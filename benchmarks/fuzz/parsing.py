"""Texts that two parsers may read differently, and checks of both readings: JSON within JSON, and keys of TOML."""

from __future__ import annotations

import json
import random
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import DEEPEST_KEY, parse_json, parse_toml
from scenarios.importers import import_grid
from scenarios.importers.pandapower.objects import write_anew

CANARY = "tabnanny"  # a harmless module that no package here imports
LENIENT = (
    (r"(?<=[\[,:])(?=\d)", "0"),
    (r"(?<=[\[,:])(?=\d)", "+"),
    (r"(?<=\d)(?=[,\]}])", "."),
    (r'(?<=")(?=\w)', "\n"),
    (r'(?<=")(?=\w)', "\t"),
    (r'(?<=")(?=\w)', "\x00"),
    (r'(?<=")(?=\w)', "\\u0000"),
    (r'(?<=")(?=\w)', "\\ud800"),
    (r'(?<=")(?=\w)', "\\x"),
    (r"(?=[\]}])", ","),
    (r"(?=[\[{])", "\ufeff"),
    (r"(?<=[,\[{])", "/**/"),
    (r"(?<=[,\[{])", "\x0b"),
    (r"(?<=[\[,])(?=\d)", "NaN,"),
    (r"(?<=[\[,])(?=\d)", "1e999,"),
    (r"(?<=[\[,])(?=\d)", "184467440737095516160,"),
    (r"\Z", " x"),
    (r"\Z", "\x00"),
)
"""Place of an insertion, and its text: none of it is JSON, or parsers read it differently."""


class TwoReadingsError(AssertionError):
    """One text was read in two ways, or a module was imported."""


def spoil_json(rng: random.Random, text: str) -> str:
    """``text`` with one to three things put in that a lenient parser takes, or with a key given twice."""
    for _ in range(rng.randint(1, 3)):
        if rng.random() < 0.3:
            text = _repeat_a_key(rng, text)
            continue
        place, what = rng.choice(LENIENT)
        if places := [found.start() for found in re.finditer(place, text)]:
            at = rng.choice(places)
            text = text[:at] + what + text[at:]
    return text


def _repeat_a_key(rng: random.Random, text: str) -> str:
    keys = list(re.finditer(r'("[^"\\]*")\s*:', text))
    if not keys:
        return text
    key = rng.choice(keys)
    name = key[1] if rng.random() < 0.5 or len(key[1]) < 3 else f'"\\u{ord(key[1][1]):04x}{key[1][2:]}'
    return text[: key.start()] + f"{name}: {rng.choice(('0', '[]', json.dumps(name), '{}'))}, " + text[key.start() :]


def make_pandapower(samples: Callable[[], tuple[bytes, ...]]) -> Callable[[random.Random], bytes]:
    """Networks that name a foreign module in a table; the text of the table, that of the file, or neither is spoilt."""

    def make(rng: random.Random) -> bytes:
        net = json.loads(rng.choice(samples()))
        tables = [table for table in net["_object"].values() if isinstance(table, dict) and "_object" in table]
        table = rng.choice([table for table in tables if '"data":[[' in str(table["_object"])])
        content = json.loads(table["_object"])
        foreign = {"_module": CANARY, "_class": "NannyNag", "_object": rng.choice(("{}", "[]", 1))}
        row = rng.choice(content["data"])
        row[rng.randrange(len(row))] = rng.choice(
            (foreign, foreign, foreign, [foreign], json.dumps(foreign), {"x": foreign})
        )
        text = json.dumps(content)
        in_file = rng.random() < 0.2
        table["_object"] = text if in_file or rng.random() < 0.5 else spoil_json(rng, text)
        whole = json.dumps(net, ensure_ascii=rng.random() < 0.5)
        return (spoil_json(rng, whole) if in_file else whole).encode("utf-8", "surrogatepass")

    return make


def read_pandapower(content: bytes, path: Path) -> str:
    """The outcome of an import; an error where a foreign module is imported, or pandas' parser reads otherwise."""
    path.write_bytes(content)
    outcome = "accepted"
    try:
        import_grid(path)
    except InvalidInputError:
        outcome = "rejected"
    if CANARY in sys.modules:
        del sys.modules[CANARY]
        raise TwoReadingsError(f"module {CANARY} was imported")
    try:
        text = write_anew(str(path), parse_json(content.decode()))
    except (ValueError, InvalidInputError):
        return outcome
    for inner in _find_texts(json.loads(text)):
        _compare(inner)
    return outcome


def _find_texts(tree: Any) -> Iterator[str]:
    """Texts of JSON that are the content of objects."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        if key == "_object" and isinstance(value, str) and value[:1] in "[{":
            yield value
        yield from _find_texts(value)


def _compare(text: str) -> None:
    from pandas._libs.json import ujson_loads

    try:
        theirs = ujson_loads(text, precise_float=True)
    except ValueError:
        return  # rejected by pandas
    if repr(theirs) != repr(json.loads(text)):  # nan is nan
        raise TwoReadingsError(f"pandas reads {text[:200]!r} in another way")


def read_json(load: Callable[[Path], object]) -> Callable[[bytes, Path], str]:
    """A reader of JSON that must accept nothing in which a key is given twice."""

    def read(content: bytes, path: Path) -> str:
        path.write_bytes(content)
        try:
            load(path)
        except InvalidInputError:
            return "rejected"

        def check(pairs: list[tuple[str, Any]]) -> None:
            if len({key for key, _ in pairs}) < len(pairs):
                raise TwoReadingsError("a key is given twice")

        json.loads(content, object_pairs_hook=check)
        return "accepted"

    return read


# Keys of TOML

MOST_NESTED = 2 * DEEPEST_KEY + 1  # a header, a dotted key below it, and a table as its value

DEEP = "a.b.c.d.e.f.g.h.i.j = 1"
PIECES = ('"', "'", '"""', "'''", "\\", '\\"', "#", ".", "a", " ", "=", "\n", "]", "é", "\\\\", DEEP)


def make_keys(rng: random.Random) -> bytes:
    """Lines with keys of up to 20 parts (once in a while 40,000), strings of all four kinds, and comments."""
    lines = [_make_line(rng, number) for number in range(rng.randint(1, 8))]
    return "\n".join(lines).encode()


def _make_line(rng: random.Random, number: int) -> str:
    depth = (
        rng.choice((1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 3, 4, DEEPEST_KEY, DEEPEST_KEY + 1, 20))
        if rng.random() < 0.999
        else 40_000
    )
    parts = [rng.choice(("a", "b-c", '"x.y"', "'#'", '"\\""', "'\"'", "1")) for _ in range(depth - 1)]
    key = rng.choice((".", " . ", "\t.")).join([f"k{number}", *parts])
    inside = "".join(rng.choice(PIECES) for _ in range(rng.randint(0, 12)))
    quote = rng.choice(('"', "'", '"""', "'''"))
    value = rng.choice(("1.5", f"{quote}{inside}{quote}", f"[{quote}{inside}{quote}, 2]", f"{{ x = {quote}{quote} }}"))
    comment = f" # {inside}".split("\n")[0] if rng.random() < 0.3 else ""
    return rng.choice((f"{key} = {value}{comment}", f"[{key}]{comment}", f"[[{key}]]{comment}"))


def read_keys(content: bytes, _: Path) -> str:
    """The outcome of reading ``content``; an error where the depth of its keys contradicts it.

    The depth is that which Python's reader finds.
    """
    text = content.decode()
    try:
        parse_toml(text)
        outcome = "accepted"
    except ValueError as error:
        outcome = "too deep" if "parts joined by dots" in str(error) else "rejected"
    if len(text) > 10_000:
        return outcome
    try:
        depth = _depth(tomllib.loads(text))
    except ValueError:
        return outcome
    if depth > MOST_NESTED and outcome != "too deep":
        raise TwoReadingsError(f"a key of {depth} parts was {outcome}")
    if depth <= DEEPEST_KEY and outcome != "accepted":
        raise TwoReadingsError(f"keys of {depth} parts at most were {outcome}")
    return outcome


def _depth(tree: Any) -> int:
    if isinstance(tree, list):
        return max(map(_depth, tree), default=0)
    return 1 + max(map(_depth, tree.values()), default=0) if isinstance(tree, dict) else 0
