"""Rules of each area for its readings, from a scenario: gateways that read its meters, intervals, and limits of age."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase

from dsse_core.files.wording import describe_unknown
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.partition import Partition
from dsse_core.grid.switches import name_status_meter
from dsse_core.reading_rules import ANYBODY, LEADER, NO_RULE, KindRule, MetersOf, ReadingRules
from scenarios.files.scenario_file import AngleMeterTable, GatewayTable, ScenarioFile, SigmaTable


def build_kind_rules(file: ScenarioFile) -> dict[MeasurementKind, KindRule]:
    """Kind of meter -> its rule, where it has one."""
    rules = {key: _rule_of(getattr(file.measurements, key)) for key in file.measurements.kinds}
    return {kind: rule for key, rule in rules.items() if rule != NO_RULE for kind in MeasurementKind.of_table(key)}


def _rule_of(table: SigmaTable | AngleMeterTable) -> KindRule:
    if isinstance(table, AngleMeterTable):
        limits = [None if limit is None else math.radians(limit) for limit in (table.lowest_deg, table.highest_deg)]
    else:
        limits = [table.lowest_pu, table.highest_pu]
    return KindRule(table.period_s, table.aging_s, table.oldest_s, *limits)


def build_reading_rules(file: ScenarioFile, partition: Partition, meters: Sequence[Meter]) -> dict[str, ReadingRules]:
    """Area -> the rules of its readings."""
    kinds, telemetry = build_kind_rules(file), file.telemetry
    always: dict[str, MetersOf] = {} if telemetry.source == "live" else {LEADER: "all"}
    if not file.gateways:
        always |= {ANYBODY if telemetry.source == "live" else telemetry.leader: "all"}
    ids = _ids_by_area(partition, meters) if any(table.meters for table in file.gateways.values()) else {}
    rules = {}
    for area in partition.areas:
        own = {
            name: _meters_of(table, ids.get(area.name, []))
            for name, table in file.gateways.items()
            if table.areas is None or area.name in table.areas
        }
        rules[area.name] = ReadingRules(telemetry.numbered_by, telemetry.leader, always | own, kinds)
    return rules


def _meters_of(table: GatewayTable, ids: Sequence[str]) -> MetersOf:
    if table.meters is None:
        return "all"
    return tuple(meter_id for meter_id in ids if any(fnmatchcase(meter_id, pattern) for pattern in table.meters))


def _ids_by_area(partition: Partition, meters: Sequence[Meter]) -> dict[str, list[str]]:
    """Area -> the ids of its meters, and of the statuses of its switches."""
    by_area = partition.meters_by_area(meters)
    return {
        area.name: [
            *(meter.id for meter in by_area[area.name] if meter.source is not Source.VIRTUAL),
            *map(name_status_meter, area.network.switches),
        ]
        for area in partition.areas
    }


def find_gateway_remark(rules: Mapping[str, ReadingRules]) -> str:
    """A remark that with keys no gateway but ``LEADER`` may send readings, and its cure; empty without ``ANYBODY``.

    A key belongs to a name, and ``ANYBODY`` is the name of no gateway. ``rules``: area -> rules of its readings.
    """
    if not any(ANYBODY in of_area.gateways for of_area in rules.values()):
        return ""
    return (
        'telemetry.source is "live" and there is no [gateways.NAME]: without keys any gateway may send readings, with '
        f"keys no gateway but {LEADER} may; for keys, add a table [gateways.NAME] for each gateway first"
    )


def find_gateway_problems(file: ScenarioFile, partition: Partition, meters: Sequence[Meter]) -> Iterator[str]:
    """Gateways of unknown areas, patterns that fit no meter, unread meters, and a leader that is no gateway."""
    gateways = file.gateways
    if not gateways:
        return
    names, ids = [area.name for area in partition.areas], _ids_by_area(partition, meters)
    read: dict[str, set[str]] = {name: set() for name in names}
    for gateway, table in gateways.items():
        for name in (unknown := [name for name in table.areas or () if name not in names]):
            yield f"gateways.{gateway}.areas: {describe_unknown('area', name, names)}"
        own = [name for name in table.areas or names if name not in unknown]
        for name in own:
            matched = _meters_of(table, ids[name])
            read[name] |= set(ids[name] if matched == "all" else matched)
        of_all = [meter_id for name in own for meter_id in ids[name]]
        for pattern in table.meters or ():
            if not unknown and not any(fnmatchcase(meter_id, pattern) for meter_id in of_all):
                yield f"gateways.{gateway}.meters: {pattern!r} is no meter of its areas, nor a pattern that one fits"
    has_plant = file.telemetry.source != "live"
    known = sorted({*gateways, LEADER} if has_plant else gateways)
    if file.telemetry.numbered_by == "gateway" and file.telemetry.leader not in known:
        yield f"telemetry.leader: {describe_unknown('gateway', file.telemetry.leader, known)}"
    if has_plant:
        return  # the plant reads all meters
    for name in names:
        statuses = set(map(name_status_meter, partition.network.switches))  # without a gateway the operator gives them
        if unread := [meter_id for meter_id in ids[name] if meter_id not in read[name] | statuses]:
            count = f" and {len(unread) - 1} more" if len(unread) > 1 else ""
            yield f"gateways: no gateway reads meter {unread[0]}{count} of {name}; add a pattern to one of them"
