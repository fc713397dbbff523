"""Networks whose buses have phases, built in memory, and their areas in rounds of messages without a bus."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.estimation.decision import Decision, Memory, add_totals, decide
from dsse_core.exchange.area_estimation import AreaEstimation
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive, list_phases
from dsse_core.grid.partition import Partition
from dsse_core.linear.boundary_information import BoundaryInformation

KIND = MeasurementKind
Z = np.array([[0.0346 + 0.1018j, 0.0156 + 0.0502j, 0.0158 + 0.0424j]] * 3)  # of ieee13's configuration 601, p.u.
Z = np.triu(Z, 1) + np.triu(Z, 1).T + np.diag([0.0346 + 0.1018j, 0.0337 + 0.1048j, 0.0341 + 0.1035j])
ENOUGH = 60  # sweeps of the power flow
MOST_VERDICTS = 400  # of a scan, with all that is removed
NO_MESSAGES: dict[str, BoundaryInformation] = {}


def coupled_line(name: str, ends: tuple[int, int], phases: str, length: float = 1.0) -> Branch:
    """A line of ``phases`` whose conductors are coupled, with some charging."""
    chosen = ["abc".index(phase) for phase in phases]
    yi, k = np.linalg.inv(length * Z[np.ix_(chosen, chosen)]), len(chosen)
    charging = np.kron(np.eye(2), 1e-4j * (np.eye(k) - 0.1))
    primitive = Primitive(phases, phases, np.kron([[1, -1], [-1, 1]], yi) + charging, charging)
    return Branch(name, *ends, r=0.03 * length, x=0.1 * length, primitive=primitive)


def bank(name: str, ends: tuple[int, int], high: np.ndarray, taps: Sequence[float] = (1.0, 1.0, 1.0)) -> Branch:
    """A bank of three transformers to a grounded wye with ``taps``; ``high``: the phases across each high winding."""
    windings, z = np.hstack([high, -np.diag(1 / np.array(taps))]), 0.01 + 0.06j
    return Branch(
        name, *ends, z.real, z.imag, primitive=Primitive("abc", "abc", windings.T @ windings / z, np.zeros((6, 6)))
    )


WYE = np.eye(3)
DELTA = (np.eye(3) - np.roll(np.eye(3), -1, axis=0)) / np.sqrt(3)  # the low side leads by 30 degrees

BUSES = {650: "abc", 632: "abc", 645: "bc", 646: "bc", 671: "abc", 684: "ac", 611: "c", 692: "abc", 675: "abc"}
AREAS = {"head": [650, 632, 671], "two": [632, 645, 646], "west": [671, 684, 611], "east": [671, 692, 675]}
DEEP = AREAS | {"west": [671, 684], "one": [684, 611], "east": [671, 692], "bank": [692, 675]}
RING = {"head": [650, 632, 671, 692], "two": [632, 645, 646, 692], "west": [671, 684, 611], "bank": [692, 675]}
TIE = coupled_line("646-692", (646, 692), "bc", 0.25)  # closes the ring


def make_feeder(*ties: Branch, between: Mapping[int, Sequence[str]] | None = None) -> Network:
    """A source, a regulator, coupled lines, laterals of two phases and of one, and a delta-wye bank.

    ``between``: bus -> legs between phases, which stand there in place of those to ground.
    """
    lines = [
        *ties,
        bank("reg", (650, 632), WYE, (1.02, 1.01, 1.03)),
        coupled_line("632-671", (632, 671), "abc", 0.3),
        coupled_line("645-632", (645, 632), "bc", 0.1),
        coupled_line("645-646", (645, 646), "bc", 0.2),
        coupled_line("671-684", (671, 684), "ac", 0.1),
        coupled_line("684-611", (684, 611), "c", 0.2),
        coupled_line("671-692", (671, 692), "abc", 0.1),
        bank("692-675", (692, 675), DELTA),
    ]
    drawn = {645: "b", 646: "bc", 671: "abc", 611: "c", 675: "abc"} | dict(between or {})
    rng = np.random.default_rng(1)
    loads = [Load(bus, p, complex(*rng.uniform(0.05, 0.25, 2))) for bus, phases in drawn.items() for p in phases]
    buses = tuple(Bus(bus, 4.16, phases=phases) for bus, phases in BUSES.items())
    shunts = Shunt(671, "ab", 0.01 + 0.05j), Shunt(684, "c", 0.06j), Shunt(692, "a", 0.02j)
    source = Generator(650, Control.SLACK)
    return Network("feeder", 5.0, buses, tuple(lines), (source,), tuple(loads), shunts=shunts)


def solve(network: Network) -> np.ndarray:
    """x = [va; vm] under the network's loads, by sweeps."""
    vm, va = flat_start(network, 650)
    v, ybus = vm * np.exp(1j * va), build_admittance(network).ybus.toarray()
    given = network.nodes_at(650)
    free = np.setdiff1d(np.arange(network.n_nodes), given)
    for _ in range(ENOUGH):
        i = -(network.legs.draw(v) / v).conj()
        v[free] = np.linalg.solve(ybus[np.ix_(free, free)], i[free] - ybus[np.ix_(free, given)] @ v[given])
    return np.concatenate([np.angle(v), abs(v)])


