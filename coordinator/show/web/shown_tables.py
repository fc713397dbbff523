"""Tables of a moment for a page: the drawn columns with every moment, the others by request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coordinator.watch.observe.grid_tables import Columns, Tables, order_worst_first, pick_rows
from dsse_core.results.table import PHASE

MOST_METERS = 100  # the worst meters, sent with every moment
MOST_ROWS = 1000  # of one request
# column -> decimals: enough for a page, in a third of the bytes
AGE = {"value_age_s": 1}
BUS = {"vm_pu": 6, "va_deg": 5, "sigma_vm_pu": 7, "sigma_va_deg": 6, "p_kw": 3, "q_kvar": 3} | AGE
BRANCH = {"p_from_kw": 3, "q_from_kvar": 3, "i_from_a": 3, "loss_kw": 4, "loading_percent": 2} | AGE
METER = {"reading": 6, "sigma": 7, "estimate": 6, "residual_in_sigmas": 3, "normalised_residual": 3, "age_s": 1} | AGE
DRAWN_OF_BUS, DRAWN_OF_BRANCH = {"vm_pu": 5, "sigma_vm_pu": 6}, {"loading_percent": 1}
WORDS = ("meter", "area", "status", "unit", "phase", "quality", "fresh", "injection_problem")


def draw_tables(tables: Tables, *, has_grid: bool) -> dict[str, Any]:
    """The tables sent with a moment: columns in the order of the grid, or with the ``id`` of each bus without a grid;
    columns without any value are left out.
    """
    (buses, branches), meters = merge_phases(tables), tables.meters
    worst = order_worst_first(meters, MOST_METERS)
    return {
        "buses": _draw(buses, DRAWN_OF_BUS) | ({} if has_grid else {"id": buses["bus"].tolist()}),
        "branches": {} if branches is None else _draw(branches, DRAWN_OF_BRANCH),
        "meters": _describe(pick_rows(meters, worst), METER),
        "meter_counts": Counter(meters["status"]),
    }


def select_rows(tables: Tables, kind: str, name: str | None, first: int, count: int) -> dict[str, Any]:
    """All columns of the row with the id ``name``, or of ``count`` rows from ``first`` on, the worst meters first.

    ``total``: number of rows in the table.
    """
    columns, key, decimals = _find_columns(tables, kind)
    ids = [str(each) for each in columns[key]] if key in columns else []
    if name is not None:
        rows = np.array([k for k, each in enumerate(ids) if each == name], dtype=np.int64)
    else:
        end = first + count
        rows = (order_worst_first(columns, end) if kind == "meter" else np.arange(len(ids)))[first:end]
    picked = pick_rows(columns, rows)
    return {"total": len(ids), "rows": {"id": [ids[k] for k in rows.tolist()]} | _describe(picked, decimals)}


def _find_columns(tables: Tables, kind: str) -> tuple[Columns, str, Mapping[str, int]]:
    if kind == "meter":
        return tables.meters, "meter", METER
    table, key, decimals = (tables.buses, "bus", BUS) if kind == "bus" else (tables.branches, "branch", BRANCH)
    return {} if table is None else {name: table[name] for name in table.columns}, key, decimals


def merge_phases(tables: Tables) -> tuple[Columns, Columns | None]:
    """Columns of the buses and of the branches with one row for each, as a page draws them: of the phases of a bus the
    one of the lowest voltage, of those of a branch the one of the largest loading, or current.
    """
    buses, branches = tables.buses, tables.branches
    of_buses = {name: buses[name] for name in buses.columns}
    of_branches = None if branches is None else {name: branches[name] for name in branches.columns}
    if {*buses.phase} <= {PHASE}:
        return of_buses, of_branches
    of_buses = pick_rows(of_buses, _pick_one([buses.area, buses.bus], buses.vm_pu))
    if of_branches is not None:
        current = np.fmax(of_branches["i_from_a"], of_branches["i_to_a"])
        loading = np.where(np.isnan(of_branches["loading_percent"]), current, of_branches["loading_percent"])
        of_branches = pick_rows(of_branches, _pick_one([of_branches["branch"]], -loading))
    return of_buses, of_branches


def _pick_one(keys: Sequence[Sequence[Any]], values: np.ndarray) -> np.ndarray:
    """The row of the smallest value in each group of neighbouring rows with the same ``keys``, (n_group,)."""
    is_first = np.ones(len(values), dtype=bool)
    is_first[1:] = np.any([np.array(key[1:]) != np.array(key[:-1]) for key in keys], axis=0)
    return np.lexsort((values, np.cumsum(is_first)))[is_first]  # nan last


def _draw(table: Columns, names: Mapping[str, int]) -> dict[str, Any]:
    known = {name: table[name] for name in names if not np.isnan(table[name]).all()}
    return _round(known, names) | {"fresh": table["fresh"].tolist()}


def _describe(columns: Columns, decimals: Mapping[str, int]) -> dict[str, Any]:
    """Columns of numbers, rounded, and columns of words and truth values."""
    plain = {name: columns[name] for name in WORDS if name in columns}
    return _round(columns, decimals) | {n: c.tolist() if isinstance(c, np.ndarray) else c for n, c in plain.items()}


def _round(columns: Columns, decimals: Mapping[str, int]) -> dict[str, Any]:
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: np.round(columns[name], n).tolist() for name, n in decimals.items() if name in columns}
