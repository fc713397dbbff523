"""A scenario: one grid, its areas, meters and faults, read from a TOML file and checked as a whole."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dsse_core.errors import InvalidInputError
from dsse_core.measurement import Meter, Source
from dsse_core.network import Network
from dsse_core.partition import Partition, build_partition
from scenarios.meters import SigmaRule, build_meters, build_sigma_rule, find_place_problems
from scenarios.network_file import load_case, load_network
from scenarios.scenario_file import ScenarioFile
from scenarios.shipped_files import find_shipped
from scenarios.strict_toml import load_strict, suggest

RESERVED = {"all", "coordinator", "plant", "router"}


@dataclass(frozen=True, slots=True)
class TelemetrySettings:
    """How readings are made: ``gross_errors`` is meter id -> error in standard deviations."""

    source: Literal["network", "area-power-flow"]
    noise: bool
    gross_errors: dict[str, float]


@dataclass(frozen=True, slots=True)
class Tolerances:
    """When areas agree (``consensus_va`` rad, ``consensus_vm`` p.u.) and when an estimator stops (rad and p.u.)."""

    consensus_va: float
    consensus_vm: float
    estimator: float


@dataclass(frozen=True, slots=True)
class RunSettings:
    """``beat_s``: time between repeats of a message; ``timeout_s``: when a run without consensus ends."""

    beat_s: float
    timeout_s: float


@dataclass(frozen=True, slots=True)
class TransportSettings:
    """``listen``: the Zenoh endpoint of the run's router, ``tcp/HOST:PORT``; port 0 takes a free one."""

    listen: str


@dataclass(frozen=True)
class Scenario:
    """A checked scenario, in p.u. and rad.

    ``meters`` are all that the telemetry reads: with ``area-power-flow`` no injection at boundary buses, because an
    area's own power flow knows only its net load there. ``load_error`` has every area, ``loss`` every directed link
    (sending area, receiving area) between neighbours.
    """

    name: str
    path: Path
    description: str
    seed: int
    strategy: str
    network: Network
    partition: Partition
    meters: tuple[Meter, ...]
    sigma_rule: SigmaRule
    telemetry: TelemetrySettings
    generation: Literal["telemetered", "scheduled"]
    load_error: dict[str, complex]
    loss: dict[tuple[str, str], float]
    tolerances: Tolerances
    run: RunSettings
    transport: TransportSettings


def list_scenarios() -> tuple[tuple[str, str], ...]:
    """(name, description) of every shipped scenario."""
    return tuple((name, load_strict(path, ScenarioFile).description) for name, path in find_shipped("shipped").items())


def load_scenario(name_or_path: str | Path, *, strategies: Collection[str] = ("angle-offset",)) -> Scenario:
    """Read a shipped scenario by name, or a scenario file by its path (a ``Path``, or text with ``/`` or ``.toml``).

    Raises:
        InvalidInputError: unknown name; or every problem of the file: first of its keys and types, then of what
            they say about the network, areas, meters and faults.
    """
    path = _find_file(name_or_path)
    file = load_strict(path, ScenarioFile)
    problems = []
    if file.strategy not in strategies:
        allowed = ", ".join(sorted(strategies))
        problems.append(f"strategy: unknown strategy {file.strategy!r}; allowed: {allowed}")
    network, network_problems = _load_network_of(file, path)
    problems += network_problems
    problems += _find_fault_problems(file)
    problems += [
        f"areas.{name}: this name belongs to a process of every run; choose another"
        for name in sorted(RESERVED & file.areas.keys())
    ]
    if network is None:
        raise InvalidInputError(str(path), problems)
    problems += find_place_problems(file.measurements, network)
    partition, partition_problems = _build_partition_of(file, network)
    problems += partition_problems
    meters = _build_meters_of(file, network)
    problems += _find_gross_error_problems(file, meters)
    if partition is not None:
        problems += _find_link_problems(file, _find_links(partition))
    if partition is None or problems:
        raise InvalidInputError(str(path), problems)
    return _build_scenario(path, file, partition, meters)


