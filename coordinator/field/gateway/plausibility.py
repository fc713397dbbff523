"""Test of a map's signs and units, by balances of power and by comparison with the schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dsse_core.errors import PowerFlowDivergedError
from dsse_core.exchange.gateway_mistakes import MISTAKES, THRESHOLD, GatewayTest
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Branch, Network
from dsse_core.grid.nodes import ROUNDING, list_phases, name_node
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.flows import build_branch_model

Node = tuple[int, str]  # bus and phase, "" in a balanced network
KIND = MeasurementKind
POWERS = ((KIND.P_INJECTION, KIND.P_FLOW, "P"), (KIND.Q_INJECTION, KIND.Q_FLOW, "Q"))
SHARE = 0.05  # of a balance's largest power: allowed error
LOSSES = 3.0  # further allowed error, in losses of the schedule: those of twice its currents
SIGMAS = 5.0
LIKE_SCHEDULE = 5.0  # largest ratio of a load to the schedule's, and of the schedule's to the load
LIKE_THOUSAND = 3.0  # a unit mistake: a thousand times the schedule, within this factor
LOWEST_VM, HIGHEST_VM = 0.8, 1.2  # p.u.
MOST_ANGLE = 0.5  # rad from the schedule
PUSHING = 0.1  # least ratio of the power that sources cause to the opposite power that loads cause
SIGNIFICANT = 0.02  # of the largest power of its kind; a smaller power may have any sign


@dataclass(frozen=True, slots=True)
class Schedule:
    """Value of a meter under the loads and sources of the network, p.u. or rad.

    ``can_turn``: True where other loads may reverse the sign, as sources there feed against the loads.
    """

    value: float
    can_turn: bool


@dataclass(frozen=True, slots=True)
class Read:
    """A meter's reading and its standard deviation, p.u. or rad, and its schedule."""

    value: float
    sigma: float
    schedule: Schedule

    @property
    def expected(self) -> float:
        return self.schedule.value


def find_schedule(network: Network, meters: Sequence[Meter]) -> dict[str, Schedule]:
    """Meter id -> its value under the schedule.

    Raises:
        PowerFlowDivergedError: the network's loads have no power flow.
    """
    expected, _ = read_exactly(solve_power_flow(network), meters)
    idle_buses = tuple(replace(bus, p_load=0.0, q_load=0.0) for bus in network.buses)
    try:
        idle, _ = read_exactly(solve_power_flow(replace(network, buses=idle_buses, loads=())), meters)
        by_loads = expected - idle
        can_turn = (idle * by_loads < 0) & (abs(idle) > PUSHING * abs(by_loads))
    except PowerFlowDivergedError:
        can_turn = np.full(len(meters), True)
    found = zip(meters, expected.tolist(), can_turn.tolist(), strict=True)
    return {meter.id: Schedule(value, turns) for meter, value, turns in found}


@dataclass(frozen=True, slots=True)
class Balance:
    """Powers that add up: ``terms``, meter id and sign of each, at ``place``, such as ``bus 4 (P)``."""

    place: str
    terms: tuple[tuple[str, int], ...]

    def find_excess(self, reads: Mapping[str, Read], changed: str = "", factor: float = 1.0) -> float:
        """Error of the balance beyond the allowed one, p.u.; not positive where the balance holds.

        The reading of meter ``changed`` counts ``factor`` times.
        """
        missed, loss, largest, variance = 0.0, 0.0, 0.0, 0.0
        for meter, sign in self.terms:
            read = reads[meter]
            value = read.value * (factor if meter == changed else 1.0)
            missed += sign * (value - read.expected)  # under the schedule it holds with its losses and charging
            loss += sign * read.expected
            largest = max(largest, abs(value))
            variance += read.sigma**2
        return abs(missed) - SHARE * largest - LOSSES * abs(loss) - SIGMAS * math.sqrt(variance)


def find_balances(network: Network, meters: Sequence[Meter], read: Iterable[str]) -> Iterator[Balance]:
    """The balances of each node and of the two ends of each conductor, where all their meters are ``read``."""
    known = set(read)
    virtual = {(meter.kind, meter.bus, meter.phases) for meter in meters if meter.source is Source.VIRTUAL}
    for injection, flow, letter in POWERS:
        ends: dict[tuple[int, str], list[tuple[str, int] | None]] = {node: [] for node in network.nodes}
        for here, there, branch in _list_conductors(network):
            at = {node: Meter(flow, node[0], branch.id, phases=node[1]).id for node in (here, there) if node}
            if here and there and at[here] in known and at[there] in known:
                name = f"{branch.id}.{here[1]}" if here[1] else branch.id
                yield Balance(f"branch {name} ({letter})", ((at[here], 1), (at[there], 1)))
            for node, end in ((here, there), (there, here)):
                other = at.get(end, "") if end else ""
                if node:
                    ends[node].append((at[node], -1) if at[node] in known else (other, 1) if other in known else None)
        for (bus, phase), terms in ends.items():
            own = Meter(injection, bus, phases=phase).id
            if (own in known or (injection, bus, phase) in virtual) and terms and None not in terms:
                flows = tuple(term for term in terms if term is not None)
                yield Balance(f"bus {name_node(bus, phase)} ({letter})", ((own, 1), *flows) if own in known else flows)


