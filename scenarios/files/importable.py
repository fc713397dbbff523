"""Rejection of other projects' files in place of a scenario file, with the command that imports them."""

from __future__ import annotations

from pathlib import Path

from dsse_core.errors import InvalidInputError

MARKS = {b'"_class"': "pandapower network", b'"is_batch"': "power-grid-model file"}
LOOKED_AT = 1_000_000  # bytes at either end of a file: the marks stand near the start, or behind the data


def reject_importable(path: Path) -> None:
    """Rejects a ``path`` given as a scenario file where ``dsse import`` takes the file.

    Raises:
        InvalidInputError: with the kind of the file, and the command.
    """
    kind = _kind_of(path)
    if kind:
        command = f"dsse import {path} --out DIR"
        problem = f"is a {kind}, no scenario file; `{command}` makes one of it, then `dsse run DIR/scenario.toml`"
        raise InvalidInputError(str(path), [problem])


def _kind_of(path: Path) -> str | None:
    if path.suffix == ".m":
        return "MATPOWER case"
    if path.suffix != ".json" or not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(LOOKED_AT)
        file.seek(max(LOOKED_AT, path.stat().st_size - LOOKED_AT))
        text += file.read(LOOKED_AT)
    return next((kind for mark, kind in MARKS.items() if mark in text), None)
