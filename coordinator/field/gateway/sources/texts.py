"""Parsers that sources of text share: numbers, times, validity, and objects in JSON."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from dsse_core.files.bounded_parsing import parse_json

YES = {"true", "1", "yes", "good", "valid"}


def as_number(text: str) -> float | str:
    """The number in ``text``; ``text`` itself if it is none, which the intake then counts as wrong."""
    try:
        return float(text)
    except ValueError:
        return text


def as_time(given: object) -> Any:
    """Seconds since 1970 UTC, of a number or ISO 8601 (without an offset: UTC); ``given`` itself if it is neither."""
    if not isinstance(given, str):
        return given
    try:
        return float(given)
    except ValueError:
        pass
    try:
        found = datetime.fromisoformat(given)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return given


def as_validity(given: object) -> bool:
    """True where a source vouches for a reading: ``given`` is yes, or absent (None, an empty text)."""
    if isinstance(given, str):
        return given.strip().lower() in YES | {""}
    return given is None or given is True or given == 1


class NotUsableError(ValueError):
    """A text that is no JSON object, or that ``parse_json`` rejects."""


def parse_object(text: str | bytes) -> Mapping[str, Any]:
    """The JSON object in ``text``.

    Raises:
        NotUsableError: it is no object, or ``parse_json`` rejects it; with the reason.
    """
    try:
        found = parse_json(text.decode() if isinstance(text, bytes) else text)
    except ValueError as error:
        raise NotUsableError(f"not JSON: {error}") from None
    if not isinstance(found, dict):
        raise NotUsableError(f"{type(found).__name__} in place of an object")
    return found


def find_at(content: object, path: str) -> tuple[bool, object]:
    """True and the value at ``path``, keys with dots between them; False and None where there is none."""
    for key in path.split("."):
        if not isinstance(content, dict) or key not in content:
            return False, None
        content = content[key]
    return True, content