def _find_file(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml") or "/" in text or os.sep in text:
        return Path(name_or_path)
    shipped = find_shipped("shipped")
    if text not in shipped:
        raise InvalidInputError(
            f"scenario {text!r}",
            [
                f"no shipped scenario has this name; shipped: {', '.join(shipped)}{suggest(text, shipped)} "
                "(a scenario file of your own is given by its path, which ends in .toml)"
            ],
        )
    return shipped[text]


def _load_network_of(file: ScenarioFile, path: Path) -> tuple[Network | None, list[str]]:
    is_path = file.network.endswith(".toml") or "/" in file.network
    try:
        return (load_network(path.parent / file.network) if is_path else load_case(file.network)), []
    except InvalidInputError as error:
        hint = "" if is_path else " (a network file of your own ends in .toml)"
        return None, [f"network: {error.what}: {problem}{hint}" for problem in error.problems]


def _build_partition_of(file: ScenarioFile, network: Network) -> tuple[Partition | None, list[str]]:
    buses = {name: area.buses for name, area in file.areas.items()}
    slacks = {
        name: (area.slack_bus, area.slack_vm_pu)
        for name, area in file.areas.items()
        if area.slack_bus is not None and area.slack_vm_pu is not None
    }
    try:
        return build_partition(network, buses, slacks), []
    except InvalidInputError as error:
        return None, [f"areas: {problem}" for problem in error.problems]


def _build_meters_of(file: ScenarioFile, network: Network) -> tuple[Meter, ...]:
    meters = build_meters(file.measurements, network)
    if file.telemetry.source == "network":
        return meters
    members = [bus for area in file.areas.values() for bus in area.buses]
    return tuple(m for m in meters if not (m.kind.of_injection and members.count(m.bus) > 1))


def _find_links(partition: Partition) -> tuple[tuple[str, str], ...]:
    """(sending area, receiving area) of every directed link between neighbours."""
    return tuple((n.area, area.name) for area in partition.areas for n in area.neighbours)


def _find_fault_problems(file: ScenarioFile) -> Iterable[str]:
    for name in file.faults.load_error:
        if name not in file.areas:
            yield f"faults.load_error.{name}: there is no area {name!r}; areas: {', '.join(file.areas)}"
    for i, link in enumerate(file.faults.link):
        for key, name in (("from", link.from_), ("to", link.to)):
            if name not in file.areas:
                yield f"faults.link[{i}].{key}: there is no area {name!r}; areas: {', '.join(file.areas)}"


def _find_link_problems(file: ScenarioFile, links: Collection[tuple[str, str]]) -> Iterable[str]:
    named = [(link.from_, link.to) for link in file.faults.link]
    for i, (sender, receiver) in enumerate(named):
        if {sender, receiver} <= file.areas.keys() and (sender, receiver) not in links:
            pairs = ", ".join(f"{a} to {b}" for a, b in links) or "none"
            yield f"faults.link[{i}]: {sender} and {receiver} are not neighbours; links: {pairs}"
        if (sender, receiver) in named[:i]:
            yield f"faults.link[{i}]: the link from {sender} to {receiver} is given twice; keep one"


def _find_gross_error_problems(file: ScenarioFile, meters: Collection[Meter]) -> Iterable[str]:
    ids = {meter.id for meter in meters if meter.source is not Source.VIRTUAL}
    virtual = {meter.id for meter in meters if meter.source is Source.VIRTUAL}
    named = [error.meter for error in file.telemetry.gross_error]
    for i, meter in enumerate(named):
        key = f"telemetry.gross_error[{i}].meter"
        if meter in virtual:
            yield f"{key}: {meter} is an exact zero injection, no meter reads it; choose another meter"
        elif meter not in ids:
            example = min(ids, default="vm@1")
            yield f"{key}: {meter!r} is no meter of this scenario; an id looks like {example}{suggest(meter, ids)}"
        if meter in named[:i]:
            yield f"{key}: {meter} is given twice; keep one"


def _build_scenario(path: Path, file: ScenarioFile, partition: Partition, meters: tuple[Meter, ...]) -> Scenario:
    base_mva = partition.network.base_mva
    errors = {name: complex(e.p_mw, e.q_mvar) / base_mva for name, e in file.faults.load_error.items()}
    overrides = {(link.from_, link.to): link.loss for link in file.faults.link}
    return Scenario(
        name=path.stem,
        path=path,
        description=file.description,
        seed=file.seed,
        strategy=file.strategy,
        network=partition.network,
        partition=partition,
        meters=meters,
        sigma_rule=build_sigma_rule(file.measurements, base_mva),
        telemetry=TelemetrySettings(
            source=file.telemetry.source,
            noise=file.telemetry.noise,
            gross_errors={error.meter: error.sigmas for error in file.telemetry.gross_error},
        ),
        generation=file.load_messages.generation,
        load_error={area.name: errors.get(area.name, 0j) for area in partition.areas},
        loss={link: overrides.get(link, file.faults.loss) for link in _find_links(partition)},
        tolerances=Tolerances(
            consensus_va=file.tolerances.consensus_va_rad,
            consensus_vm=file.tolerances.consensus_vm_pu,
            estimator=file.tolerances.estimator,
        ),
        run=RunSettings(beat_s=file.run.beat_s, timeout_s=file.run.timeout_s),
        transport=TransportSettings(listen=file.transport.listen),
    )
