"""The table of branches, a row a conductor: powers and currents at both ends, losses, loading."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dsse_core.grid.columns import read_given
from dsse_core.grid.network import Network
from dsse_core.results.columns import BranchColumns, list_columns
from dsse_core.results.flows import BranchModel, Flows
from dsse_core.results.state import EstimatedTap, GridState
from dsse_core.results.table import IN_ONE_PLACE, NO_SCAN, ScanLabel, Table, mark_rows, name_phases
from dsse_core.results.units import base_a, base_kw

QUANTITIES = (
    "p_from_kw",
    "q_from_kvar",
    "i_from_a",
    "p_to_kw",
    "q_to_kvar",
    "i_to_a",
    "loss_kw",
    "loss_kvar",
)
"""Columns that have a standard deviation beside them, in the order of ``BranchSigmas``."""


def make_branch_table(
    state: GridState,
    sigmas: np.ndarray | None = None,
    label: ScanLabel = NO_SCAN,
    marks: Mapping[str, Any] | None = None,
) -> Table:
    """One row per conductor of the branches of ``state``; branches out of service are included and carry nothing.

    Powers and currents are positive into the branch at either end; a loss is the sum of the powers at both ends,
    charging included. ``loading_percent``: the larger current of the two ends by ``i_max``, or the larger apparent
    power by ``s_max``; nan where neither is known. ``sigmas`` (8, n_row): standard deviations of ``QUANTITIES``,
    p.u.; nan without them. ``label``: of the scan. ``marks``: the columns of ``mark_rows``.
    """
    network, branches, flows = state.network, state.branches, state.flows
    kw, table, count = base_kw(network), network.table, len(branches.branch)
    a_from, a_to = base_a(network)[table.end_rows[:, branches.branch]]
    powers = flows.s_from * kw, flows.s_to * kw, flows.loss * kw
    names, of_branch = list(read_given(network.branches, "name")), branches.branch.tolist()
    values = [
        powers[0].real,
        powers[0].imag,
        abs(flows.i_from) * a_from,
        powers[1].real,
        powers[1].imag,
        abs(flows.i_to) * a_to,
        powers[2].real,
        powers[2].imag,
    ]
    deviations = np.full((len(QUANTITIES), count), np.nan) if sigmas is None else np.array(sigmas)
    for end, at_end in ((branches.f, slice(3)), (branches.t, slice(3, 6))):
        for column in (*values[at_end], *deviations[at_end]):
            column[end < 0] = np.nan
    ones = np.ones(count)
    units = [kw * ones, kw * ones, a_from, kw * ones, kw * ones, a_to, kw * ones, kw * ones]
    scan, time = label.columns(count)
    columns = BranchColumns(
        branch=[network.branch_ids[k] for k in of_branch],
        name=[names[k] for k in of_branch] if names else [""] * count,
        from_bus=table.from_bus[branches.branch],
        to_bus=table.to_bus[branches.branch],
        phase=name_phases(branches.phase),
        in_service=branches.in_service,
        **dict(zip(QUANTITIES, values, strict=True)),
        loading_percent=find_loading(branches, flows),
        neutral_a=None if table.nodes.is_balanced else abs(_sum_over_phases(branches, flows.i_from)) * a_from,
        **_list_taps(state),
        **{f"sigma_{q}": s * u for q, s, u in zip(QUANTITIES, deviations, units, strict=True)},
        scan=scan,
        time=time,
        **(marks or mark_rows([IN_ONE_PLACE], np.zeros(count, dtype=np.int64))),
    )
    return Table("branches", list_columns(columns))


def _list_taps(state: GridState) -> dict[str, Any]:
    """The columns of estimated taps; none without any."""
    if not state.network.estimated_taps:
        return {}
    unknown = EstimatedTap(math.nan, math.nan, math.nan)
    found = [state.taps.get(state.network.branch_ids[k], unknown) for k in state.branches.branch.tolist()]
    ratio, sigma, steps = np.array(found).T
    return {"tap_ratio": ratio, "sigma_tap_ratio": sigma, "tap_steps_off": np.round(steps) + 0.0}


def _sum_over_phases(branches: BranchModel, values: np.ndarray) -> np.ndarray:
    """The sum of the complex ``values`` of all conductors of each one's branch, (n_row,)."""
    of_branch = np.bincount(branches.branch, values.real) + 1j * np.bincount(branches.branch, values.imag)
    return np.asarray(of_branch[branches.branch])


def find_loading(branches: BranchModel, flows: Flows) -> np.ndarray:
    """Current or apparent power by its rating, percent, (n_row,); nan where no rating is known."""
    i_max, s_max = (_read_ratings(branches.network, key)[branches.branch] for key in ("i_max", "s_max"))
    current = np.maximum(abs(flows.i_from), abs(flows.i_to)) / i_max
    power = np.maximum(abs(flows.s_from), abs(flows.s_to)) / s_max
    return np.asarray(100.0 * np.fmax(current, power))


def _read_ratings(network: Network, key: str) -> np.ndarray:
    """The ratings of all branches, p.u., (n_branch,); nan where there is none."""
    given = [np.nan if rating is None else rating for rating in read_given(network.branches, key)]
    return np.array(given or np.full(len(network.branches), np.nan), dtype=float)
