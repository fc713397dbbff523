"""docs/reference/scenario-files.md has every key of scenario and network files, as the schemas have them."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from dsse_core.files import shared_tables
from dsse_core.files.strict_table import ColumnsTable
from scenarios.files import fault_tables, network_tables, scenario_file

DOCS = Path(__file__).parents[4] / "docs"
SPEC = importlib.util.spec_from_file_location("key_tables", DOCS / "key_tables.py")
assert SPEC is not None
assert SPEC.loader is not None
key_tables = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(key_tables)
PAGES = [page for page in key_tables.PAGES if key_tables.GENERATED.search(page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tables_are_those_that_schemas_and_commands_give(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert key_tables.write_tables(text) == text, "run: python docs/key_tables.py"


def test_every_schema_has_its_table_and_every_key_its_meaning() -> None:
    shown = {
        name for page in PAGES for found in key_tables.MARKED.finditer(page.read_text()) for name in found[1].split()
    }
    schemas = {name: table for name, table in key_tables.find_tables().items() if not issubclass(table, ColumnsTable)}
    assert shown == schemas.keys()
    rows = [row for name, table in schemas.items() if name != "LinkTable" for row in key_tables.list_rows(table)]
    assert len(rows) > 100
    assert [
        row for row in rows if re.search(r"\|\s*\|$|\| (?:What|How|When|Whether|Who|Where|Which) [^|]*\|$", row)
    ] == []


def test_types_and_defaults_are_in_words() -> None:
    rows = {row.split("`")[1]: row for row in key_tables.list_rows(fault_tables.BurstTable)}
    assert rows["enter"].startswith("| `enter` | number 0 to 1, required | ")
    assert rows["loss"].startswith("| `loss` | number 0 to 1 (`1.0`) | ")
    rows = {row.split("`")[1]: row for row in key_tables.list_rows(scenario_file.TransportTable)}
    assert rows["kind"].startswith('| `kind` | `"router"`, `"neighbours"` (`"router"`) | ')
    assert [row.split("|")[2] for row in key_tables.list_rows(shared_tables.AdmmTable)] == [
        " number 1e-06 to 1000000 (`1.0`) "
    ]


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        (network_tables.BusTable, network_tables.BusColumns),
        (network_tables.BranchTable, network_tables.BranchColumns),
    ],
)
def test_lists_have_the_keys_of_tables(table: type, columns: type) -> None:
    names = [[field.alias or name for name, field in of.model_fields.items()] for of in (table, columns)]
    assert [
        name for name in names[0] if name not in network_tables.OF_PHASES or table is network_tables.BusTable
    ] == names[1]
