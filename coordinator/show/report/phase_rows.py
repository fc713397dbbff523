"""Numbers of a whole bus or branch in tables with a row for each phase: readers see them once, in its first row."""

from __future__ import annotations

import numpy as np

from coordinator.lab.evaluation.result import RunOutcome
from dsse_core.printable import listed
from dsse_core.results.columns import OF_ALL_PHASES, find_first_rows
from dsse_core.results.table import Table


def show_by_site(table: Table, ids: str) -> Table:
    """``table`` with unbalance, neutral current and losses in the first row of each bus or branch; ``ids``: its column.

    Of the loss of coupled conductors, which give power to each other, or of a bank, only the sum is a loss.
    """
    if not (known := [name for name in OF_ALL_PHASES if name in table.columns]):
        return table
    is_first = find_first_rows(table[ids])
    shown = {name: table[name] for name in table.columns}
    shown |= {name: np.where(is_first, table[name], np.nan) for name in known}
    if "loss_kw" in shown:
        shown["loss_kw"] = np.full(len(is_first), np.nan)
        shown["loss_kw"][is_first] = np.add.reduceat(table.loss_kw, np.flatnonzero(is_first))
    return Table("rows", shown)


def describe_unbalance(result: RunOutcome) -> str:
    """Sentence on the largest unbalance, the largest neutral current, and buses beyond the limit, of fresh numbers;
    empty without phases.
    """
    buses, branches = result.buses, result.branches
    if "unbalance_percent" not in buses.columns:
        return ""
    found = []
    for table, column, of, text in (
        (buses, "unbalance_percent", list(map(str, buses.bus.tolist())), "unbalance |V-|/|V+| {:.2f} % at bus {}"),
        (branches, "neutral_a", branches.branch, "current in neutral and ground {:.1f} A in branch {}"),
    ):
        values = np.where(table.fresh, table[column], np.nan)
        if not np.isnan(values).all():
            row = int(np.nanargmax(values))
            found.append(text.format(values[row], of[row]))
    limit = result.scenario.operating_limits.most_unbalance_percent
    beyond = buses.bus[buses.fresh & (buses.unbalance_percent > limit) & find_first_rows(buses.bus)].tolist()
    more = f"; unbalance above {limit:g} % at bus {listed(beyond)}" if beyond else ""
    return f"largest {', largest '.join(found)}{more}" if found else ""
