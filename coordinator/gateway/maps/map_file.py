"""A gateway's map: which address of the source is which meter, checked as a whole against the scenario."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from coordinator.deployment.split import choose_run_id
from coordinator.gateway.interface import Sink, Source
from coordinator.gateway.maps.installed import load_sink, load_source
from coordinator.gateway.maps.map_tables import MapFile, ReadingTable
from coordinator.gateway.maps.points import Point, find_point_problems, make_point
from dsse_core.errors import InvalidInputError
from dsse_core.files.strict_table import Table, load_strict
from dsse_core.files.wording import Suggestions
from dsse_core.grid.measurement import Meter
from dsse_core.grid.measurement import Source as Origin
from scenarios.files.readings.rows import parse_meter
from scenarios.scenario import RESERVED, Scenario, load_scenario


@dataclass(frozen=True)
class SourceOf:
    """A class of sources, and the settings of the map for it."""

    cls: type[Source]
    settings: Table

    def make(self, addresses: Sequence[str]) -> Source:
        return self.cls(self.settings, addresses)


@dataclass(frozen=True)
class SinkOf:
    """A class of sinks, and the settings of one ``[[results]]``; ``name``: its kind and place in the map."""

    name: str
    cls: type[Sink]
    settings: Table

    def make(self) -> Sink:
        return self.cls(self.settings)


@dataclass(frozen=True, repr=False)
class GatewayMap:
    """A checked map; ``points``: address -> what is there. ``source``: None where only results go out."""

    path: Path
    name: str
    run: str
    scenario: Scenario
    endpoints: tuple[str, ...]
    least_interval_s: float
    source: SourceOf | None
    points: Mapping[str, Point]
    sinks: tuple[SinkOf, ...]

    def __repr__(self) -> str:
        return f"<GatewayMap {self.name!r}: {len(self.points)} meters of {self.scenario.name!r}>"

    @property
    def leads(self) -> bool:
        """Whether this gateway numbers the scans of all areas."""
        return _leads(self.name, self.scenario)

    @property
    def areas(self) -> tuple[str, ...]:
        """Those to which it has something to say, in scenario order: that have a meter here, or all if it leads."""
        used = {point.area for point in self.points.values()}
        return tuple(area.name for area in self.scenario.partition.areas if area.name in used or self.leads)


def load_map(path: Path) -> GatewayMap:
    """Read and check a map file.

    Raises:
        InvalidInputError: every problem of the file: first of its keys and types and of the scenario, then of what it
            says about addresses, meters, units, the source and the results.
    """
    file = load_strict(path, MapFile)
    scenario = _load_scenario_of(file, path)
    problems, source, sinks = [], None, []
    if file.name in RESERVED - {"plant"}:
        problems.append(f"name: {file.name!r} belongs to a process of every run; choose another")
    try:
        run = choose_run_id(scenario, file.run)
    except InvalidInputError as error:
        run, problems = "", [*problems, *(f"run: {problem}" for problem in error.problems)]
    try:
        source = SourceOf(*load_source(file.source, path.parent)) if file.source is not None else None
    except InvalidInputError as error:
        problems += error.problems
    for number, table in enumerate(file.results, start=1):
        place = f"results[{number}]"
        try:
            sinks.append(SinkOf(f"{place} ({table.get('kind')})", *load_sink(table, place, path.parent)))
        except InvalidInputError as error:
            problems += error.problems
    points, reading_problems = _make_points(file.reading, scenario, source.cls if source else None)
    problems += _find_foreign(file.name, points, scenario)
    if _leads(file.name, scenario) and scenario.run.scan_s is None:
        problems.append(
            f"name: {file.name!r} is the scenario's telemetry.leader and numbers scans; give run.scan_s there"
        )
    if problems := [*problems, *reading_problems]:
        raise InvalidInputError(file.called(path), problems)
    return GatewayMap(
        path, file.name, run, scenario, tuple(file.connect), file.least_interval_s, source, points, tuple(sinks)
    )


def _leads(name: str, scenario: Scenario) -> bool:
    rules = next(iter(scenario.reading_rules.values()))
    return rules.ticks == "gateway" and rules.leader == name


def _load_scenario_of(file: MapFile, path: Path) -> Scenario:
    """A name is that of a shipped scenario; what looks like a path counts from the folder of the map."""
    is_path = file.scenario.endswith((".toml", ".json")) or "/" in file.scenario
    try:
        return load_scenario(path.parent / file.scenario if is_path else file.scenario)
    except InvalidInputError as error:
        problems = [f"scenario: {error.what}: {problem}" for problem in error.problems]
        raise InvalidInputError(file.called(path), problems) from None


def _make_points(
    tables: Sequence[ReadingTable], scenario: Scenario, source: type[Source] | None
) -> tuple[dict[str, Point], list[str]]:
    """Address -> its point; and every problem."""
    meters = {meter.id: meter for meter in scenario.meters}
    close = Suggestions(list(meters))
    points: dict[str, Point] = {}
    problems: list[str] = []
    number_of_meter: dict[str, int] = {}
    number_of_address: dict[str, int] = {}
    for number, table in enumerate(tables, start=1):
        place = f"reading[{number}]"
        if (first := number_of_address.setdefault(table.address, number)) != number:
            problems.append(f"{place}: address {table.address!r} stands in reading[{first}] already; keep one")
        if (first := number_of_meter.setdefault(table.meter, number)) != number:
            problems.append(f"{place}: meter {table.meter} stands in reading[{first}] already; keep one")
        if source and (problem := source.find_address_problem(table.address)):
            problems.append(f"{place}: address {table.address!r:.80}: {problem}")
        found = list(_find_meter_problems(table, meters, close))
        problems += [f"{place}: {problem}" for problem in found]
        if found:
            continue
        meter = meters[table.meter]
        found = list(find_point_problems(table, meter, scenario.network, scenario.sigma_rule))
        problems += [f"{place}: {problem}" for problem in found]
        if not found:
            area = scenario.partition.area_of_meter(meter)
            points[table.address] = make_point(table, meter, area, scenario)
    return points, problems


def _find_foreign(name: str, points: Mapping[str, Point], scenario: Scenario) -> Iterator[str]:
    """The meters that the scenario gives to other gateways."""
    for point in points.values():
        own = scenario.reading_rules[point.area].meters_of(name)
        if own != "all" and point.meter.id not in own:
            yield (
                f"address {point.address!r}: meter {point.meter.id} of {point.area} is not that of gateway {name!r}; "
                f"in the scenario, add it to gateways.{name}, or remove this reading"
            )


def _find_meter_problems(table: ReadingTable, meters: Mapping[str, Meter], close: Suggestions) -> Iterator[str]:
    meter = meters.get(table.meter)
    if meter is None:
        parsed = parse_meter(table.meter)
        if isinstance(parsed, str):
            yield f"meter: {parsed}"
        else:
            yield f"meter {table.meter} is none of the scenario's [measurements]{close.find(table.meter)}"
    elif meter.source is Origin.VIRTUAL:
        yield f"meter {table.meter}: nothing is injected there, which the areas know; remove this reading"
