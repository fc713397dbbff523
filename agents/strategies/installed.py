"""The strategies that are installed: entry points of group ``dsse.strategies``, this project's own among them."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from agents.messages.packing import add_message_type
from agents.strategies.interface import AnyStrategy
from dsse_core.errors import InvalidInputError
from dsse_core.files.installation import install_command
from dsse_core.files.wording import describe_unknown

GROUP = "dsse.strategies"


def list_strategies() -> tuple[str, ...]:
    """The names of all installed strategies, sorted; none of them is imported.

    Raises:
        InvalidInputError: there is none: this project itself is not installed, or in a version without entry points.
    """
    names = tuple(sorted({entry.name for entry in _find_entries(tuple(sys.path))}))
    if not names:
        cure = f"install consensus-dsse again: {install_command()}"
        raise InvalidInputError("strategies", [f"no installed distribution has an entry point {GROUP!r}; {cure}"])
    return names


def load_strategy(name: str) -> type[AnyStrategy]:
    """The class of strategy ``name``, whose messages can be encoded and decoded from now on.

    Raises:
        InvalidInputError: there is none of this name, or two, or it cannot be used: naming its distribution.
    """
    return _load(name, tuple(sys.path))


@functools.cache  # until the path changes: hundreds of agents are forked from one process
def _find_entries(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))


@functools.cache
def _load(name: str, path: tuple[str, ...]) -> type[AnyStrategy]:
    found = [entry for entry in _find_entries(path) if entry.name == name]
    if not found:
        raise InvalidInputError("strategy", [describe_unknown("strategy", name, list_strategies())])
    if len(found) > 1:
        owners = " and ".join(sorted(map(_owner_of, found)))
        raise InvalidInputError(f"strategy {name!r}", [f"is one of {owners}; uninstall one of them"])
    entry = found[0]
    cure = "correct or uninstall that distribution"
    try:
        cls = entry.load()
    except Exception as error:  # a foreign module may raise anything
        problem = f"{entry.value} cannot be imported: {type(error).__name__}: {error}; {cure}"
        raise InvalidInputError(_describe(entry), [problem]) from error
    if problems := list(_find_problems(cls)):
        raise InvalidInputError(_describe(entry), [f"{entry.value}: {problem}; {cure}" for problem in problems])
    strategy: type[AnyStrategy] = cls
    return strategy


def _describe(entry: EntryPoint) -> str:
    """Name of a strategy and its distribution, for an error only: it takes reading the distribution's metadata."""
    return f"strategy {entry.name!r} of {_owner_of(entry)}"


def _owner_of(entry: EntryPoint) -> str:
    return f"distribution {entry.dist.name} {entry.dist.version}" if entry.dist else "a distribution without a name"


def _find_problems(cls: Any) -> Iterator[str]:
    """Defects of a strategy's class; its message types are added on the way."""
    if not (isinstance(cls, type) and issubclass(cls, AnyStrategy)):
        yield "is no class derived from agents.strategies.Strategy"
        return
    if missing := getattr(cls, "__abstractmethods__", ()):
        yield f"does not define {', '.join(sorted(missing))}"
    if not getattr(cls, "message_types", ()):
        yield "message_types is missing; name the classes of its messages"
        return
    for message_type in cls.message_types:
        try:
            add_message_type(message_type)
        except ValueError as error:
            yield str(error)
