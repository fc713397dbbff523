"""Plain text of the command line for a whole grid: power flow, estimate, and many scans."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from coordinator.lab.evaluation.scan_estimates import ScanEstimates
from coordinator.show.report.number_cells import BLANK, place, write_fixed, write_significant, write_texts
from coordinator.show.report.phase_rows import show_by_site
from coordinator.watch.tables import format_table
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.estimation.residuals import describe_tap
from dsse_core.estimation.switches import describe_switches
from dsse_core.grid.gauge import describe_ungrounded
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.printable import all_printable, printable, shortened
from dsse_core.results.columns import find_first_rows
from dsse_core.results.results import Results
from dsse_core.results.scans import ScanTables, name_lowest
from dsse_core.results.table import Table, name_by_phase
from dsse_core.results.units import base_kw

LONGEST_LIST = 40
HEADER = ("scan", "readings", "J", "limit", "iterations", "lowest vm p.u.", "at bus", "removed as bad data")
LONGEST_NAME_SHOWN = 24
UNBALANCE = "V-/V+ %"
OF_WHOLE = ("neutral A", "loss kW")  # branch
SMALLEST_SHOWN = 1e-6  # kW, kvar, A


def _join_cells(header: Sequence[str], columns: Sequence[np.ndarray]) -> str:
    """Table with the layout of ``format_table``, of cells (width, n) of ``number_cells``, for up to a million rows."""
    widths = [max(len(name), len(column)) for name, column in zip(header, columns, strict=True)]
    padded = [name.rjust(width) for name, width in zip(header, widths, strict=True)]
    titles = "  ".join([header[0].ljust(widths[0]), *padded[1:]])
    n, kind = columns[0].shape[1], np.result_type(*columns)
    table, end = np.full((n, len(titles) + 1), ord(" "), dtype=kind), 0
    for k, (column, width) in enumerate(zip(columns, widths, strict=True)):
        first = end + (width - len(column) if k else 0)
        table[:, first : first + len(column)] = column.T
        end += width + 2
    table[:, -1] = ord("\n")
    body = table.tobytes().decode("ascii" if kind == np.uint8 else f"utf-32-{sys.byteorder[0]}e")
    return f"{titles.rstrip()}\n{body}".rstrip("\n")


def format_state(buses: Table, branches: Table) -> str:
    """Voltages and injections of all buses, and flows of the branches in service."""
    columns = [
        _name_rows(buses.bus, buses.phase, buses.name),
        write_fixed(buses.vm_pu, 5),
        write_significant(buses.vm_kv, 4),
        write_fixed(buses.va_deg, 4),
        _powers(buses.p_kw),
        _powers(buses.q_kvar),
        *_unbalance(buses),
    ]
    header = ("bus", "vm p.u.", "kV", "va deg", "injection kW", "kvar", UNBALANCE)
    of_buses = _join_cells(header[: len(columns)], columns)
    return f"{of_buses}{_remark_on(buses)}\n\n{_format_branches(branches)}"


def format_power_flow(result: PowerFlowResult, tables: Results) -> str:
    """Voltages and injections of all buses, flows of the branches in service, and the losses."""
    losses = result.losses * base_kw(result.network)
    steps = "backward and forward sweeps" if result.method == "sweep" else "Newton-Raphson steps"
    total = f"losses {_power(losses.real)} kW, {_power(losses.imag)} kvar; {result.iterations} {steps}"
    return f"{format_state(tables.buses, tables.branches)}\n\n{total}"


def format_estimate(report: BadDataReport, tables: Results) -> str:
    """The centralised estimate, beside the truth where it is known, flows of the branches, and its bad-data report."""
    buses = tables.buses
    with_truth = not np.isnan(buses.true_vm_pu).all()
    true = ("true",) if with_truth else ()
    columns = [
        _name_rows(buses.bus, buses.phase, buses.name),
        write_fixed(buses.vm_pu, 5),
        _sigmas(buses.sigma_vm_pu, 5),
        *([write_fixed(buses.true_vm_pu, 5)] if with_truth else ()),
        write_fixed(buses.va_deg, 4),
        _sigmas(buses.sigma_va_deg, 4),
        *([write_fixed(buses.true_va_deg, 4)] if with_truth else ()),
        *map(_powers, (buses.p_kw, buses.sigma_p_kw, buses.q_kvar, buses.sigma_q_kvar)),
        *_unbalance(buses),
    ]
    header = (
        "bus",
        "vm p.u.",
        "sigma",
        *true,
        "va deg",
        "sigma",
        *true,
        "injection kW",
        "sigma",
        "kvar",
        "sigma",
        UNBALANCE,
    )
    findings = "\n".join(map(printable, format_bad_data(report)))
    of_buses = _join_cells(header[: len(columns)], columns)
    of_branches = _format_branches(tables.branches), *_format_taps(tables.branches)
    return "\n\n".join([f"{of_buses}{_remark_on(buses)}", *of_branches, findings])


def _remark_on(buses: Table) -> str:
    """A line below the table of buses on those without path to ground, whose voltages have no standard deviation."""
    if "grounded" not in buses.columns or buses.grounded.all():
        return ""
    return f"\n{describe_ungrounded(np.unique(buses.bus[~buses.grounded]).tolist())}"


def _unbalance(buses: Table) -> Iterator[np.ndarray]:
    """The cells of the unbalance, once for each bus; nothing in balanced networks."""
    if "unbalance_percent" in buses.columns:
        yield _once(buses.unbalance_percent, find_first_rows(buses.bus))


def _once(values: np.ndarray, is_first: np.ndarray) -> np.ndarray:
    """The cells of ``values``, blank but in first rows."""
    cells = _powers(values)
    cells[:, ~is_first] = BLANK
    return cells


def _format_branches(branches: Table) -> str:
    """Flows at the from end, currents and losses of the branches in service, without columns known of no branch.

    Numbers of a whole branch with phases, losses among them, stand in its first row.
    """
    is_first, branches = find_first_rows(branches.branch), show_by_site(branches, "branch")
    larger = np.fmax(branches.i_from_a, branches.i_to_a)
    shown = {
        "P kW": branches.p_from_kw,
        "sigma P": branches.sigma_p_from_kw,
        "Q kvar": branches.q_from_kvar,
        "sigma Q": branches.sigma_q_from_kvar,
        "I A": larger,
        "sigma I": np.where(larger == branches.i_from_a, branches.sigma_i_from_a, branches.sigma_i_to_a),
        "neutral A": branches.neutral_a if "neutral_a" in branches.columns else np.full(len(branches), np.nan),
        "loss kW": branches.loss_kw,
        "loading %": branches.loading_percent,
    }
    used = branches.in_service
    known = {header: column[used] for header, column in shown.items() if not np.isnan(column[used]).all()}
    of_branches = _name_rows(branches.branch, branches.phase, branches.name)[:, used]
    cells = [
        _once(column, is_first[used]) if header in OF_WHOLE else _powers(column) for header, column in known.items()
    ]
    return _join_cells(["branch", *known], [of_branches, *cells])


def _format_taps(branches: Table) -> Iterator[str]:
    """A table of the estimated taps; nothing without any."""
    here = ~np.isnan(branches.tap_ratio) if "tap_ratio" in branches.columns else np.zeros(0, dtype=bool)
    if not here.any():
        return
    columns = (branches.tap_ratio, 5), (branches.sigma_tap_ratio, 5), (branches.tap_steps_off, 0)
    cells = [write_fixed(column[here], digits) for column, digits in columns]
    names = _name_rows(branches.branch, branches.phase, branches.name)[:, here]
    yield _join_cells(["branch", "tap ratio", "sigma", "steps off"], [names, *cells])


def _describe_backend(report: BadDataReport) -> str:
    """The back end that found the state, and the reason if it was not the compiled one."""
    radial = report.result.plan.radial
    return f"{report.result.backend}: {radial}" if isinstance(radial, str) else report.result.backend


def format_bad_data(report: BadDataReport) -> list[str]:
    """Lines on the chi-square test, the removed measurements, the bad data that remain, and the critical meters."""
    lines = [
        f"J = {report.objective:.4g} with {report.degrees_of_freedom} degrees of freedom, "
        f"limit {report.chi_square_limit:.4g}; {report.result.iterations} iterations, "
        f"back end {_describe_backend(report)}"
    ]
    for removed in report.removed:
        others = removed.indistinguishable_from
        lines.append(
            f"removed as bad data: {removed.measurement.meter} (normalised residual {removed.normalized_residual:.3g})"
            + (f"; the data cannot tell it from {', '.join(others)}" if others else "")
        )
    lines += [*describe_switches(report.switched, report.gains), *_describe_dead(report.result.network)]
    if report.detected:
        lines.append(f"bad data is still detected{_format_suspect(report)}")
    elif not (report.removed or report.switched):
        lines.append("no bad data detected")
    if report.n_without_variance:
        lines.append(
            f"no bad data identification by residuals for {report.n_without_variance} of {report.n_meters} meters: "
            "the variances of all residuals would take too long in a network with so many long loops; "
            "known are those of the largest weighted residuals"
        )
    if report.critical:
        lines.append(f"critical, their errors cannot be seen: {', '.join(report.critical)}")
    return lines


def _describe_dead(network: Network) -> Iterator[str]:
    """A line on places without supply; none where all are supplied."""
    if places := network.dead_places:
        opened = ", ".join(network.open_around_dead)
        yield f"without supply, shown as 0 p.u.: bus {', '.join(places)}; open around: {opened}"


def _format_suspect(report: BadDataReport) -> str:
    """Reason, for the end of a line, why bad data that are still detected were not removed."""
    if report.taps:
        return f": {'; '.join(describe_tap(branch, steps) for branch, steps in report.taps.items())}"
    if (suspect := report.suspect) is None:
        return ", but no normalised residual stands out"
    reason = {
        "critical": "without it the state is not determined",
        "diverges": "without it the estimate does not converge",
        "steps used up": "bad data are looked for no longer, as the steps of the scan are used up",
    }[suspect.reason]
    return f": {suspect.meter} has the largest normalised residual, {suspect.normalized_residual:.3g}, but {reason}"


def _name_rows(ids: Sequence[str] | np.ndarray, phases: Sequence[str], names: Sequence[str]) -> np.ndarray:
    """Labels of the rows of a table as cells: their ids with the phase, each with its name if it has one."""
    called = name_by_phase(list(map(str, ids.tolist())) if isinstance(ids, np.ndarray) else list(ids), phases)
    if any(names):
        short = (shortened(name, LONGEST_NAME_SHOWN) for name in names)
        called = [f"{of} {name}" if name else of for of, name in zip(called, short, strict=True)]
    return write_texts(all_printable(called))


def _powers(values: np.ndarray) -> np.ndarray:
    """Cells with the text of ``_power`` for each of ``values`` (n,)."""
    size = abs(values)
    cells = np.where(np.isnan(values), ord("-"), ord("0")).astype(np.uint8)[None]
    small = (size >= SMALLEST_SHOWN) & (size < 1)
    cells = place(cells, small, write_significant(values[small], 3))
    return place(cells, size >= 1, write_fixed(values[size >= 1], 2))


def _sigmas(values: np.ndarray, digits: int) -> np.ndarray:
    """Cells of standard deviations (n,), "-" where there is none."""
    known = ~np.isnan(values)
    return place(np.full((1, len(values)), ord("-"), dtype=np.uint8), known, write_fixed(values[known], digits))


def _power(value: float) -> str:
    """Text of a value in kW, kvar, A or percent: two decimals, or three significant digits below 1; "-" for nan."""
    if math.isnan(value):
        return "-"
    return "0" if abs(value) < SMALLEST_SHOWN else f"{value:.2f}" if abs(value) >= 1 else f"{value:.3g}"


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
        lowest = f"{scans.lowest_vm_pu[k]:.5f}", name_lowest(scans, k)
        rows.append([scans.scan[k], str(scans.readings[k]), *numbers, *lowest, removed])
    total = f"{len(rows)} of {len(scans)} scans estimated, back end {found.batch.plan.backend}"
    failures = [f"no estimate of {failure}" for failure in found.describe_failures()]
    return "\n".join([*([format_table(HEADER, rows), ""] if rows else []), total, *failures])
