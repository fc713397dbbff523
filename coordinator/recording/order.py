"""The order to a recorder: what it records, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.area_files.area_file import AreaFile

RECORDER = "recorder"  # the process of a run
GIB = 2**30  # bytes


@dataclass(frozen=True)
class Order:
    """``files``: of the areas, where known; ``limit_gb``: of the folder, GiB; None: none.

    ``closes``: whether what is left at the end is closed by the recorder itself.
    """

    folder: Path
    run: str
    files: Sequence[AreaFile] = ()
    limit_gb: float | None = None
    closes: bool = True

    @property
    def limit(self) -> float | None:
        """Of the folder, bytes."""
        return self.limit_gb * GIB if self.limit_gb else None
