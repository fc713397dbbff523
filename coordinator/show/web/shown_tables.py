"""Tables of a moment for a page: the drawn columns with every moment, the others by request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from coordinator.watch.observe.grid_tables import Columns, Tables, order_worst_first, pick_rows
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.results.table import ALL_PHASES, Table

MOST_METERS = 100  # the worst meters, sent with every moment
MOST_ROWS = 1000  # of one request
# column -> decimals: enough for a page, in a third of the bytes
AGE = {"value_age_s": 1}
BUS = {"vm_pu": 6, "va_deg": 5, "sigma_vm_pu": 7, "sigma_va_deg": 6, "p_kw": 3, "q_kvar": 3} | AGE
BRANCH = {"p_from_kw": 3, "q_from_kvar": 3, "i_from_a": 3, "loss_kw": 4, "loading_percent": 2} | AGE
METER = {"reading": 6, "sigma": 7, "estimate": 6, "residual_in_sigmas": 3, "normalised_residual": 3, "age_s": 1} | AGE
WITH_PHASES = {"vm_kv": 5, "unbalance_percent": 3, "p_to_kw": 3, "q_to_kvar": 3, "i_to_a": 3, "neutral_a": 3}
DRAWN_OF_BUS, DRAWN_OF_BRANCH = {"vm_pu": 5, "sigma_vm_pu": 6}, {"loading_percent": 1}
WORDS = ("meter", "area", "status", "unit", "phase", "quality", "fresh", "injection_problem", "grounded")


def draw_tables(tables: Tables, limits: OperatingLimits, *, has_grid: bool) -> dict[str, Any]:
    """The tables sent with a moment: columns in the order of the grid, or with the ``id`` of each bus, and its
    ``phase`` where there are some, without a grid; columns without any value are left out. Where a bus has several
    rows, ``worst_nodes`` are those with the voltages by which buses are judged, see ``OperatingLimits.find_worst``.

    A voltage to ground without a path to ground is not known, and there is none without supply.
    """
    buses, branches, meters = tables
    worst, drawn, place = order_worst_first(meters, MOST_METERS), {name: buses[name] for name in buses.columns}, {}
    drawn["vm_pu"] = np.where(drawn["vm_pu"] == 0.0, np.nan, drawn["vm_pu"])
    if "grounded" in drawn:
        drawn["vm_pu"] = np.where(drawn["grounded"], drawn["vm_pu"], np.nan)
    if not has_grid:
        place = {"id": buses.bus.tolist()} | ({"phase": buses.phase} if _has_phases(buses) else {})
    of, fresh = np.array(buses.bus), np.where(drawn["fresh"], drawn["vm_pu"], np.nan)
    chosen = {"worst_nodes": limits.find_worst(of, fresh).tolist()} if len(np.unique(of)) < len(of) else {}
    return {
        **chosen,
        "buses": _draw(drawn, DRAWN_OF_BUS) | place,
        "branches": {} if branches is None else _draw(branches, DRAWN_OF_BRANCH),
        "meters": _describe(pick_rows(meters, worst), METER),
        "meter_counts": Counter(meters["status"]),
    }


def select_rows(
    tables: Tables, kind: str, name: str | None, first: int, count: int, at: str | None = None
) -> dict[str, Any]:
    """All columns of the rows with the id ``name``, of the meters ``at`` a bus or branch, or of ``count`` rows from
    ``first`` on, the worst meters first.

    ``total``: number of rows in the table.
    """
    columns, key, decimals = _find_columns(tables, kind)
    ids = [str(each) for each in columns[key]] if key in columns else []
    if name is not None:
        rows = np.array([k for k, each in enumerate(ids) if each == name], dtype=np.int64)
    elif at is not None:
        there = [[str(each) == at for each in columns[where]] for where in ("bus", "branch") if where in columns]
        rows = np.flatnonzero(np.any(there, axis=0)) if there else np.zeros(0, dtype=np.int64)
    else:
        end = first + count
        rows = (order_worst_first(columns, end) if kind == "meter" else np.arange(len(ids)))[first:end]
    picked = pick_rows(columns, rows)
    return {"total": len(ids), "rows": {"id": [ids[k] for k in rows.tolist()]} | _describe(picked, decimals)}


def _find_columns(tables: Tables, kind: str) -> tuple[Columns, str, Mapping[str, int]]:
    if kind == "meter":
        return tables.meters, "meter", METER
    table, key, decimals = (tables.buses, "bus", BUS) if kind == "bus" else (tables.branches, "branch", BRANCH)
    if table is None:
        return {}, key, decimals
    return {name: table[name] for name in table.columns}, key, decimals | (WITH_PHASES if _has_phases(table) else {})


def _has_phases(table: Table) -> bool:
    """True for rows that are nodes or conductors of a network with phases."""
    return not {*table.phase} <= {ALL_PHASES}


def _draw(table: Columns | Table, names: Mapping[str, int]) -> dict[str, Any]:
    known = {name: table[name] for name in names if not np.isnan(table[name]).all()}
    return _round(known, names) | {"fresh": table["fresh"].tolist()}


def _describe(columns: Columns, decimals: Mapping[str, int]) -> dict[str, Any]:
    """Columns of numbers, rounded, and columns of words and truth values."""
    plain = {name: columns[name] for name in WORDS if name in columns}
    return _round(columns, decimals) | {n: c.tolist() if isinstance(c, np.ndarray) else c for n, c in plain.items()}


def _round(columns: Columns, decimals: Mapping[str, int]) -> dict[str, Any]:
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: np.round(columns[name], n).tolist() for name, n in decimals.items() if name in columns}