def meter_injections(network: Network, bus: Bus) -> list[Meter]:
    """P and Q of each node, 0 exactly where no leg ends, or of a leg alone between two phases.

    With legs between phases only, the sum of the bus' currents is 0.
    """
    legs = [load.phases for load in network.loads if load.bus == bus.id]
    is_between, powers = legs and all(len(list_phases(leg)) == 2 for leg in legs), (KIND.P_INJECTION, KIND.Q_INJECTION)
    free, virtual = list_phases(bus.phases), Source.VIRTUAL
    meters = []
    if is_between:
        meters += [Meter(kind, bus.id, source=virtual) for kind in (KIND.I_REAL, KIND.I_IMAG)]
        if len(legs) == 1:
            meters += [Meter(kind, bus.id, phases=legs[0]) for kind in powers]
            free = [phase for phase in free if phase not in list_phases(legs[0])]
    ends = {phase for leg in legs for phase in list_phases(leg)}
    source = {phase: Source.TELEMETERED if phase in ends else virtual for phase in free}
    return meters + [Meter(kind, bus.id, phases=p, source=source[p]) for p in free for kind in powers]


def read_meters(network: Network, seed: int, decades: float, *, is_rich: bool) -> list[Measurement]:
    """Noisy readings of P and Q at each node, 0 exactly where no load is, of some flows, voltages and currents."""
    rng = np.random.default_rng(seed)
    places = [(bus.id, phase) for bus in network.buses if bus.id != 650 for phase in list_phases(bus.phases)]
    meters = [meter for bus in network.buses if bus.id != 650 for meter in meter_injections(network, bus)]
    meters += [Meter(KIND.VM, bus, phases=p) for bus in (650, 675) for p in "abc"] + [Meter(KIND.VM, 611, phases="c")]
    meters += [Meter(kind, 650, "reg", phases=p) for kind in (KIND.P_FLOW, KIND.Q_FLOW) for p in "abc"]
    if is_rich:
        flows = (KIND.P_FLOW, KIND.Q_FLOW, KIND.CURRENT)
        meters += [Meter(kind, 632, "645-632", phases=p) for kind in flows for p in "bc"]
        meters += [Meter(kind, 692, "692-675", phases=p) for kind in flows for p in "abc"]
        meters += [Meter(KIND.VM, bus, phases=p) for bus, p in places if bus in (632, 646, 684)]
        meters += [Meter(KIND.VM, 671, phases="bc"), Meter(KIND.CURRENT, 671, "671-684", phases="a")]
    z = build_measurement_model(network, build_admittance(network), meters).predict(solve(network))
    sigma = 1e-4 * 10 ** rng.uniform(0, decades, len(z))
    is_real = np.array([m.source is not Source.VIRTUAL for m in meters])
    z = np.where(is_real, z + sigma * rng.standard_normal(len(z)), 0.0)
    sigmas = np.where(is_real, sigma, 0.0)
    return [Measurement(m, *of) for m, *of in zip(meters, z.tolist(), sigmas.tolist(), strict=True)]


@dataclass
class Rounds:
    """What the areas have done: the verdicts, and after each the voltages x of all nodes as each area has them."""

    estimations: Mapping[str, AreaEstimation]
    verdicts: list[str]
    states: list[dict[str, np.ndarray]]
    memory: Memory


def run_rounds(
    partition: Partition,
    measurements: Sequence[Measurement],
    former: Rounds | None = None,
    gone: str = "",
    start: tuple[np.ndarray, np.ndarray] | None = None,
    last: Collection[Decision] = (Decision.FINAL,),
) -> Rounds:
    """One scan of all areas, each told what the areas beyond each neighbour say.

    ``former``: the scan before. ``gone``: an area without others beyond it that has fallen silent since. ``start``:
    (vm, va) of all nodes, where the areas begin. ``last``: the decisions after which the rounds end.
    """
    sides = {a.name: former.estimations[a.name] if former else AreaEstimation(a) for a in partition.areas}
    sides.pop(gone, None)
    by_area = partition.split_meters([m.meter for m in measurements])
    beside = {name: [n.area for n in side.area.neighbours if n.area != gone] for name, side in sides.items()}
    for name, side in sides.items():
        if start is not None:
            of_area = partition.rows_of_nodes[name]
            side.x = np.concatenate([start[1][of_area], start[0][of_area], side.x[2 * len(of_area) :]])
        silent = {n.area for n in side.area.neighbours} & {gone}
        side.begin([measurements[k] for k in by_area[name].tolist()], silent=silent, stale=False)

    def tell(sender: str, receiver: str, at_no_load: bool) -> BoundaryInformation:
        side = sides[sender]
        beyond = {name: tell(name, sender, at_no_load) for name in beside[sender] if name != receiver}
        told = side.no_load_for(receiver, beyond) if at_no_load else side.information_for(receiver, beyond)
        assert told is not None
        return told

    def hear(at_no_load: bool) -> dict[str, dict[str, BoundaryInformation]]:
        return {name: {other: tell(other, name, at_no_load) for other in others} for name, others in beside.items()}

    memory, found, no_messages = Memory(), Rounds(sides, [], [], Memory()), {name: NO_MESSAGES for name in sides}
    no_load = no_messages
    while len(found.verdicts) < MOST_VERDICTS:
        for name, side in sides.items():
            if side.area.parent:
                sides[side.area.parent.area].set_power(name, side.power_for(side.area.parent.area))
        memory, verdict = decide(memory, add_totals([side.totals() for side in sides.values()]))
        received = hear(at_no_load=False) if verdict.takes_step else no_messages
        if not gone and any(side.is_first for side in sides.values()):
            no_load = hear(at_no_load=True)
        for name, side in sides.items():
            side.carry_out(verdict, memory, received[name], no_load[name])
            assert not side.failure
        found.memory = memory
        found.verdicts.append(str(verdict))
        found.states.append({name: side.x[: 2 * side.area.network.n_nodes] for name, side in sides.items()})
        if verdict.decision in last:
            return found
        if verdict.decision is Decision.ANEW and not gone:
            no_load = hear(at_no_load=True)
    raise AssertionError(found.verdicts)
