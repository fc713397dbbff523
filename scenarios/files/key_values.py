"""Keys of a scenario file with values, as people type them: ``faults.loss=0.3``."""

from __future__ import annotations

from collections.abc import Sequence

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_toml


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
    """The value that TOML reads from ``text``; what is none in TOML is a word, which needs no quotes."""
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
