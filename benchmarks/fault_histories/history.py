"""One seeded history of faults on the simulator: a small random feeder, faults of all kinds for a while, then none.

Its areas publish states all the while. Counted are the states marked good, and those of them that lie beyond three of
their own standard deviations of the estimate with fresh information: the centralised one of the same scan's readings.
Measured is the distance of the states from it in the end. Where switches are operated between scans, a good state must
lie near the estimate of one combination of statuses, and in the end of the true one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import cast

import numpy as np

from agents.area_files.area_file import stamp_split
from agents.messages.packing import StateMessage
from agents.protocol.configuration import Configuration
from agents.protocol.quality import GOOD
from benchmarks.fault_histories.switching import RTU, draw_orders, draw_statuses, draw_switches
from coordinator.lab.evaluation.comparison import Voltages
from coordinator.lab.simulator.simulator import SimulatedBus
from dsse_core.errors import DsseError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.partition import Partition
from dsse_core.grid.switches import take_fed
from dsse_core.link_faults import LinkFaults, Window
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.reading_rules import DEFAULT_RULES
from scenarios.files.network_file import load_case
from scenarios.generate.cutting import cut_into
from scenarios.generate.feeder import generate_feeder
from scenarios.telemetry import read_in_service, solve_with_supply

Link = tuple[str, str]
KIND = MeasurementKind
MOST_SIGMAS = 3.0
ROUNDING = 1e-9  # p.u. and rad: an angle that is known exactly has no sigma
GAP = 1e-8  # p.u. and rad: the fixed point is reached
HEARTBEAT_S = 0.2
FAULTS_S = 2.4  # time with faults
PATIENCE_S = 60.0  # afterwards
SCANS = 3
AREAS = {"ieee13": (3, 6), "ieee123": (6, 10)}  # fewest and most, of a feeder with phases


@dataclass(frozen=True, slots=True)
class HistoryOutcome:
    """``good``, ``wrong``: distinct states marked good, and those of them that lie too far off; ``states``: all.

    ``gap``: to the centralised estimate in the end, p.u. and rad; ``settled_s``: from the end of the faults until it is
    at most ``GAP`` with all areas good for the first time, nan if never. ``worst``: the largest distance of a good
    state, in its standard deviations.
    """

    seed: int
    areas: int
    buses: int
    states: int
    good: int
    wrong: int
    worst: float
    gap: float
    settled_s: float


@dataclass(frozen=True)
class World:
    """A feeder cut into areas; for every scan (numbered from 1) the readings and their centralised estimate."""

    network: Network
    partition: Partition
    telemetry: tuple[dict[str, list[Measurement]], ...]
    central: tuple[BadDataReport, ...]
    closed: tuple[Mapping[str, bool], ...] = ()  # of every scan the true statuses of switches
    _others: dict[tuple[object, ...], Voltages | None] = field(default_factory=dict, repr=False)

    def find_centres(self, scan: int) -> Iterator[Voltages]:
        """The centralised voltages of ``scan``, by the true statuses of switches first, then by all others."""
        yield _spread(self.network, self.central[scan - 1])
        for statuses in itertools.product((False, True), repeat=len(self.network.switches)):
            key = (scan, statuses)
            if key not in self._others:
                operated = self.network.operated(dict(zip(self.network.switches, statuses, strict=True)))
                readings = [m for part in self.telemetry[scan - 1].values() for m in part]
                try:
                    report = process_bad_data(*take_fed(operated, readings), tolerance=1e-11)
                except DsseError:
                    self._others[key] = None
                else:
                    self._others[key] = _spread(self.network, report)
            if (centre := self._others[key]) is not None:
                yield centre

    def files(
        self,
        links: Mapping[Link, LinkFaults],
        seed: int,
        strategy: str = "information",
        heartbeat_s: float = HEARTBEAT_S,
    ) -> list[Configuration]:
        """Area file of every area's agent, with every meter of the area that is read in any scan."""
        meters = {
            name: list(dict.fromkeys(m.meter for scan in self.telemetry for m in scan[name]))
            for name in self.telemetry[0]
        }
        files = [
            Configuration(
                run="history",
                area=area,
                meters=tuple(meters[area.name]),
                strategy=strategy,
                endpoints=("tcp/127.0.0.1:0",),
                beat_s=heartbeat_s,
                links={n.area: links[area.name, n.area] for n in area.neighbours},
                seed=seed,
                readings=replace(DEFAULT_RULES, gateways={**DEFAULT_RULES.gateways, RTU: "all"}),
            )
            for area in self.partition.areas
        ]
        return stamp_split(files, time=0.0)


