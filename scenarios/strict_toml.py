"""Strict TOML files: a file becomes a pydantic model, or one error that lists every problem with its key path."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from dsse_core.errors import InvalidInputError


class Table(BaseModel):
    """A TOML table: unknown keys, wrong types, inf and nan are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Table)


def load_strict(path: Path, model: type[Model]) -> Model:
    """Read a TOML file into ``model``.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML (with line and column), or does not fit the
            model: every problem with its key path (list items count from 0) and, for unknown keys, what is allowed.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(str(path), [f"cannot read the file ({error.strerror}); check the path"]) from None
    except UnicodeDecodeError as error:
        raise InvalidInputError(str(path), [f"not UTF-8 text ({error.reason} at byte {error.start})"]) from None
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(str(path), [f"not valid TOML: {error}"]) from None
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InvalidInputError(str(path), [_describe(model, e) for e in error.errors()]) from None


def suggest(word: str, allowed: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` when one of ``allowed`` is close to ``word``, else nothing."""
    close = get_close_matches(word, list(allowed), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _describe(model: type[Table], error: ErrorDetails) -> str:
    location = [step for step in error["loc"] if step != "[key]"]
    key = _key_path(location)
    if error["type"] == "extra_forbidden":
        allowed = _allowed_keys(model, location[:-1])
        return f"{key}: unknown key; allowed here: {', '.join(allowed)}{suggest(str(location[-1]), allowed)}"
    meaning = _meaning(model, location)
    if error["type"] == "missing":
        return f"{key}: missing" + (f"; {meaning}" if meaning else "")
    if error["type"] == "value_error":
        text = str(error["ctx"]["error"])
        return f"{key}: {text}" if key else text
    found = "a table" if isinstance(error["input"], dict) else repr(error["input"])
    text = error["msg"].replace("Input should", "must", 1).replace("String should", "must", 1)
    return f"{key}: {text}, found {found}" + (f" ({meaning})" if meaning else "")


def _key_path(location: Iterable[int | str]) -> str:
    path = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in location)
    return path.removeprefix(".")


def _keys(table: type[BaseModel]) -> dict[str, str]:
    """Key as written in the file -> attribute of the table."""
    return {field.alias or name: name for name, field in table.model_fields.items()}


def _allowed_keys(model: type[Table], location: Iterable[int | str]) -> list[str]:
    table = _table_in(_annotation_at(model, location))
    return list(_keys(table)) if table else []


def _meaning(model: type[Table], location: list[int | str]) -> str:
    """The description of the key at ``location``, empty if it has none."""
    table = _table_in(_annotation_at(model, location[:-1]))
    name = _keys(table).get(str(location[-1])) if table and location else None
    return (table.model_fields[name].description or "") if table and name else ""


def _annotation_at(model: type[Table], location: Iterable[int | str]) -> Any:
    """The type annotation at ``location``; a step into a dict or list leaves the table inside it."""
    annotation: Any = model
    for step in location:
        table = _table_in(annotation)
        names_an_item = isinstance(step, int) or get_origin(annotation) is dict
        if table is None:
            return None
        if names_an_item:
            annotation = table
        elif (name := _keys(table).get(str(step))) is not None:
            annotation = table.model_fields[name].annotation
        else:
            return None
    return annotation


def _table_in(annotation: Any) -> type[BaseModel] | None:
    """The table that an annotation such as ``list[T]``, ``dict[str, T]`` or ``T | None`` is about."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((table for part in get_args(annotation) if (table := _table_in(part))), None)
