"""What the command line prints of a whole grid: power flow and estimate, as plain text; and how tables look."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dsse_core.estimation.bad_data import BadDataReport, SuspectKept
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.printable import printable


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns padded to their widest cell, all printable; the first is flush left, the others right."""
    columns = zip(*rows, strict=True) if rows else ([] for _ in header)
    return _join_columns(header, [list(map(printable, column)) for column in columns])


def _join_columns(header: Sequence[str], columns: Iterable[list[str]]) -> str:
    padded: list[list[str]] = []
    for name, column in zip(header, columns, strict=True):
        cells = [name, *column]
        width = max(map(len, cells))
        padded.append([cell.rjust(width) if padded else cell.ljust(width) for cell in cells])
    return "\n".join(map(str.rstrip, map("  ".join, zip(*padded, strict=True))))


def _write(values: np.ndarray, digits: int) -> list[str]:
    """Each of ``values`` (n,) with so many digits after the point."""
    return list(map(f"{{:.{digits}f}}".format, values.tolist()))


def _name_buses(network: Network) -> list[str]:
    return [str(bus.id) for bus in network.buses]


def format_power_flow(result: PowerFlowResult) -> str:
    """Voltages and injections of all buses, and the losses."""
    base = result.network.base_mva
    columns = [
        _name_buses(result.network),
        _write(result.vm, 5),
        _write(np.degrees(result.va), 4),
        list(map(_mega, (result.injection.real * base).tolist())),
        list(map(_mega, (result.injection.imag * base).tolist())),
    ]
    table = _join_columns(("bus", "vm p.u.", "va deg", "injection MW", "Mvar"), columns)
    losses = result.losses * base
    steps = "backward and forward sweeps" if result.method == "sweep" else "Newton-Raphson steps"
    return f"{table}\n\nlosses {_mega(losses.real)} MW, {_mega(losses.imag)} Mvar; {result.iterations} {steps}"


def format_estimate(report: BadDataReport, truth: PowerFlowResult | None) -> str:
    """The centralised estimate, beside the truth where it is known, and its bad-data report."""
    estimate = report.result
    sigma_vm, sigma_va = estimate.state_sigma()
    true = ("true",) if truth else ()
    columns = [
        _name_buses(estimate.network),
        *(_write(part, 5) for part in (estimate.vm, sigma_vm, *((truth.vm,) if truth else ()))),
        *(_write(np.degrees(part), 4) for part in (estimate.va, sigma_va, *((truth.va,) if truth else ()))),
    ]
    table = _join_columns(("bus", "vm p.u.", "sigma", *true, "va deg", "sigma", *true), columns)
    return "\n".join([table, "", *map(printable, _format_bad_data(report))])


def _describe_backend(report: BadDataReport) -> str:
    """By which the state was found, and why not by the compiled one."""
    radial = report.result.plan.radial
    return f"{report.result.backend}: {radial}" if isinstance(radial, str) else report.result.backend


def _format_bad_data(report: BadDataReport) -> list[str]:
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
    if report.detected:
        lines.append(f"bad data is still detected{_format_suspect(report.suspect)}")
    elif not report.removed:
        lines.append("no bad data detected")
    if report.critical:
        lines.append(f"critical, their errors cannot be seen: {', '.join(report.critical)}")
    return lines


def _format_suspect(suspect: SuspectKept | None) -> str:
    """Why bad data that are still detected were not removed."""
    if suspect is None:
        return ", but no normalised residual stands out"
    reason = {
        "critical": "without it the state is not determined",
        "diverges": "without it the estimate does not converge",
    }[suspect.reason]
    return f": {suspect.meter} has the largest normalised residual, {suspect.normalized_residual:.3g}, but {reason}"


def _mega(value: float) -> str:
    return f"{value:.4f}" if abs(value) >= 5e-5 else "0"
