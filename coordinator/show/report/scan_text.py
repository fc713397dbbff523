"""Plain text of the command line for many scans of one grid."""

from __future__ import annotations

from coordinator.lab.evaluation.scan_estimates import ScanEstimates
from coordinator.watch.tables.text_table import format_table
from dsse_core.printable import shortened
from dsse_core.results.scans import ScanTables

LONGEST_LIST = 40
HEADER = ("scan", "readings", "J", "limit", "iterations", "lowest vm p.u.", "at bus", "removed as bad data")


def format_scans(found: ScanEstimates, tables: ScanTables) -> str:
    """A line for each estimated scan, a total, then a line for each failed scan with the reason."""
    scans = tables.scans
    rows = []
    for k in range(len(scans)):
        if scans.status[k] == "failed":
            continue
        left = " and more is detected" if scans.bad_data_left[k] else ""
        left = f" (or {shortened(others, LONGEST_LIST)})" + left if (others := scans.undecided_meters[k]) else left
        removed = f"{shortened(scans.removed_meters[k], LONGEST_LIST)}{left}" or "-"
        numbers = f"{scans.objective[k]:.4g}", f"{scans.chi_square_limit[k]:.4g}", str(scans.iterations[k])
        lowest = f"{scans.lowest_vm_pu[k]:.5f}", str(int(scans.lowest_vm_bus[k]))
        rows.append([scans.scan[k], str(scans.readings[k]), *numbers, *lowest, removed])
    total = f"{len(rows)} of {len(scans)} scans estimated, back end {found.batch.plan.backend}"
    failures = [f"no estimate of {failure}" for failure in found.describe_failures()]
    return "\n".join([*([format_table(HEADER, rows), ""] if rows else []), total, *failures])
