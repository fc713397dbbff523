"""What a source of readings and a sink of results are: one small class each, behind an entry point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol

from pydantic import BeforeValidator, ValidationInfo

from dsse_core.files.strict_table import Table

Result = Mapping[str, Any]
"""What an area estimates, as it is written in JSON: ``coordinator/gateway/results.py``."""


def _beside_the_map(given: object, info: ValidationInfo) -> object:
    folder = (info.context or {}).get("folder", Path())
    return folder / given if isinstance(given, str) else given


MapPath = Annotated[Path, BeforeValidator(_beside_the_map)]
"""A path in a map file, from the folder of that file."""


class Emit(Protocol):
    """Takes what a source reads. Neither call waits, and neither raises an error for what it is given."""

    def __call__(
        self, address: str, value: object, time: float | None = None, *, valid: bool = True, unit: str | None = None
    ) -> None:
        """What ``address`` reads: a number, or whatever the source found in its place, which is counted as wrong.

        ``time``: of the measurement, s since 1970 UTC; None: now. ``valid``: whether the source vouches for it.
        ``unit``: if the source states one, which must be that of the map.
        """
        ...

    def reject(self, reason: str, detail: str) -> None:
        """Count, under the few words of ``reason``, something that is no reading: a line that cannot be read."""
        ...


class Source(ABC):
    """Reads meters. ``Settings``: the keys of ``[source]`` in a map file, but ``kind``.

    It is made anew after every error. ``addresses``: those of the map, each once.
    """

    Settings: ClassVar[type[Table]] = Table

    def __init__(self, settings: Any, addresses: Sequence[str]) -> None:
        self.settings = settings
        self.addresses = addresses

    @classmethod
    def find_address_problem(cls, address: str) -> str:
        """Why ``address`` can be none of this source, and what one looks like; empty if it can."""
        return ""

    @abstractmethod
    async def read(self, emit: Emit) -> None:
        """Connect, and hand over what is read until there is no more.

        Whatever it raises is named, and it is called again after a pause that grows from 0.1 to 10 s.
        """


class Sink(ABC):
    """Takes results. ``Settings``: the keys of a ``[[results]]`` in a map file, but ``kind``."""

    Settings: ClassVar[type[Table]] = Table

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    async def write(self, results: AsyncIterator[Result]) -> None:
        """Connect, and write ``results``, of each area the newest, for ever.

        Whatever it raises is named, and it is called again after a pause that grows from 0.1 to 10 s.
        """
