"""The origin of a result, for its report: the settings of its scenario, and the command that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from dsse_core.link_faults import LinkFaults
from dsse_core.printable import listed
from scenarios.faults.faults import FaultEvent
from scenarios.files.key_values import write_value
from scenarios.scenario import Scenario

MAX_SOURCE_LINES = 2000
NEW_FOLDER = "NEW_FOLDER"  # an --out that has been used is not empty


@dataclass(frozen=True)
class Origin:
    """The origin of a result.

    ``settings``: name -> value. ``changes``: key -> value that replaces that of the scenario file. ``source``: the
    lines of that file. ``command``: the command that repeats it.
    """

    settings: Mapping[str, object]
    changes: Mapping[str, object]
    source_name: str
    source: Sequence[str]
    command: str


def find_origin(scenario: Scenario, arguments: Sequence[str], varied: Collection[str] = ()) -> Origin:
    """The origin of a result of ``scenario`` made by ``dsse`` with ``arguments``, without the settings ``varied``."""
    return Origin(
        settings={name: value for name, value in list_settings(scenario).items() if name not in varied},
        changes={key: write_value(value) for key, value in scenario.changes.items()},
        source_name=str(scenario.path),
        source=_read_lines(scenario.path),
        command=write_command(arguments),
    )


def _read_lines(path: Path) -> list[str]:
    """The first MAX_SOURCE_LINES lines of a file; a comment line with the reason if it cannot be read any more."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        return [f"# it cannot be read any more: {error.strerror}"]
    more = len(lines) - MAX_SOURCE_LINES
    return lines if more <= 0 else [*lines[:MAX_SOURCE_LINES], f"# ... and {more} lines more"]


def list_settings(scenario: Scenario) -> dict[str, object]:
    """Settings in effect, options of the command included: name in words -> value."""
    network, run, limits, tolerances = scenario.network, scenario.run, scenario.limits, scenario.tolerances
    telemetry = scenario.telemetry
    gross = [f"{meter}: {sigmas:g} standard deviations" for meter, sigmas in telemetry.gross_errors.items()]
    return {
        "scenario": f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name,
        "scenario file": scenario.path,
        "network": f"{network.name}: {len(network.buses)} buses, {len(network.table.active)} branches in service, "
        f"base {network.base_mva:g} MVA",
        "areas": listed([f"{area.name} ({len(area.network.buses)} buses)" for area in scenario.partition.areas]),
        "meters": len(scenario.meters),
        "strategy": scenario.strategy,
        "seed": scenario.seed,
        "readings": f"{telemetry.source}, {'with' if telemetry.noise else 'without'} noise",
        "gross errors": listed(gross) or "none",
        "faults of links": describe_links(scenario),
        "events": listed([_describe_event(event) for event in scenario.faults.events]) or "none",
        "time limit": f"{run.timeout_s:g} s",
        "heartbeat": f"{run.beat_s:g} s",
        "agreement at boundaries": f"{tolerances.consensus_vm_pu:g} p.u., {tolerances.consensus_va_rad:g} rad",
        "voltages accepted": f"{limits.lowest_vm:g} to {limits.highest_vm:g} p.u.",
        "bus": scenario.transport.kind,
    }


def describe_links(scenario: Scenario) -> str:
    """The faults of links in the words of the scenario file; where links differ, with the number of links of each."""
    counts: dict[str, int] = {}
    for faults in scenario.faults.links.values():
        text = _describe_link(faults)
        counts[text] = counts.get(text, 0) + 1
    if len(counts) <= 1:
        return next(iter(counts), "none")
    return listed(
        [f"{text} ({count} of {sum(counts.values())} links)" for text, count in counts.items()], separator="; "
    )


def _describe_link(faults: LinkFaults) -> str:
    usual = LinkFaults()
    changed = [f.name for f in fields(LinkFaults) if getattr(faults, f.name) != getattr(usual, f.name)]
    return ", ".join(f"{name} {getattr(faults, name)}" for name in changed) or "none"


def _describe_event(event: FaultEvent) -> str:
    lasts = f" for {event.for_s:g} s" if event.for_s else ""
    if event.to:
        read = f", read as {event.status}" if event.status else ""
        lasts = f" {event.to}{read}" + (f", read after {event.for_s:g} s" if event.for_s else "")
    return f"{event.kind} {' - '.join(event.names)} at {event.at_s:g} s{lasts}"


def write_command(arguments: Sequence[str]) -> str:
    """The command line of ``dsse`` with ``arguments``, quoted for a shell; ``NEW_FOLDER`` replaces the --out folder."""
    shown = []
    is_folder = False
    for argument in arguments:
        if is_folder:
            shown.append(NEW_FOLDER)
        elif argument.startswith("--out="):
            shown.append(f"--out={NEW_FOLDER}")
        else:
            shown.append(argument)
        is_folder = argument == "--out" and not is_folder
    return shlex.join(["dsse", *shown])


def guess_arguments(scenario: Scenario, command: str, links: Mapping[str, float] | None = None) -> list[str]:
    """Arguments of ``dsse`` that repeat a run started by a program: the scenario on disk, and its changes."""
    options = ["--seed", str(scenario.seed), "--strategy", scenario.strategy]
    options += ["--timeout", f"{scenario.run.timeout_s:g}"]
    for key, value in scenario.changes.items():
        options += ["--set", f"{key}={write_value(value)}"]
    links = links or {}
    for key, value in links.items():
        in_ms = key.endswith("_s")
        options += [f"--{key.removesuffix('_s')}-ms" if in_ms else f"--{key}", f"{value * (1000 if in_ms else 1):g}"]
    return [command, str(scenario.path), *options]
