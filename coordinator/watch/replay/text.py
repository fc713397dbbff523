"""The result of a replay as text."""

from __future__ import annotations

import numpy as np

from coordinator.watch.replay.replay import MOST_NAMED, TOLERANCE, Comparison
from dsse_core.printable import listed


def format_replay(found: Comparison, where: str, wall_s: float) -> str:
    """Lines on the scans played on the stage ``where``, their differences from the record, and the scans left out."""
    scans = f"{found.scans} of {found.scans + len(found.left_out)} scans" if found.left_out else f"{found.scans} scans"
    lines = [f"{scans} played on {where} in {wall_s:.1f} s, {found.compared} good states compared"]
    played = "" if found.is_whole else " of the scans that were played"
    if not found.compared:
        lines.append("no good state is recorded of them, so that nothing was compared")
    elif found.agrees and not found.unequal:
        lines.append(f"all states{played} are those that were recorded, to the bit")
    else:
        words = f"within {TOLERANCE:g}" if found.agrees else "DIFFERENT"
        lines.append(f"{words} p.u. and rad: {_describe(found.largest)}")
    if found.not_good:
        others = f"{found.not_good} states were not good when they were recorded"
        lines.append(f"{others}; they rest on more than readings: {_describe(found.of_others)}")
    if found.missing:
        names = [f"{area} in {scan}" for scan, area in found.missing]
        lines.append(f"not found again: {listed(names, MOST_NAMED)}")
    notes = [*found.describe_left_out(), *found.notes]
    return "\n".join([*lines, *(f"note: {text}" for text in notes)])


def _describe(differences: np.ndarray) -> str:
    vm, va, sigma_vm, sigma_va = differences
    return (
        f"largest difference of vm {vm:.3g} p.u., va {va:.3g} deg, their standard deviations {sigma_vm:.3g} p.u., "
        f"{sigma_va:.3g} deg"
    )
