"""Docstrings of the product begin with a noun phrase or a verb, not with a word that leaves out the subject."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = ("agents", "benchmarks", "consensus_dsse", "coordinator", "dsse_core", "scenarios")
WITHOUT_SUBJECT = {
    *("What", "Whether", "Who", "Why", "When", "How", "Where"),
    *("Which", "That", "Of", "As", "By", "In"),
}


def docstrings_of(path: Path) -> Iterator[tuple[int, str]]:
    """(line, docstring) of the module, its classes and functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node)
            if docstring:
                yield getattr(node, "lineno", 1), docstring


@pytest.mark.parametrize("package", PACKAGES)
def test_a_docstring_begins_with_its_subject_or_a_verb(package: str):
    found = [
        (path.relative_to(ROOT), line, docstring)
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, docstring in docstrings_of(path)
    ]
    assert found
    assert [f"{path}:{line}: {text[:60]}" for path, line, text in found if text.split()[0] in WITHOUT_SUBJECT] == []
