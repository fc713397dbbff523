"""Meters column by column, and meters made of columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.columns import Records, rows_of_texts
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.network import Network

KINDS, SOURCES = tuple(MeasurementKind), tuple(Source)
NO_BRANCH, UNKNOWN = -2, -1
_CODE_OF_KIND = {id(kind): k for k, kind in enumerate(KINDS)}  # members are singletons, and hashing them takes long


@dataclass(frozen=True)
class MeterTable:
    """Shape (n_meas,) each. ``kind``: position in KINDS. ``bus``: row of the bus, UNKNOWN where the network has none
    such. ``branch``: its row among those in service; UNKNOWN, or NO_BRANCH of a meter at a bus."""

    kind: np.ndarray
    bus: np.ndarray
    branch: np.ndarray


def make_meters(
    network: Network, kind: np.ndarray, bus: np.ndarray, branch: np.ndarray, source: np.ndarray | None = None
) -> Records[Meter]:
    """Meters of ``network`` from columns (n_meas,), in which a plan finds what it needs without visiting any.

    Args:
        kind: positions in KINDS.
        bus: ids of buses.
        branch: rows of ``network.branches``, NO_BRANCH of a meter at a bus.
        source: positions in SOURCES; all telemetered by default.
    """
    if source is None:
        source = np.zeros(len(kind), dtype=np.int64)
    columns = {"kind": kind, "bus": bus, "branch": branch, "source": source}
    return Records(_MakeMeter(network.branch_ids), columns)


@dataclass(frozen=True)
class _MakeMeter:
    """A meter of its row of the columns."""

    branch_ids: Sequence[str]

    def __call__(self, kind: int, bus: int, branch: int, source: int) -> Meter:
        return Meter(KINDS[kind], bus, None if branch < 0 else self.branch_ids[branch], SOURCES[source])


def tabulate_meters(network: Network, meters: Sequence[Meter]) -> MeterTable:
    """The columns of ``meters`` in ``network``."""
    table = network.table
    if isinstance(meters, Records):
        columns = meters.columns
        row = np.append(table.active_row, NO_BRANCH)  # which row -1 is
        return MeterTable(columns["kind"], table.rows.find(columns["bus"]), row[np.maximum(columns["branch"], -1)])
    bus = np.array([meter.bus for meter in meters], dtype=np.int64)
    branch = rows_of_texts(network.active_branch_ids, [meter.branch for meter in meters])
    return MeterTable(number_kinds(meters), table.rows.find(bus), branch)


def number_kinds(meters: Sequence[Meter]) -> np.ndarray:
    """The position of each meter's kind in KINDS, shape (n_meas,)."""
    if isinstance(meters, Records):
        kinds: np.ndarray = meters.columns["kind"]
        return kinds
    return np.array([_CODE_OF_KIND[id(meter.kind)] for meter in meters], dtype=np.int64)


def find_virtual(meters: Sequence[Meter]) -> np.ndarray:
    """Which of ``meters`` are virtual, shape (n_meas,)."""
    if isinstance(meters, Records):
        virtual: np.ndarray = meters.columns["source"] == SOURCES.index(Source.VIRTUAL)
        return virtual
    return np.array([meter.source is Source.VIRTUAL for meter in meters], dtype=bool)
