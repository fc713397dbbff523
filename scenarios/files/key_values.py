"""Keys of a scenario file with values, as people type them: ``faults.loss=0.3``."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_toml

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def parse_settings(settings: Sequence[str], what: str) -> dict[str, object]:
    """Key -> value of each ``KEY=VALUE``; ``what``: the option that they come from.

    Raises:
        InvalidInputError: every text that is none, and every key that is given twice.
    """
    found: dict[str, object] = {}
    problems = []
    for setting in settings:
        key, equals, text = (part.strip() for part in setting.partition("="))
        if not (key and equals and text):
            problems.append(f"{setting!r} must be KEY=VALUE, e.g. faults.loss=0.3")
        elif key in found:
            problems.append(f"{key} is given twice; keep one")
        else:
            found[key] = parse_value(text)
    if problems:
        raise InvalidInputError(what, problems)
    return found


def parse_value(text: str) -> object:
    """The value that TOML reads from ``text``; a text that is no TOML value is a word, which needs no quotes."""
    try:
        value: object = parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text
    return value


def parse_values(text: str) -> list[object]:
    """The values of a list ``VALUE,VALUE,...``, as TOML reads them; words need no quotes."""
    try:
        values: list[object] = parse_toml(f"values = [{text}]")["values"]
    except ValueError:
        return [parse_value(word.strip()) for word in text.split(",")]
    return values


def write_value(value: object) -> str:
    """``value`` on one line, as TOML writes it and ``parse_value`` reads it."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_write_key(key)}={write_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(write_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else str(value)


def _write_key(key: object) -> str:
    return key if isinstance(key, str) and BARE_KEY.fullmatch(key) else json.dumps(str(key), ensure_ascii=False)
