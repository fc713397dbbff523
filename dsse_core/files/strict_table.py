"""Strict files of tables: a file becomes a pydantic model, or one error that lists every problem with its key path.

A file is TOML, or where its name ends in ``.json`` the same tables as JSON, which is read twenty times as fast.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_JSON, LARGEST_TOML, read_text
from dsse_core.files.bounded_parsing import DEEPEST_KEY, parse_json, parse_toml
from dsse_core.files.kinds import FileKind, kind_reported_by
from dsse_core.files.table_errors import describe_errors, key_path


class Table(BaseModel):
    """A table: unknown keys, wrong types, inf and nan are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class ColumnsTable(Table):
    """A table of columns: a list of values for each key, all of one length; a key that is not given has no list."""

    @model_validator(mode="after")
    def _are_of_one_length(self) -> Self:
        names = {name: field.alias or name for name, field in type(self).model_fields.items()}
        lengths = {names[key]: len(column) for key, column in vars(self).items() if column is not None}
        if len(set(lengths.values())) > 1:
            raise ValueError(explain_lengths(lengths))
        return self


def explain_lengths(lengths: Mapping[str, int]) -> str:
    """The problem of lists of several ``lengths``, by their keys."""
    found = ", ".join(f"{key} has {length}" for key, length in lengths.items())
    return f"the lists need as many values each; {found}"


class FileTable(Table):
    """The table of a whole file."""

    kind: ClassVar[FileKind]

    @classmethod
    def called(cls, path: Path) -> str:
        """The name of the file at ``path`` in errors."""
        return cls.kind.called(path)


Model = TypeVar("Model", bound=FileTable)
AnyTable = TypeVar("AnyTable", bound=Table)


class OtherKindError(InvalidInputError):
    """A file whose keys show another kind of file, ``found``, than the caller wants."""

    def __init__(self, path: Path, found: FileKind, wanted: FileKind) -> None:
        self.found = found
        use = found.use.format(name=path.name)
        problem = f"is {found.article} {found.name}, which {use}; give {wanted.article} {wanted.name}"
        super().__init__(wanted.called(path), [problem])


def load_strict(path: Path, model: type[Model], changes: Mapping[str, object] | None = None) -> Model:
    """Reads a file into ``model``; ``changes``: key path -> the value that replaces the file's.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML (with line and column), or does not fit the
            model: every problem with its key path (items of lists count from 1) and, for unknown keys, those allowed.
        OtherKindError: the file does not fit and has the keys of another kind of file.
    """
    what, content = model.called(path), _parse(path, model)
    if not isinstance(changes or {}, Mapping):
        kind = type(changes).__name__
        raise InvalidInputError(what, [f'changes: is a {kind}; give keys and values, as {{"faults.loss": 0.3}}'])
    if problems := [problem for key, value in (changes or {}).items() if (problem := _change(content, key, value))]:
        raise InvalidInputError(what, problems)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        _check_kind(path, content, model)
        with_changes = f", with {', '.join(changes)} set" if changes else ""
        raise InvalidInputError(what + with_changes, describe_errors(model, error)) from None


@dataclass(frozen=True)
class Fitted(Generic[AnyTable]):
    """The part of a table that fits. ``wrong``: the keys that do not fit; in ``table`` they have their defaults, or are
    missing. ``problems``: all problems of the table, as text.
    """

    table: AnyTable
    wrong: frozenset[str]
    problems: tuple[str, ...]


def load_partly(path: Path, model: type[Model]) -> Fitted[Model]:
    """Reads a file as far as it fits ``model``, so that all further problems of the file can be reported together.

    Raises:
        InvalidInputError: the file cannot be read, or is not TOML (with line and column).
        OtherKindError: the file does not fit and has the keys of another kind of file.
    """
    content = _parse(path, model)
    fitted = fit_partly(model, content)
    if fitted.problems:
        _check_kind(path, content, model)
    return fitted


def fit_partly(model: type[AnyTable], content: Mapping[str, Any]) -> Fitted[AnyTable]:
    """``content`` as far as it fits ``model``."""
    try:
        return Fitted(model.model_validate(content), frozenset(), ())
    except ValidationError as error:
        wrong = frozenset(str(problem["loc"][0]) for problem in error.errors() if problem["loc"])
        fitting = {key: content[key] for key in model.model_fields if key in content and key not in wrong}
        return Fitted(model.model_construct(**fitting), wrong, tuple(describe_errors(model, error)))


def _parse(path: Path, model: type[FileTable]) -> Any:
    what, is_json = model.called(path), path.suffix == ".json"
    text = read_text(path, largest=LARGEST_JSON if is_json else LARGEST_TOML, what=what)
    try:
        return parse_json(text) if is_json else parse_toml(text)
    except ValueError as error:
        raise InvalidInputError(what, [f"not valid {'JSON' if is_json else 'TOML'}: {error}"]) from None


def _check_kind(path: Path, content: Any, model: type[FileTable]) -> None:
    """Checks that the keys of ``content``, which does not fit ``model``, do not show another kind of file.

    Raises:
        OtherKindError: they do.
    """
    found = kind_reported_by(content) if isinstance(content, dict) else None
    if found is not None and found != model.kind:
        raise OtherKindError(path, found, model.kind)


def _change(content: Any, key: str, value: object) -> str | None:
    """Sets ``key``, a path such as ``faults.link[1].loss``, in ``content``; returns the problem of the path, if any."""
    if not re.fullmatch(r"[\w-]+(\[\d{1,9}\])*(\.[\w-]+(\[\d{1,9}\])*)*", key, re.ASCII):
        return f"{key!r} is no key; one looks like faults.loss or faults.link[1].loss"
    steps = [int(word) - 1 if bracket else word for bracket, word in re.findall(r"(\[?)([\w-]+)", key)]
    if (parts := key.count(".") + 1) > DEEPEST_KEY:
        return f"{key:.80} is a key of {parts:,} parts joined by dots, the limit is {DEEPEST_KEY}"
    for i, step in enumerate(steps):
        here = key_path(steps[:i]) or "the file"
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
