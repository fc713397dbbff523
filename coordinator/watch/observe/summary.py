"""Summary of a grid at one moment, for tiles, lines and metrics: its numbers of the present beside their limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from coordinator.watch.observe.grid_tables import OFF, REMOVED, SILENT, UNKNOWN, GridTables, Tables
from coordinator.watch.observe.view import Extreme
from dsse_core.estimation.state_limits import DEFAULT_OPERATING_LIMITS, OperatingLimits
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import read_phases
from dsse_core.results.columns import find_first_rows
from dsse_core.results.table import ALL_PHASES, Table, name_by_phase

MOST_WORST = 4  # violations of one limit that are named
UNUSED = (REMOVED, SILENT, OFF, UNKNOWN)  # meters without an influence on the estimate


@dataclass(frozen=True, slots=True)
class Extent:
    """A quantity over the grid: ``known`` of ``total`` numbers are fresh, ``outside`` of these exceed a limit.

    ``worst``: the first ``MOST_WORST`` of those outside, the farthest first.
    """

    known: int = 0
    total: int = 0
    outside: int = 0
    worst: tuple[Extreme, ...] = ()
    lowest: Extreme | None = None
    highest: Extreme | None = None


@dataclass(frozen=True, slots=True)
class Power:
    """A sum over the ``known`` of ``total`` parts; None where no part is known."""

    known: int = 0
    total: int = 0
    p_kw: float | None = None
    q_kvar: float | None = None


@dataclass(frozen=True, slots=True)
class Summary:
    """Voltage of buses in p.u., loading in percent and current in A of branches in service, normalised residuals of
    meters in use; powers: injection of the substation, losses, loads and generation of the other buses by the sign of
    their injections. ``limits``: of operation. Only voltage and residual are known without a scenario. ``has_phases``:
    the voltages are those of nodes, such as 671.a, and branches count by their conductors, such as 632-671.a;
    ``unbalance``: of three-phase buses, percent.
    """

    voltage: Extent
    residual: Extent
    loading: Extent = Extent()
    current: Extent = Extent()
    head: Power = Power()
    loss: Power = Power()
    load: Power = Power()
    generation: Power = Power()
    limits: OperatingLimits = DEFAULT_OPERATING_LIMITS
    has_phases: bool = False
    unbalance: Extent = Extent()


def summarise(tables: Tables, known: GridTables | None) -> Summary:
    """The summary of ``tables``, with the limits of operation of the scenario if its grid is ``known``."""
    limits = known.scenario.operating_limits if known else DEFAULT_OPERATING_LIMITS
    voltage, residual = _find_voltage(tables.buses, limits), _find_residual(tables.meters, limits)
    if known is None or tables.branches is None:
        return Summary(voltage, residual, limits=limits, has_phases=not {*tables.buses.phase} <= {ALL_PHASES})
    buses, branches = tables.buses, tables.branches
    ids, fresh, used = name_by_phase(branches.branch, branches.phase), branches.fresh, branches.in_service
    rated = used & known.is_rated
    current = np.fmax(branches.i_from_a, branches.i_to_a)
    slack = known.scenario.network.slack
    at_head = buses.bus == slack.bus if slack else np.zeros(len(buses), dtype=bool)
    p, q = np.where(buses.fresh, [buses.p_kw, buses.q_kvar], np.nan)
    elsewhere, loss = ~at_head, np.where(fresh, [branches.loss_kw, branches.loss_kvar], np.nan)
    return Summary(
        voltage,
        residual,
        _find_extent(ids.__getitem__, branches.loading_percent, fresh, rated, high=limits.most_loading_percent),
        _find_extent(ids.__getitem__, current, fresh, used),
        head=_add_up(p, q, at_head),
        loss=_add_up(loss[0], loss[1], used),
        load=_add_up(np.maximum(-p, 0.0), np.maximum(-q, 0.0), elsewhere),
        generation=_add_up(np.maximum(p, 0.0), np.maximum(q, 0.0), elsewhere),
        limits=limits,
        has_phases=not known.scenario.network.table.nodes.is_balanced,
        unbalance=_find_unbalance(buses, known.scenario.network, limits),
    )


def _find_voltage(buses: Table, limits: OperatingLimits) -> Extent:
    """Extent of the voltages of nodes with a path to ground; of a node that several areas show, a fresh one counts."""
    number = {phase: k for k, phase in enumerate(dict.fromkeys(buses.phase))}
    node = buses.bus * len(number) + np.array([number[phase] for phase in buses.phase], dtype=np.int64)
    order = np.argsort(~buses.fresh, kind="stable")
    at = order[np.unique(node[order], return_index=True)[1]]
    every = buses.grounded[at] if "grounded" in buses.columns else np.ones(len(at), dtype=bool)
    every = every & (buses.vm_pu[at] != 0.0)  # without supply
    band = limits.lowest_vm, limits.highest_vm

    def name(k: int) -> str:
        return name_by_phase([str(buses.bus[at[k]])], [buses.phase[at[k]]])[0]

    return _find_extent(name, buses.vm_pu[at], buses.fresh[at], every, *band)


def _find_unbalance(buses: Table, network: Network, limits: OperatingLimits) -> Extent:
    """Extent of the unbalance of buses with the phases a, b and c, of which each counts once."""
    if "unbalance_percent" not in buses.columns:
        return Extent()
    nodes, three = network.table.nodes, read_phases(["abc"])
    every = find_first_rows(buses.bus) & (nodes.sets & three == three)[nodes.item]
    most = limits.most_unbalance_percent
    return _find_extent(lambda k: str(buses.bus[k]), buses.unbalance_percent, buses.fresh, every, high=most)


def _find_residual(meters: dict[str, Any], limits: OperatingLimits) -> Extent:
    used = np.array([status not in UNUSED for status in meters["status"]], dtype=bool)
    return _find_extent(
        meters["meter"].__getitem__, meters["normalised_residual"], meters["fresh"], used, high=limits.most_residual
    )


def _find_extent(
    name: Callable[[int], str],
    values: np.ndarray,
    fresh: np.ndarray,
    counted: np.ndarray,
    low: float = -np.inf,
    high: float = np.inf,
) -> Extent:
    """Extent of ``values`` (n,) of the rows that are ``counted``, of which those ``fresh`` and not nan are known.

    ``name``: of a row.
    """
    rows = np.flatnonzero(counted & fresh & ~np.isnan(values))
    total = int(counted.sum())
    if not rows.size:
        return Extent(0, total)
    known = values[rows]
    far = np.maximum(known - high, low - known)
    outside = np.flatnonzero(far > 0)
    worst = outside[np.argsort(-far[outside], kind="stable")][:MOST_WORST]

    def at(k: int) -> Extreme:
        return Extreme(float(known[k]), name(int(rows[k])))

    ends = at(int(known.argmin())), at(int(known.argmax()))
    return Extent(len(rows), total, len(outside), tuple(at(k) for k in worst.tolist()), *ends)


def _add_up(p: np.ndarray, q: np.ndarray, parts: np.ndarray) -> Power:
    """Sums over the known ``parts``."""
    rows = parts & ~np.isnan(p)
    known, total = int(rows.sum()), int(parts.sum())
    return Power(known, total, float(p[rows].sum()), float(q[rows].sum())) if known else Power(0, total)