def _list_conductors(network: Network) -> Iterator[tuple[Node | None, Node | None, Branch]]:
    """The nodes that each conductor in service joins, and its branch.

    None for an end that it does not have, or at which the power of its phase is not that of the other end, as at a
    transformer between wye and delta: such a conductor is listed once for each end.
    """
    model, nodes = build_branch_model(network), network.nodes
    for k, f, t in zip(model.branch.tolist(), model.f.tolist(), model.t.tolist(), strict=True):
        branch = network.branches[k]
        if not branch.in_service:
            continue
        here, there = nodes[f] if f >= 0 else None, nodes[t] if t >= 0 else None
        if here and there and not _keeps_phases(branch):
            yield from ((here, None, branch), (None, there, branch))
        else:
            yield here, there, branch


def _keeps_phases(branch: Branch) -> bool:
    """True where the power of a phase at one end is that of the same phase at the other, but for losses."""
    if branch.primitive is None or branch.primitive.is_straight:
        return True
    y, ends = abs(branch.primitive.y), (branch.primitive.from_phases, branch.primitive.to_phases)
    here, there = (np.array(list_phases(phases)) for phases in ends)
    across = y[: len(here), len(here) :]
    return bool(across[here[:, None] != there].max(initial=0.0) <= ROUNDING * y.max())


def find_suspects(
    network: Network, meters: Sequence[Meter], reads: Mapping[str, Read]
) -> tuple[dict[str, str], list[str]]:
    """Meter id -> its likely mistake in words, and the places of balances that no single mistake explains.

    ``meters``: of the scenario. ``reads``: meter id -> its reading.
    """
    balances = list(find_balances(network, meters, reads))
    suspects, unexplained, corrected = _explain(balances, reads)
    kinds, is_balanced = {meter.id: meter.kind for meter in meters}, network.table.nodes.is_balanced
    largest: dict[MeasurementKind, float] = {}
    for meter, read in reads.items():
        largest[kinds[meter]] = max(largest.get(kinds[meter], 0.0), abs(read.expected))
    confirmed = _find_confirmed(balances, corrected)
    for meter, read in reads.items():
        if meter not in suspects:
            least = SIGNIFICANT * largest[kinds[meter]]
            words = _compare(kinds[meter], read, least, meter in confirmed, is_balanced=is_balanced)
            suspects |= {meter: words} if words else {}
    return suspects, unexplained


def find_common_mistake(network: Network, meters: Sequence[Meter], reads: Mapping[str, Read]) -> str:
    """The mistake that all powers have in common, in words; empty if there is none. Arguments as ``find_suspects``.

    This is an area's test of its gateways (``dsse_core/exchange/gateway_mistakes.py``), with the network as area.
    """
    if network.slack is None:
        return ""
    (grid,) = build_partition(network, {"grid": [bus.id for bus in network.buses]}).areas
    readings = [Measurement(m, reads[m.id].value, reads[m.id].sigma) for m in meters if m.id in reads]
    virtual = [Measurement(m, 0.0, 0.0) for m in meters if m.source is Source.VIRTUAL]
    found = GatewayTest(grid).weigh([*readings, *virtual], reads.keys(), None, {})
    factor = max(found, key=found.__getitem__, default=1.0)
    return MISTAKES[factor] if found.get(factor, 0.0) > THRESHOLD else ""


