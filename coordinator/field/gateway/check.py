"""``dsse gateway --check``: the readings of a source, meter by meter, and the mistakes that they suggest."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from coordinator.field.gateway import counts as reasons
from coordinator.field.gateway.counts import Counts
from coordinator.field.gateway.gateway import read_source
from coordinator.field.gateway.intake import Intake, Reading
from coordinator.field.gateway.maps.map_file import GatewayMap
from coordinator.field.gateway.maps.points import Point
from coordinator.field.gateway.plausibility import Read, Schedule, find_common_mistake, find_schedule, find_suspects
from coordinator.field.gateway.reconnection import Link
from coordinator.watch.tables import format_table
from dsse_core.errors import PowerFlowDivergedError
from dsse_core.grid.measurement import Meter, Source
from dsse_core.printable import listed, printable
from dsse_core.reading_rules import allowed_lead_s

MOST_ROWS = 200
MOST_NAMED = 12
NOTHING = "nothing is read"


@dataclass(frozen=True)
class CheckReport:
    """``text``: the report to print, with ``problems`` of the source, and ``remarks``: meter id -> remark."""

    text: str
    problems: Sequence[str] = ()
    remarks: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_sound(self) -> bool:
        """True where nothing looks wrong."""
        return not self.problems


def check_map(content: GatewayMap, duration_s: float) -> CheckReport:
    """Read the source of a map for ``duration_s``, or until it ends, publishing nothing."""
    if content.source is None:
        return CheckReport("the map has no [source]; nothing to read")
    lead_s = allowed_lead_s(content.scenario.run.scan_s)
    intake = Intake(content.points, time.time, lead_s, Counts(warn=_ignore))
    link = Link("source", warn=_ignore)
    asyncio.run(_read_for(duration_s, content, intake, link))
    newest = {meter: reading for part in intake.newest.values() for meter, reading in part.items()}
    return make_report(content, newest, _find_schedule(content), intake.counts, link.error)


def _ignore(_: str) -> None:
    """Log nothing: the report contains every count and error."""


async def _read_for(duration_s: float, content: GatewayMap, intake: Intake, link: Link) -> None:
    assert content.source
    try:
        async with asyncio.timeout(duration_s):
            await read_source(content.source, intake, link)
    except TimeoutError:
        pass


def _find_schedule(content: GatewayMap) -> dict[str, Schedule] | None:
    """Meter id -> its schedule, for the meters of the map; None where the scenario's loads have no power flow."""
    try:
        meters = [point.meter for point in content.points.values() if isinstance(point.meter, Meter)]
        return find_schedule(content.scenario.network, meters)
    except PowerFlowDivergedError:
        return None


def make_report(
    content: GatewayMap,
    newest: Mapping[str, Reading],
    schedule: Mapping[str, Schedule] | None,
    counts: Counts,
    error: str,
) -> CheckReport:
    """The report. ``newest``: meter id -> reading. ``error``: the reason that the source cannot be read, else empty."""
    reads = _find_reads(newest, schedule)
    suspects, unexplained = find_suspects(content.scenario.network, content.scenario.meters, reads)
    common = find_common_mistake(content.scenario.network, content.scenario.meters, reads) if reads else ""
    remarks = {
        point.meter.id: suspects.get(point.meter.id, "") if point.meter.id in newest else NOTHING
        for point in content.points.values()
    }
    wrong = [f"the source cannot be read: {error}"] if error else []
    wrong += [
        f"{reason}, {found.count} times: {listed(found.addresses, MOST_NAMED) or 'no address'}; last: {found.last}"
        for reason, found in sorted(counts.rejected.items())
        if reason not in (reasons.OLDER, reasons.TWICE)
    ]
    if unexplained:
        wrong.append(
            f"the powers at {listed(unexplained, MOST_NAMED)} do not add up, and no single sign or unit explains it"
        )
    if common:
        wrong.append(f"all powers, {common}: with them grid and loads do not fit, with that corrected they do")
    count = sum(map(bool, remarks.values()))
    if count:
        wrong.append(f"{count} of {len(remarks)} meters: see the remarks")
    others = _find_unmapped(content)
    notes = [f"not in this map: {len(others)} meters of the scenario: {listed(others, MOST_NAMED)}"] if others else []
    if schedule is None:
        notes.append("the scenario's loads have no power flow: nothing is compared with them")
    found = [f"wrong: {problem}" for problem in wrong] or ["nothing looks wrong"]
    text = "\n".join(
        [_format(content, newest, schedule or {}, remarks), "", *notes, *found, f"{counts.received} readings received"]
    )
    return CheckReport(text, wrong, {meter: remark for meter, remark in remarks.items() if remark})


def _find_reads(newest: Mapping[str, Reading], schedule: Mapping[str, Schedule] | None) -> dict[str, Read]:
    """Meter id -> its valid reading beside the schedule; empty without a schedule."""
    if schedule is None:
        return {}
    known = ((meter, found) for meter, found in newest.items() if found.valid and meter in schedule)
    return {meter: Read(found.value, found.sigma, schedule[meter]) for meter, found in known}


def _find_unmapped(content: GatewayMap) -> Sequence[str]:
    """The meters of the scenario, virtual ones excepted, that this map does not have."""
    mapped = {point.meter.id for point in content.points.values()}
    return [m.id for m in content.scenario.meters if m.source is not Source.VIRTUAL and m.id not in mapped]


def _format(
    content: GatewayMap, newest: Mapping[str, Reading], schedule: Mapping[str, Schedule], remarks: Mapping[str, str]
) -> str:
    """A table with a row for each meter, MOST_ROWS at most, meters with a remark first."""
    points = sorted(content.points.values(), key=lambda point: not remarks[point.meter.id])
    now = time.time()
    rows = [_row(point, newest.get(point.meter.id), schedule, now) for point in points]
    header = ("meter", "address", "unit", "reading", "schedule", "age s")
    lines = format_table(header, rows[:MOST_ROWS]).split("\n")
    column = ["remark", *(printable(remarks[point.meter.id]) for point in points[:MOST_ROWS])]
    more = [f"... and {len(rows) - MOST_ROWS} more meters"] if len(rows) > MOST_ROWS else []
    return "\n".join([*(f"{line}  {remark}".rstrip() for line, remark in zip(lines, column, strict=True)), *more])


def _row(point: Point, reading: Reading | None, schedule: Mapping[str, Schedule], now: float) -> tuple[str, ...]:
    scheduled = schedule[point.meter.id].value / point.size if point.meter.id in schedule else math.nan
    read = f"{reading.value / point.size:.5g}" + ("" if reading.valid else " (invalid)") if reading else "-"
    age = f"{max(0.0, now - reading.time):.1f}" if reading else "-"
    return (point.meter.id, point.address, point.unit, read, f"{scheduled:.5g}", age)
