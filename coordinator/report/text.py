"""What the command line prints: verdict, power flow, estimate, and progress, as plain text."""

from __future__ import annotations

import math
from collections.abc import Sequence

from agents.area_files.area_file import AreaFile
from coordinator.evaluation.result import AreaResult, RunResult
from coordinator.evaluation.verdict import Verdict
from dsse_core.estimation.bad_data import BadDataReport, SuspectKept
from dsse_core.grid.partition import Area
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.printable import printable, printable_lines
from scenarios.scenario import Scenario


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns padded to their widest cell, all printable; the first is flush left, the others right."""
    lines = [header, *([printable(cell) for cell in row] for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def format_verdict(result: RunResult) -> str:
    """The verdict of a run: a line that says it, the table of gaps, the areas, what was wrong, where the files are."""
    scenario, verdict = result.scenario, result.verdict
    outcome = "consensus" if verdict.consensus else "NO CONSENSUS"
    time = f"{verdict.wall_s:.2f} s"
    if verdict.virtual_s is not None:
        time = f"{verdict.virtual_s:.2f} s of virtual time, computed in {time}"
    lines = [
        f"{outcome} after {time}: {printable(scenario.name)}, {len(scenario.network.buses)} buses in "
        f"{len(result.areas)} areas, strategy {scenario.strategy}, seed {scenario.seed}"
    ]
    if verdict.reason:
        lines.append(f"  {printable_lines(verdict.reason)}")
    lines += ["", _format_gaps(result), "", _format_areas(result), ""]
    lines += map(printable, _format_findings(result))
    lines.append(f"files: {printable(result.folder)}")
    return "\n".join(lines)


def _format_gaps(result: RunResult) -> str:
    verdict, central = result.verdict, result.comparison.centralised_error
    rows = [("decentralised to centralised (same telemetry)", _pu(verdict.gap_vm_pu), _deg(verdict.gap_va_deg))]
    if result.comparison.knows_truth:
        rows += [
            ("decentralised to truth", _pu(verdict.error_vm_pu), _deg(verdict.error_va_deg)),
            ("centralised to truth", _pu(central.vm_pu), _deg(central.va_deg)),
        ]
    return format_table(("largest difference over all buses", "p.u.", "deg"), rows)


def _format_areas(result: RunResult) -> str:
    with_errors = result.comparison.knows_truth
    errors = ("error p.u.", "error deg") if with_errors else ()
    header = ("area", "buses", "gap p.u.", "gap deg", *errors, "exchanges", "messages", "bytes", "lost", "quality")
    rows = [(area.name, str(area.buses), *_figures(area, with_errors), area.quality) for area in result.areas]
    total = ("all", str(len(result.scenario.network.buses)), *_figures(result.verdict, with_errors), "")
    return format_table(header, [*rows, total])


def _figures(of: AreaResult | Verdict, with_errors: bool) -> tuple[str, ...]:
    errors = (_pu(of.error_vm_pu), _deg(of.error_va_deg)) if with_errors else ()
    counts = (of.exchanges, of.messages, of.bytes, of.lost)
    return (_pu(of.gap_vm_pu), _deg(of.gap_va_deg), *errors, *map(str, counts))


def _format_findings(result: RunResult) -> list[str]:
    """Why areas are not good, remarks, rejections and removed meters, one line each; nothing where all is well."""
    lines = []
    if result.faults:
        lines.append("faults: " + ", ".join(f"{count} {kind}" for kind, count in sorted(result.faults.items())))
    lines += [f"warning: {duplicate}" for duplicate in result.duplicates]
    for area in result.areas:
        if area.notes:
            lines.append(f"{area.quality if area.degraded else 'note'}: {area.name}: {'; '.join(area.notes)}")
        if area.rejected:
            rejected = [f"{count} messages ({reason})" for reason, count in area.rejected.items()]
            lines.append(f"rejected by {area.name}: {', '.join(rejected)}")
        if area.removed:
            lines.append(f"removed as bad data by {area.name}: {', '.join(area.removed)}")
    if result.centralised is None:
        lines.append(f"there is no centralised estimate to compare with: {result.centralised_failure}")
        return lines
    if result.centralised.removed:
        ids = (removed.measurement.meter.id for removed in result.centralised.removed)
        lines.append(f"removed as bad data by the centralised estimate: {', '.join(ids)}")
    if result.centralised.detected:
        lines.append("the centralised estimate still holds bad data that it cannot identify")
    return lines


def format_power_flow(result: PowerFlowResult) -> str:
    """Voltages and injections of all buses, and the losses."""
    base = result.network.base_mva
    rows = [
        (
            str(bus.id),
            f"{result.vm[row]:.5f}",
            f"{math.degrees(result.va[row]):.4f}",
            _mega(result.injection[row].real * base),
            _mega(result.injection[row].imag * base),
        )
        for row, bus in enumerate(result.network.buses)
    ]
    table = format_table(("bus", "vm p.u.", "va deg", "injection MW", "Mvar"), rows)
    losses = result.losses * base
    steps = "backward and forward sweeps" if result.method == "sweep" else "Newton-Raphson steps"
    return f"{table}\n\nlosses {_mega(losses.real)} MW, {_mega(losses.imag)} Mvar; {result.iterations} {steps}"


def format_estimate(report: BadDataReport, truth: PowerFlowResult | None) -> str:
    """The centralised estimate, beside the truth where it is known, and its bad-data report."""
    estimate = report.result
    sigma_vm, sigma_va = estimate.state_sigma()
    true = ("true",) if truth else ()
    rows = [
        (
            str(bus.id),
            f"{estimate.vm[row]:.5f}",
            f"{sigma_vm[row]:.5f}",
            *((f"{truth.vm[row]:.5f}",) if truth else ()),
            f"{math.degrees(estimate.va[row]):.4f}",
            f"{math.degrees(sigma_va[row]):.4f}",
            *((f"{math.degrees(truth.va[row]):.4f}",) if truth else ()),
        )
        for row, bus in enumerate(estimate.network.buses)
    ]
    table = format_table(("bus", "vm p.u.", "sigma", *true, "va deg", "sigma", *true), rows)
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


def format_check(scenario: Scenario) -> str:
    """What a checked scenario consists of."""
    partition = scenario.partition
    lines = [
        f"{scenario.name} is sound: {scenario.description}",
        f"network {scenario.network.name}: {len(scenario.network.buses)} buses, "
        f"{len(scenario.network.active_branches)} branches in service; {len(scenario.meters)} meters, "
        f"strategy {scenario.strategy}, seed {scenario.seed}",
    ]
    for area in partition.areas:
        meters = sum(partition.area_of_meter(meter) == area.name for meter in scenario.meters)
        lines.append(f"  {_describe_area(area, meters)}")
    return "\n".join(map(printable, lines))


def format_area_check(file: AreaFile) -> str:
    """What a checked area file consists of."""
    neighbours = ", ".join(n.area for n in file.area.neighbours) or "none"
    lines = [f"{file.area.name} of run {file.run} is sound: strategy {file.strategy}, neighbours {neighbours}"]
    return "\n".join(map(printable, [*lines, f"  {_describe_area(file.area, len(file.meters))}"]))


def _describe_area(area: Area, meters: int) -> str:
    towards = f"beyond {area.parent.area} at bus {area.parent.bus}" if area.parent else "with the substation"
    slack = "voltage received from there" if area.slack_vm is None else f"{area.slack_vm:g} p.u."
    return (
        f"{area.name}: {len(area.network.buses)} buses, {towards}, {meters} meters, "
        f"local slack bus {area.slack_bus} ({slack})"
    )


def _pu(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}" if 0 < value < 1e-5 else f"{value:.5f}"


def _deg(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}" if 0 < value < 1e-4 else f"{value:.4f}"


def _mega(value: float) -> str:
    return f"{value:.4f}" if abs(value) >= 5e-5 else "0"
