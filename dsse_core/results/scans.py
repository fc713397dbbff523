"""Tables of many scans of one grid: a row for each scan, and the rows of the other tables of all scans."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import ClassVar

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.batch import BatchResult
from dsse_core.grid.nodes import PhaseRows, name_node
from dsse_core.results.columns import ScanColumns, list_columns
from dsse_core.results.results import TABLES, Results, WithTables
from dsse_core.results.table import Table, as_times, name_phases

MOST_CELLS = 200_000_000  # of all tables together: 1.6 GB, twice while they are put together


@dataclass(frozen=True, repr=False)
class ScanTables(WithTables):
    """The tables. ``scans``: the end of each estimate. ``make_results``: function that makes the tables of each scan,
    in order; at the first use of one of them.
    """

    names: ClassVar = ("scans", *TABLES)
    scans: Table
    make_results: Callable[[], Iterable[Results]]

    def __repr__(self) -> str:
        failed = self.scans.status.count("failed")
        return f"<Estimates of {len(self.scans)} scans, {failed} failed>"

    def _shown(self) -> Table:
        return self.scans

    @cached_property
    def tables(self) -> Results:
        """The rows of all scans.

        Raises:
            InvalidInputError: they have more than MOST_CELLS.
        """
        by_name: dict[str, list[Table]] = {name: [] for name in TABLES}
        for number, results in enumerate(self.make_results()):
            for name, tables in by_name.items():
                tables.append(getattr(results, name))
            if number == 0:
                self._check_size([tables[0] for tables in by_name.values()])
        buses, branches, meters, areas = (_stack(name, by_name.pop(name)) for name in TABLES)
        return Results(buses, branches, lambda: meters, lambda: areas)

    def _check_size(self, of_one: Sequence[Table]) -> None:
        """Check by the tables of one scan that those of all have at most MOST_CELLS."""
        cells = len(self.scans) * sum(len(table) * len(table.columns) for table in of_one)
        if cells > MOST_CELLS:
            problem = f"their tables have {cells:,} cells, the limit is {MOST_CELLS:,}; divide the readings into files"
            raise InvalidInputError(f"{len(self.scans):,} scans", [f"{problem} of fewer scans"])


def _stack(title: str, tables: Sequence[Table]) -> Table:
    """The rows of ``tables``, which have the same columns, one table after the other."""
    columns = {}
    for name in tables[0].columns:
        parts = [table[name] for table in tables]
        is_text = isinstance(parts[0], tuple)
        columns[name] = tuple(chain.from_iterable(parts)) if is_text else np.concatenate(parts)
    return Table(title, columns)


def make_scan_table(
    names: Sequence[str],
    times: np.ndarray,
    batch: BatchResult,
    limits: np.ndarray,
    readings: np.ndarray,
    removed: Mapping[int, Sequence[str]],
    undecided: Mapping[int, Sequence[str]],
    switched: Mapping[int, Sequence[str]],
    bad_data_left: np.ndarray,
) -> Table:
    """The table of the scans in ``batch``.

    ``names``: of the rows of ``batch``. (n_row,) each: ``times``, s since 1970 or nan, ``limits`` of J, the number of
    ``readings``, and ``bad_data_left``. ``removed``: row -> ids of the meters taken out; ``undecided``: row -> ids of
    the meters that the readings do not tell from those. ``switched``: row -> ids of the switches that count the other
    way.
    """
    rows, table = np.arange(len(batch.vm)), batch.plan.network.table
    nodes, bus = table.nodes, table.bus_id[table.nodes.item]
    is_known = ~(np.isnan(batch.vm) | batch.plan.network.is_dead)
    found, failures = is_known.any(axis=1), batch.failures
    lowest = np.argmin(np.where(is_known, batch.vm, np.inf), axis=1)
    highest = np.argmax(np.where(is_known, batch.vm, -np.inf), axis=1)
    columns = ScanColumns(
        scan=names,
        time=as_times(times),
        status=["failed" if row in failures else "estimated" for row in rows.tolist()],
        readings=readings,
        objective=batch.objective,
        degrees_of_freedom=batch.degrees_of_freedom,
        chi_square_limit=limits,
        iterations=batch.iterations,
        removed=np.array([len(removed.get(row, ())) for row in rows.tolist()], dtype=np.int64),
        removed_meters=[" ".join(removed.get(row, ())) for row in rows.tolist()],
        undecided_meters=[" ".join(undecided.get(row, ())) for row in rows.tolist()],
        switched=[" ".join(switched.get(row, ())) for row in rows.tolist()],
        bad_data_left=bad_data_left,
        lowest_vm_pu=batch.vm[rows, lowest],
        lowest_vm_bus=np.where(found, bus[lowest], np.nan),
        lowest_vm_phase=_name_phases(nodes, found, lowest),
        highest_vm_pu=batch.vm[rows, highest],
        highest_vm_bus=np.where(found, bus[highest], np.nan),
        highest_vm_phase=_name_phases(nodes, found, highest),
        failure=[str(failures[row].code) if row in failures else "" for row in rows.tolist()],
        reason=[failures[row].text if row in failures else "" for row in rows.tolist()],
    )
    return Table("scans", list_columns(columns))


def name_lowest(scans: Table, row: int) -> str:
    """The node of the lowest voltage of a row of the table of scans, such as 652.a, or 18; "" where there is none."""
    if np.isnan(scans.lowest_vm_bus[row]):
        return ""
    phase = scans.lowest_vm_phase[row] if "lowest_vm_phase" in scans.columns else ""
    return name_node(int(scans.lowest_vm_bus[row]), phase)


def _name_phases(nodes: PhaseRows, found: np.ndarray, node: np.ndarray) -> list[str] | None:
    """The phase of each ``node`` (n,), "" where there is none ``found``; None in a balanced network."""
    if nodes.is_balanced:
        return None
    return [phase if there else "" for phase, there in zip(name_phases(nodes.phase[node]), found.tolist(), strict=True)]
