"""Interfaces of a source of readings and of a sink of results: one small class each, behind an entry point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol

from pydantic import BeforeValidator, ValidationInfo

from dsse_core.files.strict_table import Table

Result = Mapping[str, Any]
"""An area's estimate as it is written in JSON: ``coordinator/field/gateway/results.py``."""


def _beside_the_map(given: object, info: ValidationInfo) -> object:
    folder = (info.context or {}).get("folder", Path())
    return folder / given if isinstance(given, str) else given


MapPath = Annotated[Path, BeforeValidator(_beside_the_map)]
"""A path in a map file, relative to the folder of that file."""


class Emit(Protocol):
    """Receiver of a source's readings. Neither call waits, and neither raises an error for its arguments."""

    def __call__(
        self, address: str, value: object, time: float | None = None, *, valid: bool = True, unit: str | None = None
    ) -> None:
        """Take the reading at ``address``: a number, or what the source found in its place, which is counted as wrong.

        ``time``: of the measurement, s since 1970 UTC; None: now. ``valid``: True where the source vouches for it.
        ``unit``: the unit that the source states, if any; it must be that of the map.
        """
        ...

    def reject(self, reason: str, detail: str) -> None:
        """Count an item that is no reading, such as a malformed line; ``reason``: a few words to count it by."""
        ...


class Source(ABC):
    """Reads meters. ``Settings``: the keys of ``[source]`` in a map file, except ``kind``.

    The gateway makes a new source after every error. ``addresses``: those of the map, each once.
    """

    Settings: ClassVar[type[Table]] = Table

    def __init__(self, settings: Any, addresses: Sequence[str]) -> None:
        self.settings = settings
        self.addresses = addresses

    @classmethod
    def find_address_problem(cls, address: str) -> str:
        """The form of this source's addresses, where ``address`` does not have it; empty if it has."""
        return ""

    @abstractmethod
    async def read(self, emit: Emit) -> None:
        """Connect, and emit readings until the source ends.

        The gateway logs an error raised here and makes a new source after a pause that grows from 0.1 to 10 s.
        """


class Sink(ABC):
    """Takes results. ``Settings``: the keys of a ``[[results]]`` in a map file, except ``kind``."""

    Settings: ClassVar[type[Table]] = Table

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    async def write(self, results: AsyncIterator[Result]) -> None:
        """Connect, and write ``results``, the newest of each area, without end.

        The gateway logs an error raised here and makes a new sink after a pause that grows from 0.1 to 10 s.
        """
