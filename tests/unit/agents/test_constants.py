"""The tables of docs/reference/constants.md and the code say the same."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/reference/constants.md").read_text()
SOURCES = (
    "agents/peers/*.py",
    "agents/protocol/**/*.py",
    "agents/strategies/*.py",
    "dsse_core/linear/*.py",
    "dsse_core/exchange/*.py",
    "dsse_core/gauss_newton.py",
    "dsse_core/reading_rules.py",
    *(f"dsse_core/estimation/{name}.py" for name in ("decision", "residuals", "bad_data")),
)
PLACES = {"boundary_information.VM", "boundary_information.VA"}
NO_PARAMETERS = PLACES | {"boundary_information.BEYOND_REASON", "supply.FED"}  # a limit and a code of the wire
UNITS = {"%": 0.01, "ms": 1e-3}


def find_constants() -> dict[str, float]:
    """Module.NAME of every number that a module of protocol or exchange begins with."""
    paths = [path for source in SOURCES for path in sorted(ROOT.glob(source))]
    found = {f"{path.stem}.{name}": value for path in paths for name, value in numbers_of(path.read_text())}
    return {name: value for name, value in found.items() if name not in NO_PARAMETERS}


def numbers_of(source: str) -> Iterator[tuple[str, float]]:
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and is_number(node.value):
            (target,) = node.targets
            values = eval(compile(ast.Expression(node.value), "constant", "eval"))
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            for name, value in zip(names, values if isinstance(values, tuple) else [values], strict=True):
                yield name.id, float(value)


def is_number(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) and is_number(right)
        case ast.Tuple(elts=parts):
            return all(map(is_number, parts))
    return False


def read_tables() -> dict[str, float]:
    """NAME or module.NAME -> value, as docs/reference/constants.md has it."""
    found = {}
    for line in PAGE.splitlines():
        if names := re.findall(r"`([A-Za-z_.]+)`", line.split("|")[1] if line.startswith("| ") else ""):
            values = line.split("|")[2].split(", ")
            assert len(names) == len(values), line
            found |= {name: read_value(value) for name, value in zip(names, values, strict=True)}
    return found


def read_value(text: str) -> float:
    number, _, unit = text.strip().partition(" ")
    above, _, below = number.partition("/")
    return float(above) / float(below or 1) * UNITS.get(unit.split(" ")[0], 1.0)


CONSTANTS, TABLES = find_constants(), read_tables()


def test_there_are_constants_to_compare():
    assert len(CONSTANTS) > 50
    assert {"peers.PATIENCE_WAITS", "gauss_newton.MOST_STEPS", "interface.NOT_YET"} < CONSTANTS.keys()


@pytest.mark.parametrize("name", CONSTANTS)
def test_a_constant_is_in_the_tables_with_its_value(name: str):
    stated = TABLES.get(name, TABLES.get(name.partition(".")[2]))
    assert stated is not None, f"docs/reference/constants.md: {name} = {CONSTANTS[name]:g} is missing"
    assert stated == pytest.approx(CONSTANTS[name], rel=1e-9)


@pytest.mark.parametrize("name", TABLES)
def test_what_the_tables_name_exists(name: str):
    assert any(constant in (name, f"{constant.partition('.')[0]}.{name}") for constant in CONSTANTS)


def test_the_counts_above_the_tables_are_true():
    for part in PAGE.split("\nOf ")[1:]:
        stated = int(re.search(r", (\d+)[,;:]", part)[1])
        rows = [line.split("|")[1] for line in part.splitlines() if line.startswith("| ")][1:]
        assert stated == sum(max(1, len(re.findall(r"`[A-Za-z_.]+`", row))) for row in rows), part[:40]
