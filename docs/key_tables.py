"""Tables of the reference pages, written from the code: ``python docs/key_tables.py``.

A page has ``<!-- columns CLASS -->`` above a table of columns, one row for those that one string in the class
explains, ``<!-- commands -->`` above the commands of ``dsse``, ``<!-- keys SCHEMA ... -->`` above each table of keys.
Each schema adds the keys that it does not inherit. The meaning of a key is the string below its field, or without one
the field's description.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import click
from pydantic.fields import FieldInfo

from agents.area_files.tables import PlainKeys
from agents.protocol.configuration import Configuration, plain_keys
from coordinator.cli.command import DONE, ENDED, PARTS, list_leaves
from coordinator.cli.main import commands
from dsse_core import limits
from dsse_core.files.strict_table import Table
from dsse_core.results import columns

PAGES = tuple((Path(__file__).parent / "reference").glob("*.md"))
MODULES = (
    "scenarios.files.scenario_file",
    "scenarios.files.fault_tables",
    "scenarios.files.network_tables",
    "dsse_core.files.shared_tables",
    "agents.security.access_file",
)
OF_AREA_FILES = {"AreaFile": "AreaTable", "AreaKeys": "PlainKeys"}  # a scenario's AreaTable has the same name
MARKED = re.compile(r"<!-- keys (?P<names>[\w ]+) -->\n(?:\n(?:\|.*\n)+)?")
COLUMNS_OF = re.compile(r"<!-- columns (?P<name>\w+) -->\n(?:\n(?:\|.*\n)+)?")
COMMANDS = re.compile(r"<!-- commands -->\n(?:\n(?:\|.*\n)+)?")
GENERATED = re.compile("<!-- (?:keys |columns |commands )")
OF_ALL = (2, 130)  # exit codes
TYPES = {
    "AreaSelection": '`"all"` or list of texts',
    "Areas": "tables",
    "Branches": "tables, or lists",
    "BranchSelection": '`"all"` or list of texts',
    "Buses": "tables, or lists",
    "BusSelection": '`"all"` or list of integers, or texts such as `"611.c"`',
    "Exponents": "two numbers, or a pair for each leg",
    "Matrix": "number, or rows of numbers",
    "Milliseconds": "number >= 0",
    "Moment": "number >= 0",
    "Name": "text",
    "Phases": "text",
    "Seconds": "number > 0",
    "Sigma": "number > 0",
    "Taps": "number > 0, or list of numbers",
    "Ticks": '`"gateway"`, `"clock"`',
    "Triangle": "rows of numbers",
    "Version": "1",
    "ZeroInjection": '`"virtual"`, `"measured"`, list of integers, or texts such as `"645.c"`',
    "bool": "true, false",
    "float": "number",
    "int": "integer",
    "list[float]": "list of numbers",
    "str": "text",
}


def find_tables() -> dict[str, type[Table]]:
    """Name -> schema of each table of a file that a user writes."""
    tables = {
        name: value
        for module in map(importlib.import_module, MODULES)
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Table) and value.__module__ == module.__name__
    }
    of_area_files = importlib.import_module("agents.area_files.tables")
    return tables | {shown: getattr(of_area_files, name) for shown, name in OF_AREA_FILES.items()}


def write_tables(text: str) -> str:
    """``text`` of a page with its tables of keys as the schemas have them."""
    tables = find_tables()

    def write(found: re.Match[str]) -> str:
        rows = [row for name in found["names"].split() for row in list_rows(tables[name])]
        head = "| Key | Type | Meaning |\n|---|---|---|"
        return "\n".join([f"<!-- keys {found['names']} -->", "", head, *rows, ""])

    return COMMANDS.sub(lambda _: write_commands(), COLUMNS_OF.sub(write_columns, MARKED.sub(write, text)))


def write_columns(found: re.Match[str]) -> str:
    """The table of the columns of the class that a mark names."""
    table = getattr(columns, found["name"])
    meanings, rows, names = read_meanings(table), [], []
    for column in fields(table):
        names.append(f"`{column.name}`")
        if column.name in meanings:
            rows.append(f"| {', '.join(names)} | {meanings[column.name]} |")
            names.clear()
    assert not names, f"{found['name']}: no string explains {names}"
    return "\n".join([found[0].split("\n")[0], "", "| Columns | Meaning |\n|---|---|", *rows, ""])


def write_commands() -> str:
    """The table of all commands: arguments and required options, effect, ``--json``, exit codes."""
    rows = ["<!-- commands -->", "", "| command | effect | `--json` | exit codes |", "|---|---|---|---|"]
    leaves = list(list_leaves(commands))
    for part, of_what in PARTS.items():
        rows.append(f"| **{part}** {of_what} | | | |")
        rows += [_write_command(words, leaf) for words, leaf in leaves if getattr(leaf, "part", "") == part]
    return "\n".join([*rows, ""])


def _write_command(words: tuple[str, ...], command: click.Command) -> str:
    pieces = [] if isinstance(command, click.Group) else command.collect_usage_pieces(click.Context(command))
    given = [piece for piece in pieces if piece != "[OPTIONS]"]
    needed = [f"{p.opts[0]} {p.metavar}" for p in command.params if isinstance(p, click.Option) and p.required]
    has_json = any("--json" in p.opts for p in command.params)
    codes = {code: meaning for code, meaning in getattr(command, "codes", {}).items() if code not in OF_ALL}
    if codes.get(0) in (DONE, ENDED):
        del codes[0]
    shown = "; ".join(f"{code}: {meaning}" for code, meaning in codes.items())
    line = " ".join(["dsse", *words, *given, *needed]).replace("|", "\\|")
    return f"| `{line}` | {command.get_short_help_str(200).rstrip('.')} | {'yes' if has_json else ''} | {shown} |"


def list_rows(table: type[Table]) -> Iterator[str]:
    """A line for each key that ``table`` does not inherit."""
    source = Configuration if table is PlainKeys else table
    meanings = read_meanings(source)
    for name, annotation in vars(source)["__annotations__"].items():
        if name in table.model_fields and (source is table or name in dict(plain_keys())):
            field = table.model_fields[name]
            meaning = meanings.get(name) or sentence(field.description or "")
            kind = f"{type_of(annotation, field)}{default_of(field)}"
            cells = (f"`{field.alias or name}`", kind, meaning)
            yield "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def read_meanings(table: type[Any]) -> dict[str, str]:
    """Field -> the string that stands below it in the source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(table))).body[0].body  # type: ignore[attr-defined]
    return {
        field.target.id: " ".join(below.value.value.split())
        for field, below in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
        and isinstance(below.value.value, str)
    }


