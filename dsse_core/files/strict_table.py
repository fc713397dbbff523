"""Strict TOML files: a file becomes a pydantic model, or one error that lists every problem with its key path.

A file whose name ends in ``.json`` holds the same tables as JSON, which is read twenty times as fast.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Tag, ValidationError
from pydantic_core import ErrorDetails

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_JSON, LARGEST_TOML, read_text
from dsse_core.files.bounded_parsing import parse_json, parse_toml
from dsse_core.files.wording import Suggestions

KINDS_OF_FILES = {
    frozenset({"bus", "branch"}): 'a network file; give a scenario file, which names it by network = "{name}"',
    frozenset({"areas", "version"}): "a scenario file; give a network file",
    frozenset({"endpoints", "local_slack"}): "an area file, which `dsse agent` takes; give a scenario file",
}
"""Keys that tell one kind of file from the others -> what it is, and what to give instead."""


class Table(BaseModel):
    """A TOML table: unknown keys, wrong types, inf and nan are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Table)
Meant = dict[tuple[str, ...], Suggestions]
"""Keys that a table may have -> which of them the unknown ones of a file may have been, within one bound of work."""


def load_strict(path: Path, model: type[Model], changes: Mapping[str, object] | None = None) -> Model:
    """Read a TOML file into ``model``; ``changes``: key path -> the value it has instead of the file's.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML (with line and column), or does not fit the
            model: every problem with its key path (items of lists count from 1) and, for unknown keys, what is allowed.
    """
    is_json = path.suffix == ".json"
    text = read_text(path, largest=LARGEST_JSON if is_json else LARGEST_TOML)
    try:
        content = parse_json(text) if is_json else parse_toml(text)
    except ValueError as error:
        raise InvalidInputError(str(path), [f"not valid {'JSON' if is_json else 'TOML'}: {error}"]) from None
    if problems := [problem for key, value in (changes or {}).items() if (problem := _change(content, key, value))]:
        raise InvalidInputError(str(path), problems)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        other = _recognize_other_file(path, content, model)
        meant: Meant = {}
        raise InvalidInputError(
            str(path), [other] if other else [_describe(model, e, meant) for e in error.errors()]
        ) from None


def _recognize_other_file(path: Path, content: Any, model: type[Table]) -> str:
    """What ``content`` is, if by its keys it is a file of another kind than ``model``; else empty."""
    if not isinstance(content, dict):
        return ""
    keys = content.keys() - _keys(model).keys()
    kinds = (kind for told_by, kind in KINDS_OF_FILES.items() if keys >= told_by)
    return next((f"is {kind.format(name=path.name)}" for kind in kinds), "")


def _change(content: Any, key: str, value: object) -> str | None:
    """Set ``key``, a path such as ``faults.link[1].loss``, in ``content``; what is wrong with the path, if it is."""
    if not re.fullmatch(r"[\w-]+(\[\d{1,9}\])*(\.[\w-]+(\[\d{1,9}\])*)*", key, re.ASCII):
        return f"{key!r} is no key; one looks like faults.loss or faults.link[1].loss"
    steps = [int(word) - 1 if bracket else word for bracket, word in re.findall(r"(\[?)([\w-]+)", key)]
    for i, step in enumerate(steps):
        here = _key_path(steps[:i]) or "the file"
        if isinstance(step, int):
            if not isinstance(content, list) or not 0 <= step < len(content):
                length = f"a list of {len(content)}" if isinstance(content, list) else "no list"
                return f"{key}: {here} is {length}; items count from 1"
        elif not isinstance(content, dict):
            return f"{key}: {here} is no table in the file"
        elif i + 1 < len(steps):
            content.setdefault(step, {})
        if i + 1 == len(steps):
            content[step] = value
        else:
            content = content[step]
    return None


def _describe(model: type[Table], error: ErrorDetails, meant: Meant) -> str:
    location = [step for step in error["loc"] if step != "[key]"]
    key = _key_path(step for step in location if not _is_tag(step))
    if error["type"] == "extra_forbidden":
        allowed = tuple(_allowed_keys(model, location[:-1]))
        close = meant.setdefault(allowed, Suggestions(allowed)).find(str(location[-1]))
        return f"{key}: unknown key; allowed here: {', '.join(allowed)}{close}"
    while location and _is_tag(location[-1]):
        location.pop()
    meaning = _meaning(model, location)
    if error["type"] == "missing":
        return f"{key}: missing" + (f"; {meaning}" if meaning else "")
    if error["type"] == "value_error":
        text = str(error["ctx"]["error"])
        return f"{key}: {text}" if key else text
    found = "a table" if isinstance(error["input"], dict) else f"{error['input']!r:.200}"
    text = error["msg"].replace("Input should", "must", 1).replace("String should", "must", 1)
    text = re.sub(r"a valid dictionary( or instance of \w+)?", "a table", text)
    return f"{key or 'the file'}: {text}, found {found}" + (f" ({meaning})" if meaning else "")


def _is_tag(step: int | str) -> bool:
    """Whether ``step`` is no key but the tag of a union's member, which tags in brackets set apart from keys."""
    return isinstance(step, str) and re.fullmatch(r"\[[a-z]+\]", step) is not None


def _key_path(location: Iterable[int | str]) -> str:
    path = "".join(f"[{step + 1}]" if isinstance(step, int) else f".{step}" for step in location)
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
        if _is_tag(step):
            members = (part for part in get_args(annotation) if Tag(str(step)) in getattr(part, "__metadata__", ()))
            annotation = getattr(next(members, None), "__origin__", None)
            continue
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
