"""What sources of text share: numbers, times, yes and no, and readings in JSON."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from dsse_core.files.bounded_parsing import parse_json

YES = {"true", "1", "yes", "good", "valid"}


def as_number(text: str) -> float | str:
    """The number in ``text``; ``text`` itself if it is none, which is counted where it is emitted."""
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
    """Whether a source vouches for a reading: ``given`` says so, or there is nothing (None, an empty text)."""
    if isinstance(given, str):
        return given.strip().lower() in YES | {""}
    return given is None or given is True or given == 1


class NotUsableError(ValueError):
    """A text that is no JSON object, or that the one reader of JSON rejects."""


def parse_object(text: str | bytes) -> Mapping[str, Any]:
    """The JSON object in ``text``.

    Raises:
        NotUsableError: it is none, or ``parse_json`` rejects it; saying why.
    """
    try:
        found = parse_json(text.decode() if isinstance(text, bytes) else text)
    except ValueError as error:
        raise NotUsableError(f"not JSON: {error}") from None
    if not isinstance(found, dict):
        raise NotUsableError(f"{type(found).__name__} in place of an object")
    return found


def find_at(content: object, path: str) -> tuple[bool, object]:
    """Whether there is something at ``path``, keys with dots between them, and what."""
    for key in path.split("."):
        if not isinstance(content, dict) or key not in content:
            return False, None
        content = content[key]
    return True, content
