"""Can the state be estimated from a scenario's meters, by a control centre and by each area?"""

from __future__ import annotations

from collections.abc import Sequence

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.measurement import MeasurementKind, Meter, Source
from dsse_core.network import Network
from dsse_core.observability import check_observable
from dsse_core.partition import Area
from scenarios.scenario import Scenario
from scenarios.telemetry import find_missing_local_slacks


def check_scenario(scenario: Scenario) -> None:
    """Check that all meters together observe the grid and, under ``angle-offset``, each area's own meters its part.

    Raises:
        InvalidInputError: naming every area and bus that is not observable, with a meter that would cure it, and
            every local slack voltage that is missing.
    """
    problems = find_missing_local_slacks(scenario)
    problems += _find_gaps("whole grid", scenario.network, scenario.meters, None)
    if scenario.strategy == "angle-offset":
        for area in scenario.partition.areas:
            own = [m for m in scenario.meters if scenario.partition.area_of_meter(m) == area.name]
            problems += _find_gaps(f"area {area.name}", area.network, meters_in_area(area, own), area.slack_bus)
    if problems:
        raise InvalidInputError(f"scenario {scenario.name!r}", problems)


def meters_in_area(area: Area, own: Sequence[Meter]) -> list[Meter]:
    """What the local estimator of ``area`` works with under ``angle-offset``, its ``own`` meters given.

    At boundary buses the load messages, P and Q pseudo-measurements, stand in for injection meters; an area without
    voltage meter gets its local slack voltage as a pseudo-measurement.
    """
    kind = MeasurementKind
    boundary = area.boundary_buses
    meters = [m for m in own if not (m.kind.of_injection and m.bus in boundary)]
    meters += [Meter(k, bus, source=Source.PSEUDO) for bus in boundary for k in (kind.P_INJECTION, kind.Q_INJECTION)]
    if not any(m.kind is kind.VM for m in meters):
        meters.append(Meter(kind.VM, area.slack_bus, source=Source.PSEUDO))
    return meters


def _find_gaps(place: str, network: Network, meters: Sequence[Meter], reference: int | None) -> list[str]:
    try:
        check_observable(network, meters, reference=reference)
    except NotObservableError as error:
        return [f"{place}: {error}"]
    return []
