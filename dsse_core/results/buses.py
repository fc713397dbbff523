"""The table of buses, a row a node: voltages in p.u. and kV, angles in degrees, injections in kW and kvar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dsse_core.grid.columns import read_given
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import PHASES
from dsse_core.results.columns import BusColumns, list_columns
from dsse_core.results.state import GridState
from dsse_core.results.table import IN_ONE_PLACE, NO_SCAN, ScanLabel, Table, mark_rows, name_phases
from dsse_core.results.units import base_kv, base_kw, wrap_degrees

COMPARED = ("true", "centralised", "decentralised")
"""The voltages that stand beside each other, where they are known."""
A, B, C = (PHASES.index(phase) for phase in "abc")
TURN = np.exp(2j * np.pi / 3)


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
    """One row per node. ``vm_pu``, ``va_deg``, ``p_kw``, ``q_kvar`` come from ``state``; powers are positive into the
    network.

    ``areas`` (n_nodes,): the area that owns each node. ``compared``: those of COMPARED that are known, vm and va
    (n_nodes,), p.u. and rad. The standard deviations are in p.u. and rad, (n_nodes,) and, of P and Q, (2, n_nodes).
    ``label``: of the scan. ``marks``: the columns of ``mark_rows``.
    """
    network, n = state.network, len(state.vm)
    nodes, names = network.table.nodes, list(read_given(network.buses, "name"))
    kv, kw, unknown = base_kv(network), base_kw(network), np.full(n, np.nan)
    grounded = ~np.isin(network.table.bus_id, network.gauge.ungrounded)[nodes.item]
    sigma_vm, sigma_va = (np.where(grounded, sigma, np.nan) for sigma in (sigma_vm, sigma_va))
    sigma_injection = np.where(grounded, sigma_injection, np.nan)
    voltages: dict[str, Any] = {}
    for which in COMPARED:
        vm, va = compared.get(which, (unknown, unknown))
        voltages |= {f"{which}_vm_pu": vm, f"{which}_va_deg": wrap_degrees(va)}
    scan, time = label.columns(n)
    columns = BusColumns(
        bus=network.table.bus_id[nodes.item],
        area=areas,
        **voltages,
        sigma_vm_pu=sigma_vm,
        sigma_va_deg=np.degrees(sigma_va),
        name=[names[k] for k in nodes.item.tolist()] if names else [""] * n,
        phase=name_phases(nodes.phase),
        vm_pu=state.vm,
        va_deg=wrap_degrees(state.va),
        vm_kv=state.vm * kv,
        p_kw=state.injection.real * kw,
        q_kvar=state.injection.imag * kw,
        grounded=None if nodes.is_balanced else grounded,
        unbalance_percent=None if nodes.is_balanced else _find_unbalance(network, state.vm, state.va),
        sigma_vm_kv=sigma_vm * kv,
        sigma_p_kw=sigma_injection[0] * kw,
        sigma_q_kvar=sigma_injection[1] * kw,
        scan=scan,
        time=time,
        **(marks or mark_rows([IN_ONE_PLACE], np.zeros(n, dtype=np.int64))),
    )
    return Table("buses", list_columns(columns))


def _find_unbalance(network: Network, vm: np.ndarray, va: np.ndarray) -> np.ndarray:
    """The negative by the positive sequence of the voltages of each node's bus, percent, (n_nodes,).

    Nan at buses where not all of a, b and c are there and live.
    """
    nodes, v = network.table.nodes, np.append(np.where(vm == 0.0, np.nan, vm * np.exp(1j * va)), np.nan)
    bus = np.arange(len(nodes.sets))
    a, b, c = (v[nodes.find(bus, phase)] for phase in (A, B, C))  # the last one stands for no node
    unbalance = abs(a + TURN**2 * b + TURN * c) / abs(a + TURN * b + TURN**2 * c)
    return np.asarray(100.0 * unbalance[nodes.item])