def run_history(seed: int, phases: str = "", *, switching: bool = False) -> HistoryOutcome:
    """Draw and run one history. ``phases``: a shipped feeder with phases; empty for a random balanced one.
    ``switching``: with ties, and switches are operated between scans.
    """
    rng = np.random.default_rng(seed)
    world = draw_unbalanced_world(rng, phases, switching=switching) if phases else draw_world(rng, switching=switching)
    severity = float(rng.random())  # share of the possible faults that happen
    shown: list[StateMessage] = []
    links = [(area.name, n.area) for area in world.partition.areas for n in area.neighbours]
    cuts = _draw_cuts(rng, severity, links)
    drawn = {}
    for link in links:
        cut = cuts.get(frozenset(link))
        drawn[link] = _draw_link(rng, severity, (cut,) if cut else ())
    bus = SimulatedBus(world.files(drawn, seed), world.telemetry[0], lambda at, state: shown.append(state))
    times, restart = list[float](), cast(Callable[[str], None], bus.start)
    if world.closed:
        times = _draw_times(rng)
        restart = draw_orders(rng, severity, bus, world.closed, times).restart
    _draw_events(rng, severity, bus, world, times, restart)
    bus.run(FAULTS_S)
    settled_s = _wait_for_peace(bus, world)
    good = _evaluate(world, shown)
    return HistoryOutcome(
        seed=seed,
        areas=len(world.partition.areas),
        buses=len(world.network.buses),
        states=len({(s.header.sender, s.header.order) for s in shown}),
        good=len(good),
        wrong=sum(off > MOST_SIGMAS for off in good),
        worst=max(good, default=0.0),
        gap=find_gap(bus, world),
        settled_s=settled_s,
    )


def draw_world(rng: np.random.Generator, *, switching: bool = False) -> World:
    """3 to 6 areas of 3 to 8 buses; ``switching``: with up to 3 open ties, and 1 or 2 of its branches may be opened."""
    n_area = int(rng.choice([3, 4, 5, 6], p=[0.5, 0.25, 0.15, 0.1]))
    network, _ = generate_feeder(n_area * int(rng.integers(3, 9)), rng, lowest_vm=float(rng.uniform(0.92, 0.98)))
    return _read_world(rng, draw_switches(rng, network) if switching else network, n_area)


def draw_unbalanced_world(rng: np.random.Generator, name: str, *, switching: bool = False) -> World:
    """A shipped feeder with phases, cut at random: boundaries of one to three, at delta loads too; ``switching``: as of
    balanced ones.
    """
    (fewest, most), network = AREAS[name], load_case(name)
    n_area = int(rng.integers(fewest, most + 1))
    return _read_world(rng, draw_switches(rng, network) if switching else network, n_area)


def _read_world(rng: np.random.Generator, network: Network, n_area: int) -> World:
    """``network`` in ``n_area`` areas, with scans. Loads change from scan to scan.

    Readings of voltages and flows are missing now and then. Injections and one voltmeter are always read.
    """
    ties = {branch.id: "" for branch in network.branches if not branch.in_service}
    partition = build_partition(network, cut_into(network, n_area), holders=ties)
    meters = draw_meters(rng, network)
    closed: Mapping[str, bool] = network.switches
    of_scans: list[Mapping[str, bool]] = []
    missing = float(rng.choice([0.0, 0.0, 0.05]))
    voltmeter = next(m for m in meters if m.kind is MeasurementKind.VM)  # without any there is no estimate
    telemetry, central = [], []
    for _ in range(SCANS):
        loaded = _with_other_loads(rng, network)
        if of_scans and closed:
            closed = draw_statuses(rng, loaded, closed)
        of_scans.append(closed)
        flow = solve_with_supply(loaded.operated(closed))
        lasting = [m.source is Source.VIRTUAL or m.kind.of_injection for m in meters]
        spared = [lasts or rng.random() >= missing or m == voltmeter for m, lasts in zip(meters, lasting, strict=True)]
        kept = [m for m, stays in zip(read_meters(rng, meters, flow), spared, strict=True) if stays]
        central.append(process_bad_data(*take_fed(network.operated(closed), kept), tolerance=1e-11))
        by_area: dict[str, list[Measurement]] = {area.name: [] for area in partition.areas}
        for measurement in kept:
            by_area[partition.area_of_meter(measurement.meter)].append(measurement)
        telemetry.append(by_area)
    return World(network, partition, tuple(telemetry), tuple(central), tuple(of_scans) if closed else ())


