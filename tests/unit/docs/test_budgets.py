"""The product stays within the budgets of pyproject.toml; only a commit that says why raises one.

``python tests/unit/docs/test_budgets.py`` prints what stands against each budget.
"""

from __future__ import annotations

import ast
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BUDGETS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["budgets"]
PRODUCT = ("agents", "consensus_dsse", "coordinator", "dsse_core", "scenarios")
SMALL = 70  # lines of a module below which it needs a concept of its own, or more than one importer
NOT_SMALL = ("__init__.py", "__main__.py")


def modules_of(folder: str) -> dict[str, Path]:
    """Name -> path of the modules below ``folder``."""
    paths = sorted((ROOT / folder).rglob("*.py"))
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


def count_lines(folder: str) -> int:
    return sum(len(path.read_text().splitlines()) for path in modules_of(folder).values())


def count_public_names() -> int:
    """Public classes and functions at the top of the product's modules."""
    statements = [s for p in PRODUCT for path in modules_of(p).values() for s in ast.parse(path.read_text()).body]
    defined = [s for s in statements if isinstance(s, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)]
    return sum(not definition.name.startswith("_") for definition in defined)


def count_constants() -> int:
    """Rows of the constants' page, by their names."""
    rows = [line for line in (ROOT / "docs/reference/constants.md").read_text().splitlines() if line.startswith("| `")]
    return sum(row.split("|")[1].count("`") // 2 for row in rows)


def count_words() -> int:
    """Words of the pages that a reader of the repository sees."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return sum(len(page.read_text().split()) for page in pages if "api" not in page.parts)


def count_small_modules() -> int:
    """Modules below ``SMALL`` lines that one module of the product imports."""
    known = {name: path for p in PRODUCT for name, path in modules_of(p).items()}
    importers: Counter[str] = Counter()
    for path in known.values():
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        importers.update(found & known.keys())
    return sum(
        importers[name] == 1 and len(path.read_text().splitlines()) < SMALL
        for name, path in known.items()
        if path.name not in NOT_SMALL
    )


COUNTS = {
    "public_names": count_public_names,
    "constants": count_constants,
    "words": count_words,
    "small_modules_with_one_importer": count_small_modules,
}


@pytest.mark.parametrize("folder", BUDGETS["lines"])
def test_a_wing_or_package_stays_within_its_lines(folder: str):
    assert 0 < count_lines(folder) <= BUDGETS["lines"][folder]


def test_every_package_of_the_product_has_a_budget_of_lines():
    assert [p for p in PRODUCT if not any(f.split("/")[0] == p for f in BUDGETS["lines"])] == []
    of_wings = {f.split("/")[1] for f in BUDGETS["lines"] if f.startswith("coordinator/")}
    assert of_wings == {path.parent.name for path in (ROOT / "coordinator").glob("*/__init__.py")}


@pytest.mark.parametrize("name", COUNTS)
def test_the_product_stays_within_its_budget(name: str):
    assert 0 < COUNTS[name]() <= BUDGETS[name]


if __name__ == "__main__":
    for of_lines, most in BUDGETS["lines"].items():
        print(f"lines of {of_lines}: {count_lines(of_lines)} of {most}")
    for of_count, count in COUNTS.items():
        print(f"{of_count}: {count()} of {BUDGETS[of_count]}")
