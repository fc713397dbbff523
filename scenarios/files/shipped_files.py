"""The TOML files inside this package: networks in ``cases/``, scenarios in ``shipped/``."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Literal


def find_shipped(folder: Literal["cases", "shipped"]) -> dict[str, Path]:
    """Name -> file of everything shipped in ``folder``, sorted by name."""
    found = (Path(str(entry)) for entry in (files("scenarios") / folder).iterdir())
    return dict(sorted((path.stem, path) for path in found if path.suffix == ".toml"))
