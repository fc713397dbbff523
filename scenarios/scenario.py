"""A scenario: one grid, its areas, meters and faults, read from a TOML file and checked as a whole."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.state_limits import OperatingLimits, StateLimits
from dsse_core.files.strict_table import load_strict
from dsse_core.files.wording import Suggestions, describe_unknown
from dsse_core.grid.admittance import flat_start
from dsse_core.grid.columns import Records, take_items
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import KIND_OF, Measurement, Meter, Source, find_meter_problems
from dsse_core.grid.meter_table import KINDS, join_meters, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Area, Partition
from dsse_core.grid.switches import find_dead_meters, find_meters_in_service, keep_in_service
from dsse_core.printable import listed, printable
from dsse_core.reading_rules import ReadingRules
from scenarios.faults.faults import (
    ALL_AREAS,
    Faults,
    build_faults,
    find_link_problems,
    find_name_problems,
    find_order_problems,
    find_time_problems,
)
from scenarios.files.fault_tables import FaultsTable
from scenarios.files.network_file import load_case, load_network
from scenarios.files.readings.file import load_readings
from scenarios.files.readings.rows import parse_meter
from scenarios.files.scenario_file import (
    CountTable,
    RecordTable,
    RunTable,
    ScenarioFile,
    SwitchesTable,
    TolerancesTable,
    TransportTable,
)
from scenarios.files.shipped_files import find_scenario, find_shipped
from scenarios.generate.cutting import cut_at, cut_into, open_branches
from scenarios.meters import (
    INJECTIONS,
    SigmaRule,
    build_meters,
    build_sigma_rule,
    find_floor_problems,
    find_place_problems,
    find_tap_problems,
)
from scenarios.reading_rules import build_reading_rules, find_gateway_problems

AreaBuses = Mapping[str, Sequence[int]]
RESERVED = {ALL_AREAS, "coordinator", "operator", "plant", "recorder", "router", "router2", "watcher"}
MARKS = {b'"_class"': "pandapower network", b'"is_batch"': "power-grid-model file"}
LOOKED_AT = 1_000_000  # bytes at either end of a file: the marks stand near the start, or behind the data


@dataclass(frozen=True, slots=True)
class TelemetrySettings:
    """Source of the readings. ``gross_errors``: meter id -> error in standard deviations.

    ``readings``: those of real meters, of source ``file`` only, else empty; one for each meter of the scenario that is
    not virtual, in their order. With source ``live`` no readings are made: gateways send them.
    """

    source: Literal["network", "area-power-flow", "file", "live"]
    noise: bool
    gross_errors: dict[str, float]
    readings: Sequence[Measurement] = ()


@dataclass(frozen=True, repr=False)
class Scenario:
    """A checked scenario, in p.u. and rad; ``tolerances``, ``run``, ``transport`` and ``record``: tables of its file.

    ``meters`` are all that the telemetry reads: with ``area-power-flow`` no injection at boundary buses, because an
    area's own power flow knows only its net load there. ``load_error`` and ``reading_rules`` are by area.
    ``changes``: key -> value that replaces the file's.
    """

    name: str
    path: Path
    description: str
    seed: int
    strategy: str
    network: Network
    partition: Partition
    meters: Sequence[Meter]
    sigma_rule: SigmaRule
    telemetry: TelemetrySettings
    generation: Literal["telemetered", "scheduled"]
    admm_penalty: float
    load_error: dict[str, complex]
    faults: Faults
    tolerances: TolerancesTable
    run: RunTable
    transport: TransportTable
    limits: StateLimits
    operating_limits: OperatingLimits
    reading_rules: Mapping[str, ReadingRules]
    record: RecordTable | None = None
    changes: Mapping[str, object] = field(default_factory=dict)

    @property
    def common_rules(self) -> ReadingRules:
        """The rules of any area; those of scan numbers and of kinds of meter are the same in all areas."""
        return next(iter(self.reading_rules.values()))

    @property
    def renew_s(self) -> float | None:
        """Interval at which readings must be renewed, s, where they age or clocks number scans; else None."""
        rules = self.common_rules
        if not rules.follow_clocks:
            return None
        return self.run.scan_s or min(rule.period_s for rule in rules.kinds.values() if rule.period_s)

    @property
    def meters_with_supply(self) -> Sequence[Meter]:
        """The meters, but those of which no end has supply."""
        dead = find_dead_meters(self.network, self.meters)
        return take_items(self.meters, np.flatnonzero(~dead)) if dead.any() else self.meters

    def operated(self, closed: Mapping[str, bool]) -> Scenario:
        """The same scenario with switches as in ``closed``: switch -> True where it is closed; others stay. Meters at
        branches that are open are left out.
        """
        partition = self.partition.operated(closed)
        if partition is self.partition:
            return self
        meters = take_items(self.meters, find_meters_in_service(partition.network, self.meters))
        read = keep_in_service(partition.network, self.telemetry.readings)
        telemetry = replace(self.telemetry, readings=read)
        return replace(self, network=partition.network, partition=partition, meters=meters, telemetry=telemetry)

    def __repr__(self) -> str:
        buses, areas = len(self.network.buses), len(self.partition.areas)
        return (
            f"<Scenario {self.name!r}: network {self.network.name!r}, {buses} buses in {areas} areas, "
            f"{len(self.meters)} meters, strategy {self.strategy!r}, seed {self.seed}>"
        )


def list_scenarios() -> tuple[tuple[str, str], ...]:
    """(name, description) of every shipped scenario."""
    return tuple((name, load_strict(path, ScenarioFile).description) for name, path in find_shipped("shipped").items())


def load_scenario(
    name_or_path: str | Path,
    *,
    strategies: Collection[str] | None = None,
    changes: Mapping[str, object] | None = None,
    whole: bool = False,
) -> Scenario:
    """Read a shipped scenario by name, or a scenario file by its path (a ``Path``, or text with ``/`` or ``.toml``).

    ``changes``: values that replace the file's, by key path such as ``faults.loss`` or ``faults.link[1].loss``.
    ``whole``: the grid as one area, for commands that run in one place. The file's areas, gateways and faults are
    ignored, except faults of the telemetry. No effect where the readings are those of each area's own power flow.

    Raises:
        InvalidInputError: unknown name; or every problem of the file: first of its keys and types, then of their
            meaning for network, areas, meters and faults.
    """
    path = _find_file(name_or_path)
    file = load_strict(path, ScenarioFile, changes)
    if whole := whole and file.telemetry.source != "area-power-flow":
        file = file.model_copy(update={"faults": FaultsTable(telemetry=file.faults.telemetry), "gateways": {}})
    problems = []
    if strategies is not None and file.strategy not in strategies:
        problems.append(f"strategy: {describe_unknown('strategy', file.strategy, sorted(strategies))}")
    network, network_problems = _load_network_of(file, path)
    problems += network_problems
    area_buses, area_problems = ({}, []) if whole else _find_area_buses(file, network)
    problems += area_problems
    problems += _find_problems_of_names_and_times(file, area_buses)
    if network is None:
        raise InvalidInputError(file.called(path), problems)
    problems += find_place_problems(file.measurements, network)
    problems += find_floor_problems(file.measurements, network)
    problems += _find_problems_of_phases(file, network)
    partition, partition_problems = _build_whole(network) if whole else _build_partition_of(file, network, area_buses)
    problems += partition_problems
    readings, reading_problems = _load_readings_of(file, path, network)
    problems += reading_problems
    meters = _build_meters_of(file, network, area_buses or {}, readings)
    if not reading_problems:
        problems += _find_gross_error_problems(file, network, meters)
        problems += find_tap_problems(network, meters)
    if partition is not None:
        problems += find_link_problems(file.faults, partition)
        problems += find_gateway_problems(file, partition, meters)
        problems += _find_problems_of_switching(file, partition.network)
    if partition is None or problems:
        raise InvalidInputError(file.called(path), problems)
    return replace(_build_scenario(path, file, partition, meters, readings), changes=dict(changes or {}))


def _find_problems_of_names_and_times(file: ScenarioFile, area_buses: AreaBuses | None) -> Iterator[str]:
    """Problems found without the network: names in faults, times and order of events, and names of other processes."""
    routers = 0 if file.transport.kind == "neighbours" else file.transport.routers
    yield from find_name_problems(file.faults, area_buses, routers)
    yield from find_time_problems(file.faults.events, file.run.timeout_s)
    yield from find_order_problems(file.faults.events)
    if file.telemetry.source != "network":
        for i, event in enumerate(file.faults.events, 1):
            if event.switch is not None:
                yield (
                    f"faults.events[{i}].switch: telemetry.source is {file.telemetry.source!r}, whose readings follow "
                    "no switch; set source = 'network', or remove the event"
                )
    for name in sorted({*RESERVED, *(f"gateway-{name}" for name in file.gateways)} & (area_buses or {}).keys()):
        yield f"areas.{name}: this name belongs to another process; choose another"


def _find_problems_of_phases(file: ScenarioFile, network: Network) -> Iterator[str]:
    """Problems of keys that a network with phases has no use for: areas solve no power flow of their own."""
    if network.table.nodes.is_balanced:
        return
    if file.telemetry.source == "area-power-flow":
        yield (
            f"telemetry.source: 'area-power-flow' does not suit network {network.name!r}: its buses have phases, and "
            "an area knows the voltage of no single phase at its local slack; set source = 'network'"
        )
    tables = file.areas if isinstance(file.areas, Mapping) else {}
    if held := [name for name, table in tables.items() if table.slack_bus is not None]:
        yield (
            f"areas.{', '.join(held)}: slack_bus and slack_vm_pu are of power flows of areas, which do not suit "
            f"network {network.name!r}, whose buses have phases; remove them"
        )
    if file.faults.load_error:
        yield (
            f"faults.load_error: the buses of network {network.name!r} have phases, and areas solve no power flow with "
            "load messages there; remove it, or give faults.link.load"
        )


def _find_problems_of_switching(file: ScenarioFile, network: Network) -> Iterator[str]:
    """Problems of events that leave a grid with phases without power flow, as where a delta loses one."""
    if network.slack is None or network.table.nodes.is_balanced:
        return
    closed: dict[str, bool] = {}
    for i, event in sorted(enumerate(file.faults.events, 1), key=lambda numbered: numbered[1].at_s):
        if event.switch is None or event.switch not in network.switches:
            continue
        closed[event.switch] = event.to == "closed"
        try:
            flat_start(network.operated(closed).supplied(), network.slack.bus)
        except InvalidInputError as error:
            yield f"faults.events[{i}].switch: with {event.switch} {event.to}, {'; '.join(error.problems)}"
            return


def _find_file(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    reject_importable(Path(name_or_path))
    if isinstance(name_or_path, Path) or text.endswith((".toml", ".json")) or "/" in text or os.sep in text:
        return Path(name_or_path)
    return find_scenario(text)


def _load_network_of(file: ScenarioFile, path: Path) -> tuple[Network | None, list[str]]:
    is_path = file.network.endswith((".toml", ".json")) or "/" in file.network
    try:
        return (load_network(path.parent / file.network) if is_path else load_case(file.network)), []
    except InvalidInputError as error:
        return None, [f"network: {error.what}: {problem}" for problem in error.problems]


def _find_area_buses(file: ScenarioFile, network: Network | None) -> tuple[AreaBuses | None, list[str]]:
    """Area -> its buses, as listed or as cut; None where there is no network to cut or no such cut."""
    try:
        match file.areas:
            case CountTable(count=count, ties=ties):
                return (None if network is None else cut_into(open_branches(network, ties), count)), []
            case SwitchesTable(switches=switches):
                return (None if network is None else cut_at(network, switches)), []
            case lists:
                return {name: area.buses for name, area in lists.items()}, []
    except InvalidInputError as error:
        return None, [f"areas: {problem}" for problem in error.problems]


def _build_partition_of(
    file: ScenarioFile, network: Network, area_buses: AreaBuses | None
) -> tuple[Partition | None, list[str]]:
    if area_buses is None:
        return None, []
    slacks = {
        name: (area.slack_bus, area.slack_vm_pu)
        for name, area in (file.areas.items() if isinstance(file.areas, dict) else ())
        if area.slack_bus is not None and area.slack_vm_pu is not None
    }
    holders, problems = _find_holders(file)
    try:
        partition = build_partition(network, area_buses, slacks, holders)
    except InvalidInputError as error:
        return None, [f"areas: {problem}" for problem in [*problems, *error.problems]]
    return partition, [f"areas: {problem}" for problem in problems]


def _find_holders(file: ScenarioFile) -> tuple[dict[str, str], list[str]]:
    """Branch -> the area that is to hold it, empty for the owner of its from bus; and branches of several areas."""
    match file.areas:
        case CountTable(ties=ties):
            return dict.fromkeys(ties, ""), []
        case SwitchesTable():
            return {}, []
        case lists:
            named = [(branch, name) for name, area in lists.items() for branch in area.holds]
            count = Counter(branch for branch, _ in named)
            twice = [f"branch {branch} is in holds {n} times; keep one" for branch, n in count.items() if n > 1]
            return dict(named), twice


def _build_whole(network: Network) -> tuple[Partition | None, list[str]]:
    """All of the grid as one area."""
    if (problems := network.find_supply_problems()) or network.slack is None:
        return None, problems
    slack = network.slack
    area = Area("grid", network, (), slack.bus, slack.vm, (slack.bus, slack.va), entry_voltage=(1.0, slack.va))
    return Partition(network, (area,), {"grid": network.table.bus_id.tolist()}), []


def _load_readings_of(file: ScenarioFile, path: Path, network: Network) -> tuple[Sequence[Measurement], Sequence[str]]:
    """The readings of source ``file``, else none; and problems of them or of the meters given instead."""
    tables = file.measurements.kinds
    if file.telemetry.file is None:
        return (), () if tables else (
            "measurements: there is no meter; give at least one of voltage, angle, flow, injection, current, "
            "or real readings with telemetry.source = 'file'",
        )
    problems = [
        f"measurements.{key}: with telemetry.source 'file' the meters are those that have a reading; remove it"
        for key in tables
    ]
    try:
        readings = load_readings(path.parent / file.telemetry.file, network)
    except InvalidInputError as error:
        return (), [*problems, *(f"telemetry.file: {error.what}: {problem}" for problem in error.problems)]
    virtual = build_meters(file.measurements, network)
    problems += find_virtual_problems("telemetry.file", network, readings.columns["meter"], virtual)
    return readings, problems


def find_virtual_problems(
    key: str, network: Network, meters: Sequence[Meter], virtual: Sequence[Meter]
) -> Iterator[str]:
    """Every injection meter with a reading, of the file that ``key`` gives, where nodes inject exactly nothing: at one,
    or of all of a bus.

    ``virtual``: meters, the virtual ones of the scenario among them.
    """
    (nodes, of_meter), (known, _) = _find_metered_nodes(network, meters), _find_metered_nodes(network, virtual)
    wrong = (nodes >= 0) & np.isin(nodes, known)
    if of_meter is not None:
        wrong = np.bincount(of_meter, ~wrong) == 0
    for meter in take_items(meters, np.flatnonzero(wrong)):
        yield (
            f"{key}: {meter.id} has a reading, but measurements.zero_injection says that bus {meter.at} injects "
            "exactly nothing; remove the reading, or set zero_injection to 'measured' or to a list without this bus"
        )


def _find_metered_nodes(network: Network, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray | None]:
    """The nodes whose injections ``meters`` read, (n_row,), -1 of others; and the meter of each, as of ``spread``."""
    powers, (table, of_meter) = [KINDS.index(kind) for kind in INJECTIONS], tabulate_meters(network, meters).spread()
    return np.where(np.isin(table.kind, powers), table.node, -1), of_meter


def _build_meters_of(
    file: ScenarioFile, network: Network, area_buses: AreaBuses, readings: Sequence[Measurement]
) -> Sequence[Meter]:
    meters: Sequence[Meter] = build_meters(file.measurements, network)
    if isinstance(readings, Records):
        meters = join_meters(network, [readings.columns["meter"], meters])
    if file.telemetry.source != "area-power-flow":
        return meters
    areas_at = Counter(bus for buses in area_buses.values() for bus in buses)
    return tuple(m for m in meters if not (m.kind.of_injection and areas_at[m.bus] > 1))


def _find_gross_error_problems(file: ScenarioFile, network: Network, meters: Collection[Meter]) -> Iterable[str]:
    if not file.telemetry.gross_error:
        return  # the ids of all meters of a large grid take their time
    real = [meter for meter in meters if meter.source is not Source.VIRTUAL]
    ids, meant = {meter.id for meter in real}, Suggestions(KIND_OF)
    beside: dict[int | str | None, list[str]] = defaultdict(list)
    for meter in real:
        beside[meter.bus].append(meter.id)
        if meter.branch is not None:
            beside[meter.branch].append(meter.id)
    virtual = {meter.id for meter in meters if meter.source is Source.VIRTUAL}
    given: set[str] = set()
    for i, text in enumerate((error.meter for error in file.telemetry.gross_error), 1):
        key = f"telemetry.gross_error[{i}].meter"
        if text in virtual:
            yield f"{key}: {text} is an exact zero injection, no meter reads it; choose another meter"
        elif text not in ids:
            yield from (f"{key}: {problem}" for problem in _explain_unknown_meter(text, network, beside, meant))
        if text in given:
            yield f"{key}: {text} is given twice; keep one"
        given.add(text)


def _explain_unknown_meter(
    text: str, network: Network, beside: Mapping[int | str | None, Sequence[str]], meant: Suggestions
) -> Iterable[str]:
    """The problems of ``text``, the id of no meter that reads: of the id or its place, or the meters ``beside`` it."""
    read = parse_meter(text, meant)
    if isinstance(read, str):
        return [read]
    if problems := list(find_meter_problems(network, [read])):
        return problems
    found = beside.get(read.branch) or beside.get(read.bus)
    where = f"beside it stand {listed(found)}" if found else "none stands there"
    return [f"{text!r} is no meter of this scenario; {where}"]


def _build_scenario(
    path: Path,
    file: ScenarioFile,
    partition: Partition,
    meters: Sequence[Meter],
    readings: Sequence[Measurement],
) -> Scenario:
    base_mva = partition.network.base_mva
    errors = {name: complex(e.p_mw, e.q_mvar) / base_mva for name, e in file.faults.load_error.items()}
    of_others = errors.get(ALL_AREAS, 0j)
    return Scenario(
        name=file.name or printable(path.stem),
        path=path,
        description=file.description,
        seed=file.seed,
        strategy=file.strategy,
        network=partition.network,
        partition=partition,
        meters=meters,
        sigma_rule=build_sigma_rule(file.measurements, partition.network),
        telemetry=TelemetrySettings(
            source=file.telemetry.source,
            noise=file.telemetry.noise,
            gross_errors={error.meter: error.sigmas for error in file.telemetry.gross_error},
            readings=readings,
        ),
        generation=file.load_messages.generation,
        admm_penalty=file.admm.penalty,
        load_error={area.name: errors.get(area.name, of_others) for area in partition.areas},
        faults=build_faults(file.faults, partition),
        tolerances=file.tolerances,
        run=file.run,
        transport=file.transport,
        limits=file.quality.of_estimate,
        operating_limits=file.quality.of_operation,
        reading_rules=build_reading_rules(file, partition, meters),
        record=file.record,
    )


def reject_importable(path: Path) -> None:
    """Rejects a ``path`` given as a scenario file where ``dsse import`` takes the file.

    Raises:
        InvalidInputError: with the kind of the file, and the command.
    """
    kind = _kind_of(path)
    if kind:
        command = f"dsse import {path} --out DIR"
        problem = f"is a {kind}, no scenario file; `{command}` makes one of it, then `dsse run DIR/scenario.toml`"
        raise InvalidInputError(str(path), [problem])


def _kind_of(path: Path) -> str | None:
    if path.suffix == ".m":
        return "MATPOWER case"
    if path.suffix != ".json" or not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(LOOKED_AT)
        file.seek(max(LOOKED_AT, path.stat().st_size - LOOKED_AT))
        text += file.read(LOOKED_AT)
    return next((kind for mark, kind in MARKS.items() if mark in text), None)