def sentence(description: str) -> str:
    return f"{description[:1].upper()}{description[1:]}." if description else ""


def type_of(annotation: str, field: FieldInfo) -> str:
    """Type of a key in words, with its range."""
    name = re.sub(r"^Annotated\[(.*?), Field\(description=.*$", r"\1", annotation).removesuffix(" | None")
    if name in TYPES:
        return TYPES[name]
    if options := re.fullmatch(r"Literal\[(.*)\]", name):
        return ", ".join(f"`{option}`" for option in options[1].replace("'", '"').split(", "))
    if name.startswith(("list[", "dict[", "tuple[")):
        inner = re.sub(r"^\w+\[(?:\w+, )?(.*?)\]$", r"\1", name.replace(", ...", ""))
        return {"int": "list of integers", "str": "list of texts", "ClockError": "table"}.get(inner, "tables")
    if name.endswith("Table"):
        return "table"
    bounds = list(limits_of(getattr(limits, name, None) or field.annotation)) + list(field.metadata)
    lowest = next((limit.ge for limit in bounds if getattr(limit, "ge", None) is not None), None)
    above = next((limit.gt for limit in bounds if getattr(limit, "gt", None) is not None), None)
    highest = next((limit.le for limit in bounds if getattr(limit, "le", None) is not None), None)
    kind = "integer" if "int" in name or name == "Seed" else "number"
    if above is not None:
        return f"{kind} > {above:g}" + (f", at most {highest:g}" if highest is not None else "")
    if highest is not None:
        return f"{kind} {lowest:.10g} to {'2^63 - 1' if highest == 2**63 - 1 else f'{highest:.10g}'}"
    return f"{kind} >= {lowest:g}" if lowest is not None else kind


def limits_of(annotation: Any) -> Iterator[Any]:
    """Bounds inside an annotation, its alternatives included."""
    for part in get_args(annotation):
        yield from part.metadata if isinstance(part, FieldInfo) else (part, *limits_of(part))


def default_of(field: FieldInfo) -> str:
    """Ending of the type: ``required``, the default in brackets, or nothing for a key that may be left out."""
    if field.is_required():
        return ", required"
    if field.default in (None, ()) or isinstance(field.default, Table) or field.default_factory is not None:
        return ""
    if isinstance(field.default, str):
        return f' (`"{field.default}"`)'
    return f" (`{str(field.default).lower() if isinstance(field.default, bool) else field.default}`)"


if __name__ == "__main__":
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = write_tables(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
