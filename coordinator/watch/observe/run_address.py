"""Address of a run. It loads nothing, since the options of the command line are made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunAddress:
    """Address of a run. ``endpoints``: of routers; with ``direct`` those of all areas, without a router.

    ``run``: its name; None: the run that the keys name, or the only one on the bus. ``timeout_s``: limit for an
    endpoint to answer, and for a run to appear. ``keys``: folder of credentials.
    """

    endpoints: Sequence[str]
    run: str | None
    timeout_s: float
    keys: Path | None = None
    direct: bool = False
