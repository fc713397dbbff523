"""Name of a run, a part of every key of its messages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from agents.messages.keys import NAME
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LONGEST_NAME

if TYPE_CHECKING:  # a command that only watches needs no scenario
    from scenarios.scenario import Scenario


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