def _spread(network: Network, report: BadDataReport) -> Voltages:
    """The voltages of all nodes, 0 where the estimate leaves them out as they have no supply."""
    result, vm, va = report.result, np.zeros(network.n_nodes), np.zeros(network.n_nodes)
    rows = [network.node(*node) for node in result.network.nodes]
    vm[rows], va[rows] = result.vm, result.va
    return Voltages(vm, va)


def find_gap(bus: SimulatedBus, world: World) -> float:
    """Largest distance of the published states to the centralised estimate of the last scan.

    Infinite where an area has no state of that scan.
    """
    gap = 0.0
    for name in bus.files:
        state = bus.states.get(name)
        if state is None or not state.buses or state.header.scan != SCANS:
            return math.inf
        dvm, dva = _distance(world, state, next(world.find_centres(SCANS)))
        gap = max(gap, float(dvm.max()), float(dva.max()))
    return gap


def _wait_for_peace(bus: SimulatedBus, world: World) -> float:
    while bus.now < FAULTS_S + PATIENCE_S:
        bus.run(HEARTBEAT_S)
        good = all(name in bus.states and bus.states[name].quality == GOOD for name in bus.files)
        if good and find_gap(bus, world) <= GAP:
            return bus.now - FAULTS_S
    return math.nan


def _evaluate(world: World, shown: list[StateMessage]) -> list[float]:
    """Largest distance of each distinct good state in its sigmas; a state that was good once counts once."""
    good = {(state.header.sender, state.header.order): state for state in shown if state.quality == GOOD}
    return [_sigmas_off(world, state) for state in good.values()]


def _sigmas_off(world: World, state: StateMessage) -> float:
    """The distance from the nearest estimate of one combination of statuses; those after one near enough are left."""
    least = math.inf
    for centre in world.find_centres(state.header.scan):
        least = min(least, _sigmas_off_one(world, state, centre))
        if least <= MOST_SIGMAS:
            break
    return least


def _sigmas_off_one(world: World, state: StateMessage, centre: Voltages) -> float:
    dvm, dva = _distance(world, state, centre)
    vm = np.maximum(dvm - ROUNDING, 0.0) / np.maximum(state.sigma_vm, 1e-12)
    va = np.maximum(dva - ROUNDING, 0.0) / np.maximum(state.sigma_va, 1e-12)
    return float(max(vm.max(), va.max()))


def _distance(world: World, state: StateMessage, central: Voltages) -> tuple[np.ndarray, np.ndarray]:
    rows = [world.network.node(*node) for node in state.nodes]
    turned = np.array(state.va) - central.va[rows]
    return abs(np.array(state.vm) - central.vm[rows]), abs((turned + np.pi) % (2 * np.pi) - np.pi)


