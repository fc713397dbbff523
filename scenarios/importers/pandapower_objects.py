"""Which objects a pandapower file may name: its reader imports their modules and builds them, so look before it does.

Tables are JSON texts inside the JSON, and so may be what stands in their cells; every level is looked at.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

TABLES = {("pandas.core.frame", "DataFrame"), ("pandas", "DataFrame")}
HARMLESS = (
    TABLES
    | {
        ("pandapower.auxiliary", "pandapowerNet"),
        ("pandas.core.series", "Series"),
        ("pandas", "Series"),
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
"""Whose objects stand in tables; their modules are pandapower's own."""
KEYS = {"_module", "_class", "_object", "orient", "dtype", "is_multiindex", "is_multicolumn"}
TABLE_KEYS = KEYS | {"index_name", "index_names", "column_name", "column_names"}
"""Of a table; others would reach pandas' reader, which can be told to open files."""
DEEPEST = 5  # levels of JSON text inside JSON text

Pairs = list[tuple[str, Any]]


def find_foreign_objects(text: str, level: int = 0) -> Iterator[str]:
    """Every object that ``text`` names and that is none of those allowed; nothing is imported or built.

    Raises:
        ValueError, RecursionError: ``text`` is no JSON, or nests too deeply.
    """
    found: list[str] = []

    def look(pairs: Pairs) -> dict[str, Any]:
        found.extend(_find_problems_of(pairs))
        for _, value in pairs:
            look_into(value)
        return {}

    def look_into(value: Any) -> None:
        if isinstance(value, list):
            for item in value:
                look_into(item)
        elif isinstance(value, str) and value.lstrip()[:1] in ("{", "["):
            found.extend(_find_inside(value, level + 1))

    look_into(json.loads(text, object_pairs_hook=look))
    yield from dict.fromkeys(found)


def _find_inside(text: str, level: int) -> Iterator[str]:
    if level > DEEPEST:
        yield f"JSON texts stand inside each other more than {DEEPEST} times"
        return
    try:
        yield from find_foreign_objects(text, level)
    except ValueError:
        return  # a name such as "[old] line"; only what is JSON can name objects


def _find_problems_of(pairs: Pairs) -> Iterator[str]:
    """``pairs``: of one JSON object, a key given twice included."""
    keys = [key for key, _ in pairs]
    modules = [value for key, value in pairs if key == "_module"]
    classes = [value for key, value in pairs if key == "_class"]
    if not modules and not classes:
        return
    named = f"{_shown(modules)}, class {_shown(classes)}"
    if len(modules) != 1 or len(classes) != 1 or not all(isinstance(name, str) for name in (*modules, *classes)):
        yield f"an object of module {named}: one text each is expected"
        return
    kind = (modules[0], classes[0])
    if kind not in HARMLESS and not (kind[0].startswith(HARMLESS_PACKAGES) and kind[1] != "function"):
        yield f"an object of module {named}: reading the file would import and build it; take it out if it is needed"
    if kind in TABLES:
        if foreign := sorted(set(keys) - TABLE_KEYS):
            yield f"a table with the key {_shown(foreign)}; only {', '.join(sorted(TABLE_KEYS))} are known"
        for content in (value for key, value in pairs if key == "_object" and isinstance(value, str)):
            if content.lstrip()[:1] not in ("{", "["):
                yield f"a table whose content is no JSON but {_shown([content])}"


def _shown(values: list[Any]) -> str:
    return ", ".join(ascii(str(value)[:80]) for value in values[:5]) or "none"
