"""Comparison of the decentralised states with the centralised estimate and the truth, by node and by area."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from agents.messages.packing import StateMessage
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.partition import Partition
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.results.state import AreaVoltages
from dsse_core.results.table import NO_SCAN, ScanLabel
from dsse_core.results.units import wrap_degrees


@dataclass(frozen=True, slots=True, repr=False)
class Voltages:
    """``vm`` p.u., ``va`` rad: shape (n_nodes,), network order; nan where not known."""

    vm: np.ndarray
    va: np.ndarray

    def __repr__(self) -> str:
        return f"<Voltages of {len(self.vm)} nodes, {np.isnan(self.vm).sum()} unknown>"


@dataclass(frozen=True, slots=True)
class Gap:
    """The largest difference of two sets of voltages, p.u. and degrees; None where one of them is incomplete."""

    vm_pu: float | None
    va_deg: float | None


@dataclass(frozen=True, repr=False)
class Comparison:
    """Voltages of all nodes from three sources, and their differences.

    ``decentralised`` takes each node from the area that owns its bus. ``gap`` is to the centralised estimate of the
    same telemetry, ``error`` to the truth; those per area run over every node that the area sees. ``sigma``: standard
    deviations by the owners. ``published``: the voltages of areas with an estimate, relative angles included.
    ``label``: newest scan of the states, and the newest time to which ages of its readings count.
    """

    partition: Partition
    truth: Voltages
    centralised: Voltages
    decentralised: Voltages
    sigma: Voltages
    by_area: Mapping[str, Voltages]
    published: Mapping[str, AreaVoltages]
    label: ScanLabel = NO_SCAN

    def __repr__(self) -> str:
        buses, areas = len(self.partition.network.buses), len(self.published)
        return f"<Comparison of {buses} buses: states of {areas} of {len(self.partition.areas)} areas>"

    @property
    def knows_truth(self) -> bool:
        """True where there is a truth to compare with; the readings of a file have none."""
        return not np.isnan(self.truth.vm).all()

    @property
    def gap(self) -> Gap:
        return largest_gap(self.decentralised, self.centralised)

    @property
    def gap_at(self) -> str | None:
        """The name of the node with the largest gap, in p.u. or rad; None where no gap is known."""
        one, other, network = self.decentralised, self.centralised, self.partition.network
        size = np.fmax(abs(one.vm - other.vm), abs(np.radians(wrap_degrees(one.va - other.va))))
        if np.isnan(size).all():
            return None
        return network.node_names[int(np.nanargmax(size))]

    @property
    def error(self) -> Gap:
        return largest_gap(self.decentralised, self.truth)

    @property
    def centralised_error(self) -> Gap:
        return largest_gap(self.centralised, self.truth)

    def gap_of(self, area: str) -> Gap:
        return largest_gap(self.by_area[area], self._seen_by(area, self.centralised))

    def error_of(self, area: str) -> Gap:
        return largest_gap(self.by_area[area], self._seen_by(area, self.truth))

    def _seen_by(self, area: str, voltages: Voltages) -> Voltages:
        rows = rows_of(self.partition, area)
        return Voltages(voltages.vm[rows], voltages.va[rows])


def compare(
    partition: Partition,
    states: Mapping[str, StateMessage],
    truth: PowerFlowResult | None,
    centralised: BadDataReport | None,
) -> Comparison:
    """Compare the areas' published ``states`` with ``centralised`` and ``truth``.

    An unknown truth (None), a failed centralised estimate (None) and an area without estimate count as nan. So do the
    angles of an area whose angles do not count from the substation.
    """
    n, bus = partition.network.n_nodes, partition.network.table.nodes.item
    whole, sigma, unknown = (Voltages(np.full(n, np.nan), np.full(n, np.nan)) for _ in range(3))
    by_area = {}
    for k, area in enumerate(partition.areas):
        state = states.get(area.name)
        rows = rows_of(partition, area.name)
        by_area[area.name] = _published(state, len(rows))
        owned = partition.owner[bus[rows]] == k
        whole.vm[rows[owned]] = by_area[area.name].vm[owned]
        whole.va[rows[owned]] = by_area[area.name].va[owned]
        if state is not None and state.buses:
            sigma.vm[rows[owned]] = np.array(state.sigma_vm)[owned]
            if state.referenced:  # else they grow without limit, as angle 0 has no reference
                sigma.va[rows[owned]] = np.array(state.sigma_va)[owned]
    return Comparison(
        partition=partition,
        truth=Voltages(truth.vm, truth.va) if truth else unknown,
        centralised=Voltages(centralised.result.vm, centralised.result.va) if centralised else unknown,
        decentralised=whole,
        sigma=sigma,
        by_area=by_area,
        published={
            name: AreaVoltages(np.array(state.vm), np.array(state.va), state.referenced, state.header.scan, state.taps)
            for name, state in states.items()
            if state.buses
        },
        label=_label(states.values()),
    )


def _label(states: Collection[StateMessage]) -> ScanLabel:
    scan = max((state.header.scan for state in states), default=0)
    taken_at = max((state.taken_at for state in states if state.header.scan == scan), default=0.0)
    return ScanLabel(str(scan) if scan else "", taken_at or math.nan)


def _published(state: StateMessage | None, n: int) -> Voltages:
    if state is None or not state.buses:
        return Voltages(np.full(n, np.nan), np.full(n, np.nan))
    return Voltages(np.array(state.vm), np.array(state.va) if state.referenced else np.full(n, np.nan))


def rows_of(partition: Partition, area: str) -> np.ndarray:
    """Rows in the whole network of the nodes that ``area`` sees, in the area's order."""
    return partition.rows_of_nodes[area]


def largest_gap(one: Voltages, other: Voltages) -> Gap:
    """The largest absolute differences; None if any voltage is nan."""
    vm, va = abs(one.vm - other.vm).max(initial=0.0), abs(wrap_degrees(one.va - other.va)).max(initial=0.0)
    return Gap(None if np.isnan(vm) else float(vm), None if np.isnan(va) else float(va))
