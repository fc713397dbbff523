"""Tables of many scans of one grid: a row for each scan, and a row for each bus of each scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dsse_core.estimation.batch import BatchResult
from dsse_core.results.table import PHASE, Table
from dsse_core.results.units import base_kv, wrap_degrees


@dataclass(frozen=True)
class ScanTables:
    """The tables. ``scans``: the end of each estimate; ``buses``: its voltages, nan where there is no estimate."""

    names: ClassVar = ("scans", "buses")
    scans: Table
    buses: Table


def make_scan_tables(
    names: Sequence[str],
    batch: BatchResult,
    limits: np.ndarray,
    readings: np.ndarray,
    removed: Mapping[int, Sequence[str]],
    undecided: Mapping[int, Sequence[str]],
    bad_data_left: np.ndarray,
) -> ScanTables:
    """The tables of the scans in ``batch``.

    ``names``: of the rows of ``batch``. (n_row,) each: ``limits`` of J, the number of ``readings``, and
    ``bad_data_left``. ``removed``: row -> ids of the meters taken out; ``undecided``: row -> ids of the meters that the
    readings do not tell from those.
    """
    n_row, n = batch.vm.shape
    bus = batch.plan.network.table.bus_id
    found = ~np.isnan(batch.vm[:, 0])
    lowest = np.argmin(np.where(np.isnan(batch.vm), np.inf, batch.vm), axis=1)
    failures = batch.failures
    scans: dict[str, np.ndarray | Sequence[str]] = {
        "scan": names,
        "status": ["failed" if row in failures else "estimated" for row in range(n_row)],
        "readings": readings,
        "objective": batch.objective,
        "degrees_of_freedom": batch.degrees_of_freedom,
        "chi_square_limit": limits,
        "iterations": batch.iterations,
        "removed": np.array([len(removed.get(row, ())) for row in range(n_row)], dtype=np.int64),
        "removed_meters": [" ".join(removed.get(row, ())) for row in range(n_row)],
        "undecided_meters": [" ".join(undecided.get(row, ())) for row in range(n_row)],
        "bad_data_left": bad_data_left,
        "lowest_vm_pu": batch.vm[np.arange(n_row), lowest],
        "lowest_vm_bus": np.where(found, bus[lowest], np.nan),
        "failure": [str(failures[row].code) if row in failures else "" for row in range(n_row)],
        "reason": [failures[row].text if row in failures else "" for row in range(n_row)],
    }
    buses: dict[str, np.ndarray | Sequence[str]] = {
        "scan": [name for name in names for _ in range(n)],
        "bus": np.tile(bus, n_row),
        "phase": [PHASE] * (n_row * n),
        "vm_pu": batch.vm.ravel(),
        "va_deg": wrap_degrees(batch.va.ravel()),
        "vm_kv": (batch.vm * base_kv(batch.plan.network)).ravel(),
    }
    return ScanTables(Table("scans", scans), Table("buses of scans", buses))
