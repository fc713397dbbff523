"""No two files import each other, be it by a detour, inside a function or for types alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "coordinator", "dsse_core", "scenarios")


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports_of(path: Path, modules: set[str]) -> Iterator[str]:
    """The modules of our own that ``path`` imports; a name from a package counts as the package."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in modules else node.module for name in inside if node.module in modules)


def test_no_file_imports_one_that_imports_it() -> None:
    files = {module_of(path): path for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    graph = {module: set(imports_of(path, set(files))) - {module} for module, path in files.items()}
    assert sum(map(len, graph.values())) > len(graph)
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle
