"""Parameters of tests at their level: the first in each run, further ones with ``--long``, all with ``--thorough``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest


def further(*values: Any) -> list[Any]:
    """Parameters that prove again what another parameter proves in a plain run."""
    return [pytest.param(value, marks=pytest.mark.long) for value in values]


def many_more(*values: Any) -> list[Any]:
    """Parameters that ``--thorough`` alone draws, as many as documents claim."""
    return [pytest.param(value, marks=pytest.mark.thorough) for value in values]


def some_further(values: Sequence[Any], step: int) -> list[Any]:
    """Parameters of which each ``step``-th is a further one, and the others are many more."""
    return [pytest.param(v, marks=pytest.mark.thorough if k % step else pytest.mark.long) for k, v in enumerate(values)]


SECURED_FURTHER = [pytest.param(False, id="open"), pytest.param(True, id="secured", marks=pytest.mark.long)]
