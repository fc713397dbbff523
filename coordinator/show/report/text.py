"""Plain text of the command line for areas: the verdict of a run, and the summary of a check."""

from __future__ import annotations

from agents.protocol.configuration import Configuration
from coordinator.lab.evaluation.result import AreaResult, RunOutcome, RunResult
from coordinator.lab.evaluation.verdict import Verdict
from coordinator.show.report.phase_rows import describe_unbalance
from coordinator.watch.observe.causes import write_lines
from coordinator.watch.tables import format_table
from dsse_core.grid.gauge import describe_ungrounded
from dsse_core.grid.partition import Area
from dsse_core.printable import printable, printable_lines
from dsse_core.split_identity import describe_other
from scenarios.reading_rules import find_gateway_remark
from scenarios.scenario import Scenario

TextTable = tuple[tuple[str, ...], list[tuple[str, ...]]]


def format_verdict(result: RunResult) -> str:
    """The verdict of a run as text: outcome, causes, reason, table of gaps, table of areas, findings, run folder."""
    verdict = result.verdict
    about = [*(line for _, lines in write_lines(result.causes) for line in lines), describe_run(result.scenario)]
    lines = [f"{name_outcome(verdict)}: {printable(about[0])}", *(f"  {printable(line)}" for line in about[1:])]
    if verdict.reason:
        lines.append(f"  {printable_lines(verdict.reason)}")
    lines += ["", format_table(*tabulate_gaps(result)), "", format_table(*tabulate_areas(result)), ""]
    lines += map(printable, list_findings(result))
    lines.append(f"files: {printable(result.folder)}")
    return "\n".join(lines)


def name_outcome(verdict: Verdict) -> str:
    """The outcome in words, consensus or not, with its time."""
    outcome, time = "consensus" if verdict.consensus else "NO CONSENSUS", f"{verdict.wall_s:.2f} s"
    if verdict.virtual_s is not None:
        time = f"{verdict.virtual_s:.2f} s of virtual time, computed in {time}"
    return f"{outcome} after {time}"


def describe_run(scenario: Scenario) -> str:
    """The scenario of a run in a few words: name, buses, areas, strategy, seed."""
    buses, areas = len(scenario.network.buses), len(scenario.partition.areas)
    return f"{scenario.name}, {buses} buses in {areas} areas, strategy {scenario.strategy}, seed {scenario.seed}"


def tabulate_gaps(result: RunOutcome) -> TextTable:
    """The largest gaps and errors of all buses, or of all nodes of buses with phases: header and rows."""
    verdict, central = result.verdict, result.comparison.centralised_error
    is_balanced = result.scenario.network.table.nodes.is_balanced
    at = "" if is_balanced or verdict.gap_at is None else f", at {verdict.gap_at}"
    rows: list[tuple[str, ...]] = [
        (f"decentralised to centralised (same telemetry{at})", _pu(verdict.gap_vm_pu), _deg(verdict.gap_va_deg))
    ]
    if result.comparison.knows_truth:
        rows += [
            ("decentralised to truth", _pu(verdict.error_vm_pu), _deg(verdict.error_va_deg)),
            ("centralised to truth", _pu(central.vm_pu), _deg(central.va_deg)),
        ]
    return (f"largest difference over all {'buses' if is_balanced else 'nodes'}", "p.u.", "deg"), rows


def tabulate_areas(result: RunOutcome) -> TextTable:
    """Gaps, errors, messages and quality of each area and of all: header and rows."""
    with_errors = result.comparison.knows_truth
    errors = ("error p.u.", "error deg") if with_errors else ()
    header = ("area", "buses", "gap p.u.", "gap deg", *errors, "exchanges", "messages", "bytes", "lost", "quality")
    rows = [(area.name, str(area.buses), *_figures(area, with_errors), area.quality) for area in result.area_results]
    total = ("all", str(len(result.scenario.network.buses)), *_figures(result.verdict, with_errors), "")
    return header, [*rows, total]


def _figures(of: AreaResult | Verdict, with_errors: bool) -> tuple[str, ...]:
    errors = (_pu(of.error_vm_pu), _deg(of.error_va_deg)) if with_errors else ()
    counts = (of.exchanges, of.messages, of.bytes, of.lost)
    return (_pu(of.gap_vm_pu), _deg(of.gap_va_deg), *errors, *map(str, counts))


def list_findings(result: RunOutcome) -> list[str]:
    """Lines on unbalance, faults, duplicates, notes of areas, rejections, removed meters and the centralised estimate;
    empty where there is nothing to report.
    """
    lines = [unbalance] if (unbalance := describe_unbalance(result)) else []
    lines += [ungrounded] if (ungrounded := describe_ungrounded(result.scenario.network.gauge.ungrounded)) else []
    if result.faults:
        lines.append("faults: " + ", ".join(f"{count} {kind}" for kind, count in sorted(result.faults.items())))
    lines += [f"warning: {duplicate}" for duplicate in result.duplicates]
    for area in result.area_results:
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
    for meter, *others in result.centralised.undecided:
        lines.append(f"the centralised estimate cannot tell {meter}, which is removed, from {', '.join(others)}")
    if result.centralised.detected:
        lines.append("the centralised estimate still holds bad data that it cannot identify")
    return lines


def format_check(scenario: Scenario) -> str:
    """Summary of a checked scenario: its network, meters and areas."""
    partition = scenario.partition
    network = scenario.network
    nodes = "" if network.table.nodes.is_balanced else f" with {network.n_nodes} nodes"
    lines = [
        f"{scenario.name} is sound: {scenario.description}",
        f"network {network.name}: {len(network.buses)} buses{nodes}, "
        f"{len(scenario.network.table.active)} branches in service; {len(scenario.meters)} meters, "
        f"strategy {scenario.strategy}, seed {scenario.seed}",
    ]
    meters = partition.split_meters(scenario.meters)
    lines += [f"  {_describe_area(area, len(meters[area.name]))}" for area in partition.areas]
    if ungrounded := describe_ungrounded(network.gauge.ungrounded):
        lines.append(f"note: {ungrounded}")
    if remark := find_gateway_remark(scenario.reading_rules):
        lines.append(f"note: {remark}")
    return "\n".join(map(printable, lines))


def format_area_check(file: Configuration) -> str:
    """Summary of a checked area file: its area, neighbours and split."""
    neighbours = ", ".join(n.area for n in file.area.neighbours) or "none"
    split = file.identity
    is_sound = "is sound" if split.is_sound else "can be used, and no area will be good"
    lines = [f"{file.area.name} of run {file.run} {is_sound}: strategy {file.strategy}, neighbours {neighbours}"]
    lines += [f"  {_describe_area(file.area, len(file.meters))}"]
    lines += [f"  {split}" if split.is_sound else f"  {describe_other('this area', split, split)}"]
    return "\n".join(map(printable, lines))


def _describe_area(area: Area, meters: int) -> str:
    met = ", ".join(map(str, area.not_owned))
    where = "buses" if len(area.not_owned) > 1 else "bus"
    towards = f"beyond {area.parent.area} at {where} {met}" if area.parent else "with the substation"
    described = f"{area.name}: {len(area.network.buses)} buses, {towards}, {meters} meters"
    if not area.network.table.nodes.is_balanced:
        return described  # without a power flow of its own
    slack = "voltage received from there" if area.slack_vm is None else f"{area.slack_vm:g} p.u."
    return f"{described}, local slack bus {area.slack_bus} ({slack})"


def _pu(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}" if 0 < value < 1e-5 else f"{value:.5f}"


def _deg(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}" if 0 < value < 1e-4 else f"{value:.4f}"
