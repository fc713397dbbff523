"""Tables and columns of a pandapower network that pandapower's own conversion does not look at.

Columns that pandapower knows, such as ratings, costs and limits, are not reported: those that its power flow does not
use change no power flow. Other columns may be notes of a user, or have a misspelt name.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

from dsse_core.files.wording import Suggestions
from dsse_core.printable import listed, shortened
from scenarios.importers.imported import Remark
from scenarios.importers.pandapower.checks import ALL_COLUMNS

LONGEST_SHOWN = 80  # characters of a name
NOT_NEEDED = {"bus_geodata", "line_geodata", "characteristic", "poly_cost", "pwl_cost", "group", "measurement"}
"""Tables that change no power flow."""


def find_unread(net: Any) -> Iterator[Remark]:
    """Columns that pandapower does not know, tables of its elements that are not its own, and controllers."""
    empty = importlib.import_module("pandapower").create_empty_network()
    for name in ALL_COLUMNS:
        known = set(empty[name].columns) | _columns_in_schema(name)
        meant = Suggestions(sorted(known))
        strange = [str(column) for column in net[name].columns if column not in known] if len(net[name]) else []
        if strange:
            shown = [f"{shortened(column, LONGEST_SHOWN)}{meant.find(column)}" for column in strange]
            yield Remark("left out", f"columns of table {name} that pandapower does not know: {listed(shown)}")
    foreign = [
        shortened(str(name), LONGEST_SHOWN)
        for name, table in net.items()
        if name not in empty and name not in NOT_NEEDED and not str(name).startswith(("res_", "_"))
        if hasattr(table, "columns") and len(table)
    ]
    if foreign:
        yield Remark("left out", f"table {listed(foreign)}: pandapower has no elements of this name")
    controllers = net.get("controller")  # not a table where a strange file has it so
    if hasattr(controllers, "columns") and len(controllers):
        yield Remark("left out", f"controller {listed(list(controllers.index))}: not run, taps stay where they are")


def _columns_in_schema(name: str) -> set[str]:
    """Columns that pandapower knows beyond those of its empty tables."""
    schema = getattr(importlib.import_module(f"pandapower.network_schema.{name}"), f"{name}_schema")
    return set(schema.columns)
