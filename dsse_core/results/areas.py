"""The table of areas: load, generation, losses, and the powers that come in over the boundaries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dsse_core.results.columns import AreaColumns
from dsse_core.results.state import GridState
from dsse_core.results.table import ALL_PHASES, IN_ONE_PLACE, NO_SCAN, Freshness, ScanLabel, Table, mark_rows
from dsse_core.results.totals import TOTALS, Division, find_totals
from dsse_core.results.units import base_kw

OF_A_RUN = (
    "gap_vm_pu",
    "gap_va_deg",
    "error_vm_pu",
    "error_va_deg",
    "exchanges",
    "messages",
    "bytes",
    "lost",
    "rejected",
    "objective",
    "degrees_of_freedom",
    "removed",
    "critical",
)
"""Figures of an area that only a run has, and then ``quality``."""


def make_area_table(
    state: GridState,
    division: Division,
    sigmas: np.ndarray | None = None,
    of_run: Mapping[str, np.ndarray] | None = None,
    marks: Sequence[Freshness] | None = None,
    label: ScanLabel = NO_SCAN,
) -> Table:
    """One row per area; ``of_run``: the columns OF_A_RUN. Balance: ``generation + import = load + loss``.

    A node that injects counts as generation with its injection, the substation too; one that draws counts as load. P
    and Q are sorted each by itself. ``loss``: of the area's branches with their charging, and of the shunts at its
    buses. ``import``: the power that comes from other areas over the boundary buses. A total is nan where a part of it
    is not known. ``sigmas`` (2, 4, n_area): standard deviations of P and Q of TOTALS, p.u.; nan without them.
    ``label``: of the scan. ``marks``: of each area.
    """
    kw, n, unknown = base_kw(state.network), len(division.names), np.full(len(division.names), np.nan)
    totals = _name_totals(find_totals(state, division) * kw)
    deviations = _name_totals(np.full((2, len(TOTALS), n), np.nan) if sigmas is None else sigmas * kw)
    scan, time = label.columns(n)
    of_areas = mark_rows(marks or [IN_ONE_PLACE] * n, np.arange(n))
    columns = AreaColumns(
        area=division.names,
        phase=[ALL_PHASES] * n,
        owned_buses=np.bincount(division.of_bus, minlength=n),
        **totals,
        **{key: (of_run or {}).get(key, unknown) for key in OF_A_RUN},
        quality=of_areas.pop("quality"),
        **{f"sigma_{name}": values for name, values in deviations.items()},
        scan=scan,
        time=time,
        **of_areas,
    )
    return Table("areas", vars(columns))


def _name_totals(values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of P and Q of TOTALS, (2, 4, n_area)."""
    units = zip(("kw", "kvar"), values, strict=True)
    named = {f"{what}_{unit}": row for unit, rows in units for what, row in zip(TOTALS, rows, strict=True)}
    return {f"{what}_{unit}": named[f"{what}_{unit}"] for what in TOTALS for unit in ("kw", "kvar")}
