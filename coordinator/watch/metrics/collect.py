"""A watcher's view of a run as metrics of Prometheus, and its health and readiness. No bus, no clock."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric

from agents.messages.packing import StateMessage
from agents.protocol.quality import NONE, QUALITIES, STALE
from coordinator.watch.observe.grid_tables import GridTables, find_tables
from coordinator.watch.observe.summary import Power, Summary, summarise
from coordinator.watch.observe.view import AreaView, View
from coordinator.watch.observe.watcher import Watcher

LOOKED_LATELY_S = 10.0  # an older sight means that the loop of the watching process is stuck


@dataclass(frozen=True)
class Observation:
    """A watcher's knowledge at time ``at``, s. ``view``: None before the watcher has reached the bus, and ``watcher``:
    as it was then. ``trouble``: the reason that it is not on the bus now, empty if it is."""

    at: float
    view: View | None = None
    watcher: Watcher | None = None
    trouble: str = "has not reached the bus yet"

    def find_illness(self, now: float) -> tuple[str, ...]:
        """Reasons that the watcher itself sees nothing at ``now``; empty if it sees the bus."""
        age = now - self.at
        stuck = (f"has not looked for {age:.0f} s",) if age > LOOKED_LATELY_S else ()
        return (*stuck, self.trouble) if self.trouble else stuck

    def find_obstacles(self, now: float) -> tuple[str, ...]:
        """Reasons that not every area seen so far has a fresh state, in words; empty if each has."""
        areas = self.view.areas if self.view else ()
        missing = () if areas else ("no area has been seen",)
        return (*self.find_illness(now), *missing, *(f"{a.name} {why}" for a in areas if (why := _find_lack(a))))


def _find_lack(area: AreaView) -> str:
    """Reason that the state of ``area`` is not fresh; empty if it is."""
    if not area.present or area.silent or area.age_s is None:
        return f"is {area.state}"
    if area.quality not in (STALE, NONE):
        return ""
    return f"is {area.quality}: {area.notes[0]}" if area.notes else f"has no state yet: {area.state}"


def format_health(why_not: Iterable[str]) -> tuple[int, str]:
    """HTTP status and JSON body of a page: 200 without reasons in ``why_not``, else 503 with them."""
    reasons = list(why_not)
    return (503 if reasons else 200), json.dumps({"ok": not reasons, "why": reasons}) + "\n"


GAUGES = {
    "present": "Whether the area's process is on the bus",
    "scan": "Number of the scan of the newest state",
    "state_age_seconds": "Since the newest state was received",
    "telemetry_age_seconds": "Since the area received telemetry",
    "fresh": "1 where the area's numbers are of the present; its voltages, J and mismatches are absent otherwise",
    "oldest_reading_seconds": "Age of the oldest reading in use",
    "incarnation_start_seconds": "When the area's process began, since 1970",
    "removed_meters": "Meters removed as bad data",
    "meters_off": "Meters that the operator has switched off",
    "objective": "Weighted sum of squared residuals J",
    "degrees_of_freedom": "Redundancy of the readings behind J",
    "voltage_lowest_pu": "Lowest estimated voltage",
    "voltage_highest_pu": "Highest estimated voltage",
    "mismatch_voltage_pu": "Largest difference to a neighbour at a bus that both estimate",
    "mismatch_angle_degrees": "The same of the angle",
}
GAUGES_BY_PHASE = {
    "phase_voltage_lowest_pu": "Lowest estimated voltage of a phase",
    "phase_voltage_highest_pu": "Highest estimated voltage of a phase",
}
COUNTERS = {
    "messages": "Messages handed to the bus by this incarnation",
    "bytes": "Bytes of these",
    "lost": "Of these, dropped by the injected faults of links",
    "exchanges": "Exchanges with the neighbours",
}
GRID = {
    "numbers": "Buses, meters in use or branches in service, or phases of these, of which it could be known",
    "known": "Of these, those with a fresh number",
    "outside_limits": "Of these, those beyond the limits of operation",
    "lowest": "Smallest fresh number",
    "highest": "Largest fresh number",
}
POWERS = {
    "power_kw": "Sum of the known parts: injection of the substation, losses, loads, generation",
    "reactive_power_kvar": "The same of the reactive power",
    "power_parts": "Branches in service, or buses; with phases each of theirs",
    "power_parts_known": "Of these, those with a fresh number",
}
GAUGES_BY_NEIGHBOUR = {
    "neighbour_age_seconds": "Since the newest information of a neighbour",
    "clock_skew_seconds": "By how much the clock of a neighbour is ahead of the area's",
}


class RunCollector:
    """Collector of ``prometheus_client`` for ``sight``, which the page replaces at each look.

    ``known``: the grid, if its scenario is known.
    """

    def __init__(self, known: GridTables | None = None) -> None:
        self.known = known
        self.sight = Observation(float("-inf"))

    def collect(self) -> Iterator[Metric]:
        """All metrics of the newest sight."""
        sight = self.sight
        yield GaugeMetricFamily("dsse_bus_reachable", "Whether the watcher is on the bus", float(not sight.trouble))
        if sight.view is None or sight.watcher is None:
            return
        yield from _list_others(sight.view)
        yield from _list_areas(sight.view, sight.watcher)
        tables = find_tables(sight.watcher, sight.view, self.known)
        yield from _list_summary(summarise(tables, self.known))


PROCESS = ["role", "name"]


def _list_others(view: View) -> Iterator[Metric]:
    info = GaugeMetricFamily("dsse_run", "1, of the run that is watched", labels=["run"])
    info.add_metric([view.run], 1.0)
    others = GaugeMetricFamily("dsse_process_present", "1 while a process that is no area is there", labels=PROCESS)
    for other in view.others:
        others.add_metric(other.split(" ", 1), 1.0)
    gateways = sum(other.split(" ", 1)[0] in ("gateway", "plant") for other in view.others)
    yield from (info, others, GaugeMetricFamily("dsse_gateways_alive", "Gateways and plants on the bus", gateways))
    text = "Areas that are announced beside those that are shown"
    yield GaugeMetricFamily("dsse_areas_not_shown", text, view.strangers)
    yield GaugeMetricFamily("dsse_duplicates", "Areas or plants that run more than once", len(view.duplicates))


def _list_summary(summary: Summary) -> Iterator[Metric]:
    """Metrics of the whole grid; quantities without a number that could be known are absent."""
    extents = {
        "voltage_pu": summary.voltage,
        "normalised_residual": summary.residual,
        "loading_percent": summary.loading,
        "current_a": summary.current,
        "unbalance_percent": summary.unbalance,
    }
    powers = {"head": summary.head, "loss": summary.loss, "load": summary.load, "generation": summary.generation}
    of_extent = {name: GaugeMetricFamily(f"dsse_grid_{name}", text, labels=["quantity"]) for name, text in GRID.items()}
    of_power = {name: GaugeMetricFamily(f"dsse_grid_{name}", text, labels=["part"]) for name, text in POWERS.items()}
    for quantity, extent in extents.items():
        ends = {"lowest": extent.lowest, "highest": extent.highest}
        numbers: dict[str, float] = {"known": extent.known, "numbers": extent.total, "outside_limits": extent.outside}
        numbers |= {name: end.value for name, end in ends.items() if end is not None}
        for name, number in numbers.items() if extent.total else ():
            of_extent[name].add_metric([quantity], number)
    for part, power in powers.items():
        for name, number in _numbers_of_power(power).items():
            of_power[name].add_metric([part], number)
    yield from (*of_extent.values(), *of_power.values())


def _numbers_of_power(power: Power) -> dict[str, float]:
    if not power.total:
        return {}
    known: dict[str, float | None] = {"power_kw": power.p_kw, "reactive_power_kvar": power.q_kvar}
    known |= {"power_parts_known": power.known, "power_parts": power.total}
    return {name: number for name, number in known.items() if number is not None}


def _list_areas(view: View, watcher: Watcher) -> Iterator[Metric]:
    """Metrics of all areas; quantities that an area has never published, or that are not fresh, are absent."""
    gauges = {name: GaugeMetricFamily(f"dsse_area_{name}", text, labels=["area"]) for name, text in GAUGES.items()}
    counters = {
        name: CounterMetricFamily(f"dsse_area_{name}", text, labels=["area"]) for name, text in COUNTERS.items()
    }
    by_neighbour = {
        name: GaugeMetricFamily(f"dsse_area_{name}", text, labels=["area", "neighbour"])
        for name, text in GAUGES_BY_NEIGHBOUR.items()
    }
    by_phase = [
        GaugeMetricFamily(f"dsse_area_{name}", text, labels=["area", "phase"]) for name, text in GAUGES_BY_PHASE.items()
    ]
    quality = GaugeMetricFamily("dsse_area_quality", "1 for the quality that the state has", labels=["area", "quality"])
    rejected = CounterMetricFamily("dsse_area_rejected", "Payloads rejected, by reason", labels=["area", "reason"])
    for area in view.areas:
        state = watcher.state_of(area.name)
        for name, number in _numbers_of(area, state).items():
            gauges[name].add_metric([area.name], number)
        for word in QUALITIES:
            quality.add_metric([area.name, word], float(word == area.quality))
        if state is None:
            continue
        of_phases = _find_voltages(state) if area.freshness.fresh else {}
        for phase, ends in of_phases.items():
            for gauge, number in zip(by_phase, ends, strict=True):
                gauge.add_metric([area.name, phase], number)
        for name, number in _counts_of(area).items():
            counters[name].add_metric([area.name], number)
        for reason, count in sorted(area.rejected.items()):
            rejected.add_metric([area.name, reason], count)
        skews = state.clock_skews if area.present and not area.silent else {}  # which have no age
        for name, numbers in (("neighbour_age_seconds", area.ages_s), ("clock_skew_seconds", skews)):
            for neighbour, number in sorted(numbers.items()):
                by_neighbour[name].add_metric([area.name, neighbour], number)
    yield from (*gauges.values(), quality, *counters.values(), rejected, *by_neighbour.values())
    yield from (gauge for gauge in by_phase if gauge.samples)  # none of balanced networks


def _find_voltages(state: StateMessage) -> dict[str, tuple[float, float]]:
    """Phase -> its lowest and highest voltage, p.u.; empty in a balanced network."""
    of_phase: dict[str, list[float]] = {}
    for phase, vm in zip(state.phases, state.vm, strict=False):
        of_phase.setdefault(phase, []).append(vm)
    return {phase: (min(values), max(values)) for phase, values in of_phase.items()}


def _numbers_of(area: AreaView, state: StateMessage | None) -> dict[str, float]:
    """Gauges of one area, without unknown ones."""
    is_fresh = area.freshness.fresh
    known = {"present": float(area.present), "fresh": float(is_fresh), "state_age_seconds": area.age_s}
    if state is not None:
        known |= {
            "scan": area.scan,
            "telemetry_age_seconds": area.telemetry_age_s,
            "oldest_reading_seconds": area.oldest_reading_s,
            "incarnation_start_seconds": state.header.incarnation.start_ms / 1000,
            "removed_meters": len(area.removed),
            "meters_off": len(state.meters_off),
        }
    if state is not None and is_fresh:
        known |= {
            "mismatch_voltage_pu": area.mismatch_vm_pu,
            "mismatch_angle_degrees": area.mismatch_va_deg,
            "objective": state.objective,
            "degrees_of_freedom": state.degrees_of_freedom,
            "voltage_lowest_pu": min(state.vm),
            "voltage_highest_pu": max(state.vm),
        }
    return {name: float(number) for name, number in known.items() if number is not None}


def _counts_of(area: AreaView) -> dict[str, float]:
    return {"messages": area.messages, "bytes": area.bytes, "lost": area.lost, "exchanges": area.exchanges}