def draw_meters(rng: np.random.Generator, network: Network) -> list[Meter]:
    """Meters of |V| at the substation and 40 % of the nodes, of flows on 60 % of the branches, of all injections."""
    assert network.slack is not None
    slack = network.slack.bus
    meters = [
        Meter(KIND.VM, bus, phases=_voltage_at(network, bus, phase))
        for bus, phase in network.nodes
        if bus == slack or rng.random() < 0.4
    ]
    for branch in network.active_branches:
        if rng.random() < 0.6:
            phases = list_phases(branch.primitive.from_phases if branch.primitive else "")
            of_ends = [(k, phase) for phase in phases for k in (KIND.P_FLOW, KIND.Q_FLOW)]
            meters += [Meter(k, branch.from_bus, branch.id, phases=phase) for k, phase in of_ends]
    for (bus, phase), scheduled in zip(network.nodes, network.scheduled.tolist(), strict=True):
        source = Source.VIRTUAL if scheduled == 0 and bus != slack else Source.TELEMETERED
        meters += [Meter(k, bus, source=source, phases=phase) for k in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    return meters


def _voltage_at(network: Network, bus: int, phase: str) -> str:
    """The phases of a voltmeter at a node: between it and the next phase where there is no ground."""
    if bus not in network.gauge.ungrounded:
        return phase
    phases = list_phases(network.bus(bus).phases)
    return phase + phases[(phases.index(phase) + 1) % len(phases)]


def _with_other_loads(rng: np.random.Generator, network: Network) -> Network:
    level = rng.uniform(0.6, 1.1)
    buses = []
    for bus in network.buses:
        factor = level * rng.lognormal(0.0, 0.3)
        buses.append(replace(bus, p_load=factor * bus.p_load, q_load=factor * bus.q_load))
    loads = [replace(load, s=level * rng.lognormal(0.0, 0.3) * load.s) for load in network.loads]
    return replace(network, buses=tuple(buses), loads=tuple(loads))


def read_meters(rng: np.random.Generator, meters: Sequence[Meter], flow: PowerFlowResult) -> list[Measurement]:
    """Readings with sigmas of 0.2 % (voltages), 1 % (flows) and 10 % (injections)."""
    readings = []
    for meter, value in zip(meters, read_in_service(flow, meters)[0].tolist(), strict=True):
        sigma = 0.002 if meter.kind is KIND.VM else (0.01 if meter.branch else 0.1) * (abs(value) + 0.001)
        if meter.source is Source.VIRTUAL:
            readings.append(Measurement(meter, 0.0, 0.0))
        else:
            readings.append(Measurement(meter, value + sigma * float(rng.standard_normal()), sigma))
    return readings


def _draw_link(rng: np.random.Generator, severity: float, cuts: tuple[Window, ...]) -> LinkFaults:
    if rng.random() >= severity:
        return LinkFaults(cuts=cuts)
    bursts = rng.random() < 0.3
    slow = rng.random() < 0.4
    return LinkFaults(
        loss=float(rng.choice([0.0, 0.1, 0.3, 0.6])),
        burst_enter=0.1 if bursts else 0.0,
        burst_leave=float(rng.uniform(0.1, 0.5)) if bursts else 1.0,
        delay_s=float(rng.uniform(0.0, 0.1)) if slow else 0.0,
        jitter_s=float(rng.uniform(0.0, 0.6)) if slow else 0.0,
        duplicate=float(rng.choice([0.0, 0.2])),
        corrupt=float(rng.choice([0.0, 0.0, 0.2])),
        until_s=FAULTS_S,
        cuts=cuts,
    )


def _draw_window(rng: np.random.Generator, longest: float) -> Window:
    start = float(rng.uniform(0.1, FAULTS_S - 0.2))
    return start, min(FAULTS_S, start + float(rng.uniform(0.1, longest)))


def _draw_cuts(rng: np.random.Generator, severity: float, links: Sequence[Link]) -> dict[frozenset[str], Window]:
    pairs = dict.fromkeys(frozenset(link) for link in links)  # in order: a set would shuffle the draws
    return {pair: _draw_window(rng, 1.5) for pair in pairs if rng.random() < 0.3 * severity}


def _draw_times(rng: np.random.Generator) -> list[float]:
    """The times of new scans."""
    times: list[float] = sorted(rng.uniform(0.5, FAULTS_S, SCANS - 1).tolist())
    return times


def _draw_events(
    rng: np.random.Generator,
    severity: float,
    bus: SimulatedBus,
    world: World,
    times: Sequence[float],
    restart: Callable[[str], None],
) -> None:
    """Kills and restarts, pauses, a silent plant, and new scans at ``times``, if given, late for some areas."""
    names = list(bus.files)
    for name in names:
        fate, (start, end) = rng.random(), _draw_window(rng, 1.0)
        if fate < 0.25 * severity:
            bus.at(start, partial(bus.kill, name))
            bus.at(end, partial(restart, name))
        elif fate < 0.4 * severity:
            bus.at(start, partial(bus.pause, name))
            bus.at(end, partial(bus.resume, name))
    if rng.random() < 0.2 * severity:
        start, end = _draw_window(rng, 1.0)
        bus.at(start, partial(setattr, bus, "plant_publishes", False))
        bus.at(end, partial(setattr, bus, "plant_publishes", True))
    for telemetry, at in zip(world.telemetry[1:], times or _draw_times(rng), strict=True):
        late_s = {name: float(rng.uniform(0.0, 0.5)) for name in names if rng.random() < 0.2 * severity}
        bus.at(at, partial(bus.next_scan, telemetry, late_s))
