"""Distributions with a strategy of their own, as an installer leaves them: modules, and a dist-info beside them."""

from __future__ import annotations

import tomllib
from pathlib import Path

from agents.strategies.installed import GROUP

OWN_STRATEGY = Path(__file__).parents[2] / "examples" / "own_strategy"


def write_distribution(folder: Path, name: str, entry: str, modules: dict[str, str]) -> Path:
    """``folder`` with distribution ``name``: ``entry`` is "strategy = module:Class", ``modules`` name -> text."""
    info = folder / f"{name.replace('-', '_')}-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{entry}\n")
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)
    return folder


def write_example(folder: Path) -> Path:
    """``folder`` with what an installer makes of ``examples/own_strategy``."""
    project = tomllib.loads((OWN_STRATEGY / "pyproject.toml").read_text())["project"]
    ((strategy, place),) = project["entry-points"][GROUP].items()
    text = (OWN_STRATEGY / "boundary_average.py").read_text()
    return write_distribution(folder, project["name"], f"{strategy} = {place}", {"boundary_average": text})
