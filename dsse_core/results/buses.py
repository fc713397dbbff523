"""The table of buses: voltages in p.u. and kV, angles in degrees, injections in kW and kvar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dsse_core.grid.columns import read_given
from dsse_core.results.columns import BusColumns
from dsse_core.results.state import GridState
from dsse_core.results.table import IN_ONE_PLACE, NO_SCAN, PHASE, ScanLabel, Table, mark_rows
from dsse_core.results.units import base_kv, base_kw, wrap_degrees

COMPARED = ("true", "centralised", "decentralised")
"""The voltages that stand beside each other, where they are known."""


def make_bus_table(
    state: GridState,
    areas: Sequence[str],
    compared: Mapping[str, tuple[np.ndarray, np.ndarray]],
    sigma_vm: np.ndarray,
    sigma_va: np.ndarray,
    sigma_injection: np.ndarray,
    label: ScanLabel = NO_SCAN,
    marks: Mapping[str, Any] | None = None,
) -> Table:
    """One row per bus. ``vm_pu``, ``va_deg``, ``p_kw``, ``q_kvar`` come from ``state``; powers are positive into the
    network.

    ``areas`` (n_bus,): the area that owns each bus. ``compared``: those of COMPARED that are known, vm and va (n_bus,),
    p.u. and rad. The standard deviations are in p.u. and rad, (n_bus,) and, of P and Q, (2, n_bus). ``label``: of the
    scan. ``marks``: the columns of ``mark_rows``.
    """
    network, n = state.network, len(state.vm)
    kv, kw, unknown = base_kv(network), base_kw(network), np.full(n, np.nan)
    voltages: dict[str, Any] = {}
    for which in COMPARED:
        vm, va = compared.get(which, (unknown, unknown))
        voltages |= {f"{which}_vm_pu": vm, f"{which}_va_deg": wrap_degrees(va)}
    scan, time = label.columns(n)
    columns = BusColumns(
        bus=network.table.bus_id,
        area=areas,
        **voltages,
        sigma_vm_pu=sigma_vm,
        sigma_va_deg=np.degrees(sigma_va),
        name=list(read_given(network.buses, "name")) or [""] * n,
        phase=[PHASE] * n,
        vm_pu=state.vm,
        va_deg=wrap_degrees(state.va),
        vm_kv=state.vm * kv,
        p_kw=state.injection.real * kw,
        q_kvar=state.injection.imag * kw,
        sigma_vm_kv=sigma_vm * kv,
        sigma_p_kw=sigma_injection[0] * kw,
        sigma_q_kvar=sigma_injection[1] * kw,
        scan=scan,
        time=time,
        **(marks or mark_rows([IN_ONE_PLACE], np.zeros(n, dtype=np.int64))),
    )
    return Table("buses", vars(columns))
