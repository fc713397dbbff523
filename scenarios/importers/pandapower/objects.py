"""Check of the objects that a pandapower file names, before its reader imports their modules and builds them.

Tables are JSON texts inside the JSON, and so may be the cells of tables. pandas reads these texts with a parser of its
own, which accepts more than JSON. So only the parser here reads the texts of the file, and rejects what it does not
understand; pandapower and pandas get texts that are written again from the checked content.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_json

NET = ("pandapower.auxiliary", "pandapowerNet")
TABLES = {
    ("pandas.core.frame", "DataFrame"),
    ("pandas", "DataFrame"),
    ("pandas.core.series", "Series"),
    ("pandas", "Series"),
}
HARMLESS = (
    TABLES
    | {
        NET,
        ("networkx", "MultiGraph"),
        ("builtins", "complex"),
        ("builtins", "tuple"),
        ("builtins", "set"),
        ("builtins", "frozenset"),
        ("numpy", "array"),
        ("numpy", "bool"),
    }
    | {("numpy", f"{kind}{bits}") for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)}
)
"""(module, class) of data."""
HARMLESS_PACKAGES = ("pandapower.control.", "pandapower.protection.")
"""Packages of objects that stand in tables; their modules are pandapower's own."""
KEYS = {"_module", "_class", "_object", "orient", "dtype", "is_multiindex", "is_multicolumn"}
TABLE_KEYS = KEYS | {"typ", "index_name", "index_names", "column_name", "column_names"}
"""Keys of a table; other keys would reach pandas' reader, which can be made to open files."""
PLAIN_PACKAGES = ("numpy", "builtins")
"""Packages of objects made from numbers and texts; the text of any other object is JSON."""
DEEPEST = 5  # levels of JSON text inside JSON text


def write_anew(what: str, tree: Any) -> str:
    """The JSON text of ``tree``, a pandapower network, with the texts inside it written again as well.

    Nothing is imported or built. Texts that no parser reads, such as names, stay as they are.

    Raises:
        InvalidInputError: on ``what``, every object that is not allowed and every text that is no JSON.
    """
    problems: list[str] = []
    try:
        text = json.dumps(_check(tree, problems, 0))
    except RecursionError:
        problems.append("it nests too deeply")
    if problems:
        raise InvalidInputError(what, list(dict.fromkeys(problems)))
    return text


def _check(value: Any, problems: list[str], level: int) -> Any:
    """``value`` with its texts of JSON written again; ``level``: number of texts that it stands in."""
    if isinstance(value, list):
        return [_check(item, problems, level) for item in value]
    if not isinstance(value, dict):
        return value
    found = list(_find_problems_of(value))
    problems += found
    checked = {key: _check(item, problems, level) for key, item in value.items()}
    if not found and isinstance(value.get("_object"), str) and value.get("_module") not in (None, *PLAIN_PACKAGES):
        is_table = (value.get("_module"), value.get("_class")) in TABLES
        checked["_object"] = _check_text(value["_object"], problems, level + 1, allow_nan=not is_table)
    return checked


def _check_text(text: str, problems: list[str], level: int, *, allow_nan: bool) -> str:
    """``text`` written again; ``allow_nan``: nan and inf, which pandapower writes and reads, and pandas does not."""
    if level > DEEPEST:
        problems.append(f"JSON texts stand inside each other more than {DEEPEST} times")
        return ""
    try:
        return json.dumps(_check(parse_json(text), problems, level), allow_nan=allow_nan)
    except ValueError as error:
        problems.append(f"an object whose content is no JSON but {_shown(text)} ({error})")
        return ""


def _find_problems_of(table: Mapping[str, Any]) -> Iterator[str]:
    """Problems of a JSON object that stands for an object of Python."""
    if "_module" not in table and "_class" not in table:
        return
    kind = (table.get("_module"), table.get("_class"))
    named = f"{_shown(kind[0])}, class {_shown(kind[1])}"
    if not (isinstance(kind[0], str) and isinstance(kind[1], str)):
        yield f"an object of module {named}: one text each is expected"
        return
    if kind not in HARMLESS and not (kind[0].startswith(HARMLESS_PACKAGES) and kind[1] != "function"):
        yield f"an object of module {named}: reading the file would import and build it; take it out if it is needed"
    if kind in TABLES:
        if foreign := sorted(set(table) - TABLE_KEYS):
            known = ", ".join(sorted(TABLE_KEYS))
            yield f"a table with the key {', '.join(map(_shown, foreign[:5]))}; only {known} are known"
        if not isinstance(table.get("_object"), str):
            yield f"a table whose content is no text of JSON but {_shown(table.get('_object'))}"


def _shown(value: Any) -> str:
    return "none" if value is None else ascii(str(value)[:80])
