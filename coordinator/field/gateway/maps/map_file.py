"""A gateway's map: the meter behind each address of the source, checked as a whole against the scenario."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.messages.keys import check_run_id, default_run_id
from coordinator.field.gateway.interface import Sink, Source
from coordinator.field.gateway.maps.installed import load_sink, load_source
from coordinator.field.gateway.maps.map_tables import MapFile, ReadingTable
from coordinator.field.gateway.maps.points import Point, SwitchStatus, find_point_problems, make_point
from dsse_core.endpoints import find_problems_in
from dsse_core.errors import InvalidInputError
from dsse_core.files.strict_table import Table, fit_partly, load_partly
from dsse_core.files.wording import Suggestions
from dsse_core.grid.measurement import Meter, find_meter_problems
from dsse_core.grid.measurement import Source as Origin
from dsse_core.grid.network import Network
from dsse_core.grid.switches import name_status_meter
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
    """A checked map; ``points``: address -> the meter there and its unit. ``source``: None in a map of results only."""

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
        """True where this gateway numbers the scans of all areas."""
        return _leads(self.name, self.scenario)

    @property
    def areas(self) -> tuple[str, ...]:
        """The areas that get messages, in scenario order: those with a meter in the map; all if the gateway leads."""
        used = {point.area for point in self.points.values()}
        return tuple(area.name for area in self.scenario.partition.areas if area.name in used or self.leads)


def load_map(path: Path) -> GatewayMap:
    """Read and check a map file.

    Raises:
        InvalidInputError: every problem of the file: keys and types, scenario, addresses, meters, units, source and
            results. A part that depends on a wrong one, as the meters on the scenario, is not checked.
    """
    head = load_partly(path, MapFile)
    file, problems = head.table, [*head.problems, *head.table.find_problems(head.wrong)]
    name = "" if "name" in head.wrong else file.name
    if name in RESERVED - {"plant"}:
        problems.append(f"name: {name!r} belongs to a process of every run; choose another")
    problems += find_problems_in("connect", file.connect if "connect" not in head.wrong else ())
    run, source, scenario = "", None, None
    with _noted(problems):
        scenario = None if "scenario" in head.wrong else _load_scenario_of(file, path)
    with _noted(problems, "run: "):
        run = default_run_id(scenario.name) if file.run is None and scenario else check_run_id(file.run or "none")
    with _noted(problems):
        source = SourceOf(*load_source(file.source, path.parent)) if file.source is not None else None
    sinks = []
    for number, table in enumerate(file.results, start=1):
        place = f"results[{number}]"
        with _noted(problems):
            sinks.append(SinkOf(f"{place} ({table.get('kind')})", *load_sink(table, place, path.parent)))
    points = _make_points(file.reading, name, scenario, source.cls if source else None, problems)
    if scenario and _leads(name, scenario) and scenario.run.scan_s is None:
        problems.append(f"name: {name!r} is the scenario's telemetry.leader and numbers scans; give run.scan_s there")
    if problems or scenario is None:
        raise InvalidInputError(file.called(path), problems)
    return GatewayMap(
        path, name, run, scenario, tuple(file.connect), file.least_interval_s, source, points, tuple(sinks)
    )


@contextmanager
def _noted(problems: list[str], place: str = "") -> Iterator[None]:
    """Add the problems of an InvalidInputError to ``problems``, and continue after the block."""
    try:
        yield
    except InvalidInputError as error:
        problems += [f"{place}{problem}" for problem in error.problems]


def _leads(name: str, scenario: Scenario) -> bool:
    rules = scenario.common_rules
    return rules.ticks == "gateway" and rules.leader == name


def _load_scenario_of(file: MapFile, path: Path) -> Scenario:
    """The scenario that ``file`` names: a shipped one, or the file at a path relative to the folder of the map."""
    is_path = file.scenario.endswith((".toml", ".json")) or "/" in file.scenario
    try:
        return load_scenario(path.parent / file.scenario if is_path else file.scenario)
    except InvalidInputError as error:
        problems = [f"scenario: {error.what}: {problem}" for problem in error.problems]
        raise InvalidInputError(file.called(path), problems) from None


def _make_points(
    tables: Sequence[Mapping[str, Any]],
    name: str,
    scenario: Scenario | None,
    source: type[Source] | None,
    problems: list[str],
) -> dict[str, Point]:
    """Address -> its point; every problem is added to ``problems``. Without ``scenario`` there are no points.
    Without the gateway's ``name`` the meters are not checked against the scenario's gateways.
    """
    meters: dict[str, Meter | SwitchStatus] = {meter.id: meter for meter in scenario.meters} if scenario else {}
    meters |= {status.id: status for status in map(SwitchStatus, scenario.network.switches if scenario else ())}
    close = Suggestions(list(meters))
    points: dict[str, Point] = {}
    first_of: dict[tuple[str, str], int] = {}  # (key, value) -> number of the first table with it
    for number, content in enumerate(tables, start=1):
        place, fitted = f"reading[{number}]", fit_partly(ReadingTable, content)
        table, wrong = fitted.table, fitted.wrong
        problems += [f"{place}.{problem}" for problem in fitted.problems]
        found = list(table.find_problems(wrong))
        for key in sorted({"address", "meter"} - wrong):
            value = getattr(table, key)
            if (first := first_of.setdefault((key, value), number)) != number:
                found.append(f"{key} {value!r:.80} stands in reading[{first}] already; keep one")
        if source and "address" not in wrong and (problem := source.find_address_problem(table.address)):
            found.append(f"address {table.address!r:.80}: {problem}")
        if scenario and "meter" not in wrong:
            if unknown := list(_find_meter_problems(table, meters, scenario.network, close)):
                found += unknown
            else:
                meter = meters[table.meter]
                area = _find_area(meter, scenario)
                found += _find_foreign(name, meter, area, scenario)
                found += find_point_problems(table, wrong, meter, scenario.network, scenario.sigma_rule)
                if not (found or wrong):
                    points[table.address] = make_point(table, meter, area, scenario)
        problems += [f"{place}: {problem}" for problem in found]
    return points


def _find_area(meter: Meter | SwitchStatus, scenario: Scenario) -> str:
    """The area of a meter, or the one that holds a switch."""
    if isinstance(meter, Meter):
        return scenario.partition.area_of_meter(meter)
    return next(area.name for area in scenario.partition.areas if meter.switch in area.network.switches)


def _find_foreign(name: str, meter: Meter | SwitchStatus, area: str, scenario: Scenario) -> Iterator[str]:
    """A problem where the scenario assigns ``meter`` to other gateways."""
    own = scenario.reading_rules[area].meters_of(name) if name else "all"
    if own != "all" and meter.id not in own:
        yield (
            f"meter {meter.id} of {area} is not that of gateway {name!r}; in the scenario, add it to "
            f"gateways.{name}, or remove this reading"
        )


def _find_meter_problems(
    table: ReadingTable, meters: Mapping[str, Meter | SwitchStatus], network: Network, close: Suggestions
) -> Iterator[str]:
    meter = meters.get(table.meter)
    if meter is None and table.meter.startswith(name_status_meter("")):
        yield f"meter {table.meter} is the status of no switch of the scenario{close.find(table.meter)}"
    elif meter is None:
        parsed = parse_meter(table.meter)
        if isinstance(parsed, str):
            problems = [f"meter: {parsed}"]
        elif not (problems := list(find_meter_problems(network, [parsed]))):
            problems = [f"meter {table.meter} is none of the scenario's [measurements]{close.find(table.meter)}"]
        yield from problems
    elif isinstance(meter, Meter) and meter.source is Origin.VIRTUAL:
        yield f"meter {table.meter}: nothing is injected there, which the areas know; remove this reading"
