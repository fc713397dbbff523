"""Attributes in power-grid-model's JSON that its reader would leave out without notice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dsse_core.files.wording import Suggestions
from dsse_core.printable import listed, shortened
from scenarios.importers.imported import Remark

DESCRIPTION = "extra"
"""Key of a component under which power-grid-model-io puts its name in the source; nothing electric."""
TOP = ("version", "type", "is_batch", "attributes", "data")
LONGEST_SHOWN = 80  # characters of a name


def find_unknown_attributes(tree: Any, known: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A problem for each attribute that its component does not have; ``known``: component -> its attributes.

    power-grid-model's own reader finds the other errors of ``tree``.
    """
    for component, allowed in known.items():
        unknown: dict[str, list[object]] = {}
        for row in _rows(tree, component):
            for name in row:
                if name not in allowed and name != DESCRIPTION:
                    unknown.setdefault(name, []).append(row.get("id", "without id"))
        compact = _table(tree, "attributes").get(component)
        for name in compact if isinstance(compact, list) else ():
            if name not in allowed:
                unknown.setdefault(str(name), [])
        meant = Suggestions(allowed)
        for name, owners in unknown.items():
            of = f" {listed([shortened(str(owner), LONGEST_SHOWN) for owner in owners])}" if owners else ""
            yield (
                f"{component}{of}: unknown attribute {shortened(name, LONGEST_SHOWN)!r}, which power-grid-model would "
                f"leave out{meant.find(name)}; correct or remove it, or put it under {DESCRIPTION!r} if it describes"
            )


def find_descriptions(tree: Any) -> Iterator[Remark]:
    """Remarks on parts of the file that are left out: descriptions, and keys outside the data."""
    described = [name for name in _table(tree, "data") if any(DESCRIPTION in row for row in _rows(tree, name))]
    if described:
        yield Remark("left out", f"{DESCRIPTION!r} of {listed(described)}, which describes them")
    if beside := [shortened(str(name), LONGEST_SHOWN) for name in tree if name not in TOP]:
        yield Remark("left out", f"beside the data: {listed(beside)}, which power-grid-model does not know")


def _table(tree: Any, name: str) -> Mapping[str, Any]:
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def _rows(tree: Any, component: str) -> list[dict[str, Any]]:
    rows = _table(tree, "data").get(component)
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
