"""The errors of strict tables as text: the key's path, the problem, the value found, the values allowed."""

from __future__ import annotations

import re
import types
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, Tag, ValidationError
from pydantic_core import ErrorDetails

from dsse_core.files.wording import Suggestions

MOST_SUGGESTED = 3  # keys of other tables
Meant = dict[tuple[str, ...], Suggestions]
"""Keys that a table may have -> the suggestions for a file's unknown keys there, within one bound of work."""


def describe_errors(model: type[BaseModel], error: ValidationError) -> list[str]:
    """Every problem of a file that does not fit ``model``, on a line each."""
    meant: Meant = {}
    return [_describe(model, e, meant) for e in error.errors()]


def _describe(model: type[BaseModel], error: ErrorDetails, meant: Meant) -> str:
    location = [step for step in error["loc"] if step != "[key]"]
    key = key_path(step for step in location if not _is_tag(step))
    if error["type"] == "extra_forbidden":
        allowed = tuple(_allowed_keys(model, location[:-1]))
        close = _suggest(model, str(location[-1]), allowed, meant)
        return f"{key}: unknown key; allowed here: {', '.join(allowed)}{close}"
    while location and _is_tag(location[-1]):
        location.pop()
    meaning = _meaning(model, location)
    if error["type"] == "missing":
        return f"{key}: missing" + (f"; {meaning}" if meaning else "")
    if error["type"] == "value_error":
        text = str(error["ctx"]["error"])
        return f"{key}: {text}" if key else text
    text = re.sub(r"^(Input|String|List|Tuple|Dictionary) should", "must", error["msg"])
    text = re.sub(r" after validation, not .*", "", text)
    text = re.sub(r"a valid dictionary( or instance of \w+)?", "a table", text).replace("a valid tuple", "a valid list")
    return f"{key or 'the file'}: {text}, found {_show(error['input'])}" + (f" ({meaning})" if meaning else "")


def _suggest(model: type[BaseModel], word: str, allowed: tuple[str, ...], meant: Meant) -> str:
    """``"; did you mean 'x'?"``: a key of another table with this last part, or a close one, here before elsewhere."""
    elsewhere = _paths_by_name(model)
    names = tuple(elsewhere)
    if word not in elsewhere and (close := meant.setdefault(allowed, Suggestions(allowed)).find(word)):
        return close
    name = word if word in elsewhere else meant.setdefault(names, Suggestions(names)).find_word(word)
    paths = elsewhere.get(name, ())[:MOST_SUGGESTED]
    return f"; did you mean {' or '.join(map(repr, paths))}?" if paths else ""


@cache
def _paths_by_name(model: type[BaseModel]) -> Mapping[str, list[str]]:
    """Last part of a key -> the paths of keys that end so, outermost first; items of lists and of named tables have no
    path of their own.
    """
    found: dict[str, list[str]] = {}
    tables: list[tuple[str, type[BaseModel]]] = [("", model)]
    for before, table in tables:
        for name, attribute in _keys(table).items():
            found.setdefault(name, []).append(before + name)
            inner = table.model_fields[attribute].annotation
            tables += [(f"{before}{name}.", part) for part in _members(inner) if _is_table(part)]
    return found


def _members(annotation: Any) -> Iterator[Any]:
    """The members of a union, also inside annotations; ``annotation`` itself if it is none."""
    if get_origin(annotation) is Annotated:
        yield from _members(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, types.UnionType):
        for part in get_args(annotation):
            yield from _members(part)
    else:
        yield annotation


def _is_table(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _show(value: object) -> str:
    """A value as errors show it, cut short."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        return f"a list of {len(value)} table{'s' if len(value) > 1 else ''}"
    try:
        return f"{value!r:.200}"
    except ValueError:  # Python prints no integer of so many digits
        return "an integer of too many digits"


def _is_tag(step: int | str) -> bool:
    """True where ``step`` is no key but the tag of a union's member; brackets set tags apart from keys."""
    return isinstance(step, str) and re.fullmatch(r"\[[a-z]+\]", step) is not None


def key_path(location: Iterable[int | str]) -> str:
    path = "".join(f"[{step + 1}]" if isinstance(step, int) else f".{step}" for step in location)
    return path.removeprefix(".")


def _keys(table: type[BaseModel]) -> dict[str, str]:
    """Key as written in the file -> attribute of the table."""
    return {field.alias or name: name for name, field in table.model_fields.items()}


def _allowed_keys(model: type[BaseModel], location: Iterable[int | str]) -> list[str]:
    table = _table_in(_annotation_at(model, location))
    return list(_keys(table)) if table else []


def _meaning(model: type[BaseModel], location: list[int | str]) -> str:
    """The description of the key at ``location``, empty if it has none."""
    table = _table_in(_annotation_at(model, location[:-1]))
    name = _keys(table).get(str(location[-1])) if table and location else None
    return (table.model_fields[name].description or "") if table and name else ""


def _annotation_at(model: type[BaseModel], location: Iterable[int | str]) -> Any:
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
    if _is_table(annotation):
        return annotation  # type: ignore[no-any-return]
    return next((table for part in get_args(annotation) if (table := _table_in(part))), None)
