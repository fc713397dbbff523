"""Docstrings of the product begin with a noun phrase or a verb; log lines and error texts name their subject."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = ("agents", "benchmarks", "consensus_dsse", "coordinator", "dsse_core", "scenarios")
WITHOUT_SUBJECT = {
    *("What", "Whether", "Who", "Why", "When", "How", "Where"),
    *("Which", "That", "Of", "As", "By", "In"),
}
LEVELS = {"debug", "info", "warning", "error", "exception", "critical"}
NAMELESS = re.compile(
    r"\b(who|whoever|whom|nobody|somebody|everybody|anybody|someone|anyone|no one|what|whatever)\b", re.I
)


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


def is_of_a_message(node: ast.AST) -> bool:
    """True for a call of a logger or of ``problems.append``, a finding of a state, and an error that is raised."""
    match node:
        case ast.Call(func=ast.Attribute(attr=name)) if name in LEVELS:
            return True
        case ast.Call(func=ast.Attribute(attr="append" | "extend", value=ast.Name(id=name))) if "problem" in name:
            return True
        case ast.Call(func=ast.Name(id="Finding")):
            return True
        case ast.Raise() | ast.AugAssign(target=ast.Name(id="problems")):
            return True
    return False


def texts_in(node: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, text) of the literals with more than one word in ``node``."""
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value.strip():
            yield part.lineno, part.value


def messages_of(path: Path) -> set[tuple[int, str]]:
    """(line, text) of log lines, of errors that are raised, and of problems that functions named so find."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    messages = [node for node in nodes if is_of_a_message(node)]
    for node in nodes:
        if isinstance(node, ast.FunctionDef) and re.search("problem|rejection|why|describe|explain", node.name):
            messages += [part for part in ast.walk(node) if isinstance(part, ast.Yield | ast.Return | ast.Assign)]
    return set(chain.from_iterable(map(texts_in, messages)))


@pytest.mark.parametrize("package", PACKAGES)
def test_a_log_line_and_an_error_text_name_their_subject(package: str):
    found = [
        (path.relative_to(ROOT), line, text)
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, text in messages_of(path)
    ]
    assert found
    assert [f"{path}:{line}: {text}" for path, line, text in found if NAMELESS.search(text)] == []


def test_a_message_without_a_subject_is_found(tmp_path: Path):
    path = tmp_path / "module.py"
    path.write_text(
        "def find_problem(name):\n    yield f'{name}: nobody reads it'\n"
        "def run(log):\n    log.info('what is %s', 1)\n    raise ValueError(f'{log}: an area {1} who waits')\n"
        "def other():\n    return 'nobody is named'\n"
    )
    assert [text for _, text in sorted(messages_of(path)) if NAMELESS.search(text)] == [
        ": nobody reads it",
        "what is %s",
        " who waits",
    ]