def _explain(
    balances: Sequence[Balance], reads: Mapping[str, Read]
) -> tuple[dict[str, str], list[str], dict[str, Read]]:
    """Meter id -> its mistake by balances, places of unexplained balances, and the readings with mistakes corrected.

    The likeliest mistake is corrected first, then the balances are tested again."""
    now = dict(reads)
    of_meter: dict[str, list[Balance]] = {}
    for balance in balances:
        for meter, _ in balance.terms:
            of_meter.setdefault(meter, []).append(balance)
    suspects: dict[str, str] = {}
    while missed := [balance for balance in balances if balance.find_excess(now) > 0]:
        found = [
            (gain, meter, factor)
            for meter in dict.fromkeys(meter for balance in missed for meter, _ in balance.terms)
            for factor in MISTAKES
            if meter not in suspects and (gain := _gain(of_meter[meter], now, meter, factor)) > 0
        ]
        if not found:
            break
        best = max(gain for gain, _, _ in found)
        first = next((meter, factor) for gain, meter, factor in found if gain == best)
        explained = [b for b in of_meter[first[0]] if b.find_excess(now) > 0 >= b.find_excess(now, *first)]
        equal = [
            (meter, factor)
            for gain, meter, factor in found
            if gain == best and any(meter in dict(balance.terms) for balance in explained)
        ]
        places = " and ".join(balance.place for balance in explained)
        for meter, factor in equal:
            others = [other for other, _ in equal if other != meter]
            instead = f", or that of {' or '.join(others)}" if others else ""
            suspects[meter] = f"{MISTAKES[factor]}{instead}: the powers at {places} do not add up"
        meter, factor = first
        read = now[meter]
        now[meter] = replace(read, value=read.value * factor)
    unexplained = [b.place for b in missed if not suspects.keys() & dict(b.terms).keys()]
    return suspects, unexplained, now


def _gain(balances: Sequence[Balance], reads: Mapping[str, Read], meter: str, factor: float) -> float:
    """Gain in balances of the meter that hold with its reading times ``factor``; 0.5 more if the schedule agrees.

    0 where no more balances hold than before."""
    held = sum(balance.find_excess(reads) <= 0 for balance in balances)
    holding = sum(balance.find_excess(reads, meter, factor) <= 0 for balance in balances)
    read = reads[meter]
    if holding <= held:
        return 0.0
    agrees = _is_like(factor * read.value, read.expected) and not _is_like(read.value, read.expected)
    return holding - held + 0.5 * agrees


def _find_confirmed(balances: Iterable[Balance], reads: Mapping[str, Read]) -> set[str]:
    """The meters whose sign a balance confirms: the balance holds, and fails with the opposite sign."""
    return {
        meter
        for balance in balances
        if balance.find_excess(reads) <= 0
        for meter, _ in balance.terms
        if balance.find_excess(reads, meter, -1.0) > 0
    }


def _is_like(value: float, expected: float) -> bool:
    """True where ``value`` has the sign of the schedule and its size within a factor of LIKE_SCHEDULE."""
    return expected != 0 and 1 / LIKE_SCHEDULE <= value / expected <= LIKE_SCHEDULE


def _compare(kind: MeasurementKind, read: Read, least: float, is_confirmed: bool, *, is_balanced: bool) -> str:
    """Likely mistake of a reading by comparison with the schedule, in words; empty if there is none."""
    if kind is KIND.VM:
        return _compare_voltage(read.value if is_balanced else read.value / read.expected, is_balanced=is_balanced)
    if kind is KIND.VA:
        off = math.pi - (math.pi - (read.value - read.expected)) % (2 * math.pi)
        return f"unit deg or rad, or reference: {off:.3g} rad from the schedule" if abs(off) > MOST_ANGLE else ""
    if abs(read.expected) <= max(least, SIGMAS * read.sigma):
        return ""
    for factor, words in MISTAKES.items():
        is_turned = factor < 0 and not (is_confirmed or read.schedule.can_turn) and _is_like(-read.value, read.expected)
        times = abs(factor * read.value / read.expected)
        is_scaled = factor > 0 and 1 / LIKE_THOUSAND <= times <= LIKE_THOUSAND
        if is_turned or is_scaled:
            return f"{words}: the schedule has {read.expected / read.value:.3g} times this"
    return ""


def _compare_voltage(vm: float, *, is_balanced: bool) -> str:
    """Likely mistake of a voltage of ``vm`` p.u.; with phases, to ground or between two, ``vm`` of the schedule's."""
    if vm == 0 or LOWEST_VM <= vm <= HIGHEST_VM:
        return ""  # a dead voltmeter reads 0, which is no mistake of the map
    known = {
        1 / math.sqrt(3): "line to neutral? then factor = 1.732",
        1e3: "V in place of kV?",
        1e-3: "kV in place of V?",
    }
    if not is_balanced:
        known[math.sqrt(3)] = "line to line? then factor = 0.577"
    hint = next((words for times, words in known.items() if LOWEST_VM <= vm / times <= HIGHEST_VM), "")
    unit = "p.u." if is_balanced else "times the schedule"
    return f"unit or base voltage: {vm:.3g} {unit}" + (f"; {hint}" if hint else "")
