"""The installed sources and sinks: entry points of ``dsse.sources`` and ``dsse.sinks``, the shipped ones included."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from coordinator.field.gateway.interface import Sink, Source
from dsse_core.errors import InvalidInputError
from dsse_core.files.installation import install_command
from dsse_core.files.strict_table import Table
from dsse_core.files.table_errors import describe_errors
from dsse_core.files.wording import describe_unknown

SOURCES, SINKS = "dsse.sources", "dsse.sinks"
OURS = "consensus-dsse"
KIND = "kind"
Part = TypeVar("Part", bound=Source | Sink)


def load_source(table: Mapping[str, Any], folder: Path) -> tuple[type[Source], Table]:
    """The class that ``[source]`` names and its settings; ``folder``: the folder that its paths are relative to.

    Raises:
        InvalidInputError: ``kind`` is not installed, its class cannot be used, or the settings have problems; each
            problem is named with its key.
    """
    return _load(Source, SOURCES, table, "source", folder)  # type: ignore[type-abstract]


def load_sink(table: Mapping[str, Any], place: str, folder: Path) -> tuple[type[Sink], Table]:
    """The class that a ``[[results]]`` at key path ``place`` names and its settings; otherwise as ``load_source``."""
    return _load(Sink, SINKS, table, place, folder)  # type: ignore[type-abstract]


def _load(base: type[Part], group: str, table: Mapping[str, Any], place: str, folder: Path) -> tuple[type[Part], Table]:
    kind = table.get(KIND)
    found = {entry.name: entry for entry in entry_points(group=group)}
    if not isinstance(kind, str) or kind not in found:
        what = "missing" if kind is None else describe_unknown("kind", str(kind), sorted(found))
        allowed = f"; allowed: {', '.join(sorted(found))}" if kind is None else ""
        raise InvalidInputError(place, [f"{place}.{KIND}: {what}{allowed}"])
    cls = _import(base, found[kind], place)
    try:
        content = {key: value for key, value in table.items() if key != KIND}
        return cls, cls.Settings.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        problems = [f"{place}.{problem}" for problem in describe_errors(cls.Settings, error)]
        raise InvalidInputError(place, problems) from None


def _import(base: type[Part], entry: EntryPoint, place: str) -> type[Part]:
    owner = f"distribution {entry.dist.name} {entry.dist.version}" if entry.dist else "a distribution without a name"
    what = f"{place}.{KIND}: {entry.name!r} of {owner}"
    try:
        cls = entry.load()
    except ModuleNotFoundError as error:
        is_ours = entry.dist is not None and entry.dist.name == OURS
        cure = install_command(entry.name) if is_ours else "install it, or correct that distribution"
        raise InvalidInputError(
            place, [f"{what} needs module {error.name!r}, which is not installed; {cure}"]
        ) from None
    except Exception as error:  # whatever a foreign module does
        problem = f"{what}: {entry.value} cannot be imported: {type(error).__name__}: {error}"
        raise InvalidInputError(place, [f"{problem}; correct or uninstall that distribution"]) from error
    if not (isinstance(cls, type) and issubclass(cls, base)):
        problem = f"{what}: {entry.value} is no class derived from coordinator.field.gateway.{base.__name__}"
        raise InvalidInputError(place, [f"{problem}; correct or uninstall that distribution"])
    if missing := getattr(cls, "__abstractmethods__", ()):
        problem = f"{what}: {entry.value} does not define {', '.join(sorted(missing))}"
        raise InvalidInputError(place, [f"{problem}; correct or uninstall that distribution"])
    found: type[Part] = cls
    return found
