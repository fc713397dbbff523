"""Parameters of tests at their level: the first of a kind in each run, the further ones with ``--long``."""

from __future__ import annotations

from typing import Any

import pytest


def further(*values: Any) -> list[Any]:
    """Parameters that prove again what another parameter proves in a plain run."""
    return [pytest.param(value, marks=pytest.mark.long) for value in values]


SECURED_FURTHER = [pytest.param(False, id="open"), pytest.param(True, id="secured", marks=pytest.mark.long)]
