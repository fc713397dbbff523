"""The order to a recorder: run, areas, folder and limit of the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.protocol.configuration import Configuration

RECORDER = "recorder"  # the process of a run
GIB = 2**30  # bytes


@dataclass(frozen=True)
class Order:
    """The order to a recorder.

    ``files``: area files, where known. ``limit_gb``: largest size of the folder, GiB; None: no limit. ``closes``: the
    recorder itself closes the last segments at its end.
    """

    folder: Path
    run: str
    files: Sequence[Configuration] = ()
    limit_gb: float | None = None
    closes: bool = True

    @property
    def limit(self) -> float | None:
        """Largest size of the folder, bytes; None: no limit."""
        return self.limit_gb * GIB if self.limit_gb else None
