"""Name and address of a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agents.messages.keys import NAME
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LONGEST_NAME

if TYPE_CHECKING:  # a command that only watches needs no scenario
    from scenarios.scenario import Scenario


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


def default_run_id(scenario: Scenario) -> str:
    """The scenario's name, reduced to the letters that a key may contain."""
    return re.sub(r"[^a-z0-9_-]+", "-", scenario.name.lower())[:LONGEST_NAME].strip("-") or "run"


def choose_run_id(scenario: Scenario, given: str | None) -> str:
    """``given``, or the scenario's own.

    Raises:
        InvalidInputError: ``given`` has letters that a key may not contain.
    """
    return check_run_id(given) if given is not None else default_run_id(scenario)


def check_run_id(given: str) -> str:
    """``given``, if it may be a part of a key.

    Raises:
        InvalidInputError: it has letters that a key may not contain.
    """
    if not NAME.fullmatch(given):
        raise InvalidInputError("run", [f"{given!r} may only contain a-z, 0-9, _ and -, {LONGEST_NAME} at most"])
    return given
