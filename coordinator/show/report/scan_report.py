"""``report.html`` of many scans: time series, bands of the profile, meters removed most, quality over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from coordinator.show.figures.run_figures import save_figures
from coordinator.show.figures.scan_figures import ScanSeries, draw_scans
from coordinator.show.report.page import MAX_ROWS, Page, PageTable, write_page
from coordinator.show.report.settings import find_origin
from dsse_core.results.meters import REMOVED
from dsse_core.results.scans import ScanTables, name_lowest
from dsse_core.results.table import name_by_phase
from scenarios.scenario import Scenario

FOUND = ("voltages", "quality")  # figures whose captions stand among the findings


def write_scan_report(
    folder: Path, scenario: Scenario, tables: ScanTables, formats: Sequence[str], arguments: Sequence[str]
) -> None:
    """Writes report and figures, in each of ``formats``, into ``folder``. ``arguments``: of the command ``dsse``.

    Raises:
        OSError: a file cannot be written.
    """
    page = make_scan_page(ScanSeries(scenario, tables), arguments)
    write_page(page, folder)
    save_figures(page.drawings, folder, formats)


def make_scan_page(course: ScanSeries, arguments: Sequence[str]) -> Page:
    """The content of the report. ``arguments``: of the command ``dsse``."""
    scans, scenario, drawings = course.tables.scans, course.scenario, draw_scans(course)
    failed = [k for k, status in enumerate(scans.status) if status == "failed"]
    return Page(
        title=f"{scenario.name}: {len(scans)} scans",
        subtitle=f"{len(course.network.buses)} buses, from {course.name_of(0)} to {course.name_of(len(scans) - 1)}",
        outcome=f"{len(scans) - len(failed)} of {len(scans)} scans estimated",
        good=not failed,
        reasons=[f"no estimate of scan {course.name_of(k)}: {scans.reason[k]}" for k in failed[:MAX_ROWS]],
        findings=[drawing.caption for drawing in drawings if drawing.name in FOUND],
        tables=[PageTable("Meters removed most", *_list_removed(course))] if course.removals else [],
        drawings=drawings,
        more_tables=list(_list_tables(course)),
        origin=find_origin(scenario, arguments),
    )


def _list_removed(course: ScanSeries) -> tuple[Sequence[str], Sequence[Sequence[str]]]:
    """Header and rows: each removed meter, with the scans of its removals."""
    meters = course.tables.meters
    rows_of: dict[str, list[int]] = {}
    for row, (meter, status) in enumerate(zip(meters.meter, meters.status, strict=True)):
        if status == REMOVED:
            rows_of.setdefault(meter, []).append(row)
    rows = []
    for meter, count in course.removals.most_common(MAX_ROWS):
        of, share = rows_of[meter], count / len(course.tables.scans)
        largest = np.max(meters.normalised_residual[of])
        numbers = str(count), f"{100 * share:.1f}", f"{largest:.2f}"
        rows.append((meter, *numbers, meters.scan[of[0]], meters.scan[of[-1]]))
    return ("meter", "scans", "share (%)", "largest normalised residual", "first scan", "last scan"), rows


def _list_tables(course: ScanSeries) -> Iterator[PageTable]:
    buses, branches, scans = course.tables.buses, course.tables.branches, course.tables.scans
    nodes = course.network.node_names
    yield _sum_up("Voltages of the buses (p.u.)", "bus", nodes, course.by_scan(buses, "vm_pu"), ".5f", course)
    used = course.by_scan(branches, "in_service")[0]
    of_one_scan = branches.branch[: len(used)], branches.phase[: len(used)]
    names = [name for name, is_used in zip(name_by_phase(*of_one_scan), used.tolist(), strict=True) if is_used]
    current = np.fmax(course.by_scan(branches, "i_from_a"), course.by_scan(branches, "i_to_a"))[:, used]
    yield _sum_up("Currents of the branches (A)", "branch", names, current, ".2f", course)
    loading = course.by_scan(branches, "loading_percent")[:, used]
    if not np.isnan(loading).all():
        yield _sum_up("Loading of the branches (%)", "branch", names, loading, ".1f", course)
    header = ("scan", "status", "readings", "J", "limit", "removed", "lowest vm (p.u.)", "at bus", "removed meters")
    rows = [
        (
            course.name_of(k), scans.status[k], str(scans.readings[k]), _write(scans.objective[k], ".4g"),
            _write(scans.chi_square_limit[k], ".4g"), str(scans.removed[k]), _write(scans.lowest_vm_pu[k], ".5f"),
            name_lowest(scans, k), scans.removed_meters[k],
        )
        for k in range(min(len(scans), MAX_ROWS))
    ]  # fmt: skip
    yield PageTable(f"Scans ({len(scans)})", header, rows, "All of them: scans.csv.", max(0, len(scans) - MAX_ROWS))


def _sum_up(title: str, what: str, names: Sequence[str], values: np.ndarray, form: str, of: ScanSeries) -> PageTable:
    """Extremes with their scans and mean of each column of ``values`` (n_scan, n); ``names``: of the columns."""
    rows = []
    for k, name in enumerate(names[:MAX_ROWS]):
        column = values[:, k]
        if np.isnan(column).all():
            continue
        low, high = int(np.nanargmin(column)), int(np.nanargmax(column))
        numbers = [_write(value, form) for value in (column[low], np.nanmean(column), column[high])]
        rows.append((name, numbers[0], of.name_of(low), numbers[1], numbers[2], of.name_of(high)))
    header = (what, "lowest", "in scan", "mean", "highest", "in scan")
    return PageTable(title, header, rows, left_out=max(0, len(names) - MAX_ROWS))


def _write(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)
