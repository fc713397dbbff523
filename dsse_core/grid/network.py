"""The network model: buses, branches and generators of a grid, in per unit and radians.

Sign conventions, here and everywhere inside the package:
loads are positive when they consume, generators when they produce, injections when power enters the
network at the bus, branch flows when power leaves the metered bus into the branch.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import repeat

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.columns import Records, read_given
from dsse_core.grid.gauge import Gauge, find_gauge
from dsse_core.grid.loads import GROUND, Legs, Load, Shunt, find_nominal
from dsse_core.grid.network_table import NetworkTable, tabulate
from dsse_core.grid.nodes import PHASES, Primitive, explain_phases, list_phases, name_node, read_phases
from dsse_core.printable import listed

ZERO_IMPEDANCE = 1e-6
"""A branch below this share of the median |r + jx| counts as without impedance. The power through it is a difference of
nearly equal numbers, so that estimates lose digits: measured, they agree to 1e-8 p.u. down to this ratio and to 3.5e-6
at 6e-8."""
ZERO_LINE = 1e-4
"""The share for lines with phases, such as switches and jumpers. Banks have ``ZERO_IMPEDANCE``, and need it: regulators
have 1e-4 of the impedance of lines."""


class Control(StrEnum):
    """The quantities that a generator holds: the reference voltage, its active power and voltage, or its P and Q."""

    SLACK = "slack"
    VOLTAGE = "voltage"
    POWER = "power"


@dataclass(frozen=True, slots=True)
class Bus:
    """A bus. ``p_load``, ``q_load`` in p.u.; ``g_shunt``, ``b_shunt`` in p.u. at 1 p.u. voltage.

    ``x``, ``y``: its place on a map, to the east and to the north, in any unit; None where it is not known.
    ``phases``: "" in a balanced network, else such as "abc" or "s1s2", a node each (``nodes.py``).
    """

    id: int
    base_kv: float
    name: str = ""
    p_load: float = 0.0
    q_load: float = 0.0
    g_shunt: float = 0.0
    b_shunt: float = 0.0
    x: float | None = None
    y: float | None = None
    phases: str = ""

    @property
    def has_shunt(self) -> bool:
        return self.g_shunt != 0.0 or self.b_shunt != 0.0


@dataclass(frozen=True, slots=True)
class Branch:
    """A line or transformer: series ``r + jx``, total charging ``b`` and leakage or iron losses ``g``, in p.u.

    Half of ``g + jb`` stands at each end. The tap stands at the from side, MATPOWER's convention: without load
    ``v_to = v_from / (tap * exp(j * shift))``; ``shift`` in rad. The rating, where it is known: ``i_max``, the current
    at either end, or ``s_max``, the apparent power, p.u. Where buses have phases ``primitive`` is the branch, and
    ``r``, ``x`` are its size alone, by which impedances near zero are found. ``switch``: it may be opened and closed
    while areas run, and ``in_service`` is its status until then. ``tap_steps``: by how much one step of the tap changer
    changes ``tap``; 0 where the tap is fixed. ``estimate_tap``: ``tap`` is where the estimate of the tap begins.
    """

    id: str
    from_bus: int
    to_bus: int
    r: float
    x: float
    b: float = 0.0
    tap: float = 1.0
    shift: float = 0.0
    in_service: bool = True
    g: float = 0.0
    name: str = ""
    i_max: float | None = None
    s_max: float | None = None
    primitive: Primitive | None = None
    switch: bool = False
    tap_steps: float = 0.0
    estimate_tap: bool = False

    def other_end(self, bus: int) -> int:
        return self.to_bus if bus == self.from_bus else self.from_bus


@dataclass(frozen=True, slots=True)
class Generator:
    """A source at a bus. ``p``, ``q``: scheduled production; ``vm``, ``va``: set-points of SLACK and VOLTAGE."""

    bus: int
    control: Control
    p: float = 0.0
    q: float = 0.0
    vm: float = 1.0
    va: float = 0.0


@dataclass(frozen=True, repr=False)
class Network:
    """Buses, branches and generators. At most one generator is the slack; an area's part may have none.

    Buses and branches are tuples, or columns: ``Records(Bus, {"id": ..., "base_kv": ...})``, whose objects are made on
    request only.

    Raises:
        InvalidInputError: listing every duplicate, dangling reference and impossible value.
    """

    name: str
    base_mva: float
    buses: Sequence[Bus]
    branches: Sequence[Branch]
    generators: tuple[Generator, ...] = ()
    loads: tuple[Load, ...] = ()  # of buses with phases, whose ``p_load`` and ``q_load`` are 0
    gauge_of_whole: Gauge | None = None  # of a part of a network, which does not see what grounds it
    shunts: tuple[Shunt, ...] = ()  # of some phases of buses; those of all phases alike are of the ``Bus``
    dead: tuple[int, ...] = ()  # rows of nodes without supply, where no current flows; see ``supplied``

    def __post_init__(self) -> None:
        if problems := list(_find_problems(self)):
            raise InvalidInputError(f"network {self.name!r}", problems)

    def __repr__(self) -> str:
        closed, generators = len(self.table.active), len(self.generators)
        return (
            f"<Network {self.name!r}: {len(self.buses)} buses, {closed} of {len(self.branches)} branches in service, "
            f"{generators} generators, base {self.base_mva:g} MVA>"
        )

    @cached_property
    def table(self) -> NetworkTable:
        """All buses and branches as columns."""
        return tabulate(self.buses, self.branches, self.shunts, self.dead)

    @cached_property
    def branch_ids(self) -> Sequence[str]:
        """Ids of all branches, in the order of ``branches``."""
        if isinstance(self.branches, Records):
            ids: Sequence[str] = self.branches.columns["id"]
            return ids
        return [branch.id for branch in self.branches]

    @cached_property
    def active_branch_ids(self) -> Sequence[str]:
        """Ids of the branches in service, in the order of the rows of the branch admittances."""
        return [self.branch_ids[k] for k in self.table.active.tolist()]

    @cached_property
    def row(self) -> dict[int, int]:
        """Bus id -> array position; ``table.rows`` finds the positions of arrays of ids."""
        return {bus: row for row, bus in enumerate(self.table.bus_id.tolist())}

    @cached_property
    def gauge(self) -> Gauge:
        """The buses whose voltages to ground are by a gauge, and those that hold its shunts; none if balanced."""
        if self.gauge_of_whole is not None:
            return self.gauge_of_whole
        return find_gauge(self.table, None if self.slack is None else self.table.rows.row_of(self.slack.bus))

    @property
    def n_nodes(self) -> int:
        """The number of nodes, each with one voltage: of buses where the network is balanced."""
        return len(self.table.nodes)

    def node(self, bus: int, phase: str = "") -> int:
        """The row of a node, by its bus and phase; -1 where the bus lacks the phase."""
        row, nodes = self.row[bus], self.table.nodes
        if nodes.is_balanced:
            return -1 if phase else row
        return int(nodes.find(np.array([row]), PHASES.index(phase))[0])

    @property
    def node_mva(self) -> float:
        """The size of 1 p.u. of power at a node, MVA: of a node with a phase a third of ``base_mva``."""
        return self.base_mva if self.table.nodes.is_balanced else self.base_mva / 3

    @cached_property
    def node_buses(self) -> tuple[int, ...]:
        """The bus of each node."""
        return tuple(self.table.bus_id[self.table.nodes.item].tolist())

    @cached_property
    def node_phases(self) -> tuple[str, ...]:
        """The phase of each node; empty in a balanced network."""
        nodes = self.table.nodes
        return () if nodes.is_balanced else tuple(PHASES[phase] for phase in nodes.phase.tolist())

    @cached_property
    def node_names(self) -> list[str]:
        """The names of the nodes, such as 671.a."""
        return list(map(name_node, self.node_buses, self.node_phases or repeat("")))

    @cached_property
    def nodes(self) -> tuple[tuple[int, str], ...]:
        """Bus and phase of each node; the phase is "" in a balanced network."""
        return tuple(zip(self.node_buses, self.node_phases or ("",) * self.n_nodes, strict=True))

    def nodes_at(self, bus: int) -> np.ndarray:
        """The rows of the nodes of a bus."""
        return self.table.nodes.at(self.row[bus])

    def find_unknown(self, reference: int) -> np.ndarray:
        """The unknown entries of x = [va; vm; estimated taps]: all but angles of bus ``reference``, voltages of dead
        nodes and taps beside them.
        """
        is_known = np.concatenate([self.is_dead, self.is_dead, self.are_taps_dead])
        is_known[self.nodes_at(reference)] = True
        return np.flatnonzero(~is_known)

    def name_nodes(self, nodes: Sequence[int]) -> tuple[str, ...]:
        """Names of nodes: "671.a", of balanced buses "7" or "12-19"."""
        if self.node_phases:
            return tuple(self.node_names[node] for node in nodes)
        return _name_buses(self.node_buses[node] for node in nodes)

    def id_of(self, text: str) -> str:
        """The id of the branch with this id, or else with this name; ``text`` where there is none.

        Raises:
            InvalidInputError: several branches have the name.
        """
        if not text or text in self.branch_by_id:
            return text
        named = [b.id for b in self.branches if b.name.lower() == text.lower()]
        if len(named) > 1:
            problem = f"{len(named)} branches are called {text!r}; give the id of one: {listed(named)}"
            raise InvalidInputError(f"network {self.name!r}", [problem])
        return named[0] if named else text

    def nodes_of(self, branch_id: str) -> list[int]:
        """The rows of the nodes at both ends of a branch, in service or not."""
        branch = self.branch(branch_id)
        of_ends = (p.from_phases, p.to_phases) if (p := branch.primitive) else ("", "")
        ends = zip((branch.from_bus, branch.to_bus), of_ends, strict=True)
        return [self.node(bus, phase) for bus, phases in ends for phase in list_phases(phases)]

    def live_nodes_at(self, bus: int) -> np.ndarray:
        """The rows of the nodes of a bus that have supply."""
        rows = self.nodes_at(bus)
        return rows[~self.is_dead[rows]] if self.dead else rows

    def check_balanced(self, purpose: str) -> None:
        """Raises InvalidInputError where buses have phases, which ``purpose`` cannot serve."""
        if not self.table.nodes.is_balanced:
            raise InvalidInputError(
                f"network {self.name!r}", [f"its buses have phases; {purpose} needs a balanced one"]
            )

    @cached_property
    def active_branches(self) -> tuple[Branch, ...]:
        """The branches in service, in the order of the rows of the branch admittances."""
        return tuple(branch for branch in self.branches if branch.in_service)

    @cached_property
    def branches_at(self) -> dict[int, tuple[Branch, ...]]:
        """Bus id -> branches in service that end there."""
        at: dict[int, list[Branch]] = {bus.id: [] for bus in self.buses}
        for branch in self.active_branches:
            at[branch.from_bus].append(branch)
            at[branch.to_bus].append(branch)
        return {bus: tuple(branches) for bus, branches in at.items()}

    @cached_property
    def switches(self) -> dict[str, bool]:
        """Branch that may be operated -> True where it is closed."""
        given = zip(self.branch_ids, read_given(self.branches, "switch"), strict=False)
        return {branch: self.branch(branch).in_service for branch, is_switch in given if is_switch}

    def operated(self, closed: Mapping[str, bool]) -> Network:
        """The same network with switches as in ``closed``: switch -> True where it is closed; others stay. Where one
        changes no node is ``dead`` yet.
        """
        changed = {switch: status for switch, status in closed.items() if self.switches.get(switch, status) != status}
        if not changed:
            return self
        if isinstance(self.branches, Records):
            in_service = self.table.in_service.copy()
            for row, branch in enumerate(self.branch_ids):
                in_service[row] = changed.get(branch, in_service[row])
            columns = self.branches.columns | {"in_service": in_service}
            return replace(self, branches=Records(self.branches.make, columns), dead=())
        statuses = ((branch, changed.get(branch.id, branch.in_service)) for branch in self.branches)
        return replace(self, branches=tuple(replace(branch, in_service=status) for branch, status in statuses), dead=())

    def supplied(self) -> Network:
        """The whole network, in which the nodes are ``dead`` that no path of conductors joins to the substation."""
        if self.slack is None:
            return self
        island = self.table.node_island
        return self.with_dead(~np.isin(island, island[self.nodes_at(self.slack.bus)]))

    def with_dead(self, is_dead: np.ndarray) -> Network:
        """The network with these ``dead`` nodes, (n_nodes,). All buses and branches stay, and so do the rows.

        Loads and shunts between a dead phase and a live one draw nothing. Windings do, and a phase behind them lives.
        """
        dead = tuple(np.flatnonzero(is_dead).tolist())
        return self if dead == self.dead else replace(self, dead=dead)

    @property
    def is_dead(self) -> np.ndarray:
        """True for nodes without supply, (n_nodes,)."""
        return self.table.is_dead

    @property
    def dead_places(self) -> tuple[str, ...]:
        """Names of buses without supply, or of ranges of them, then of nodes of others."""
        nodes = self.table.nodes
        is_whole = np.logical_and.reduceat(self.is_dead, nodes.first)
        alone = np.flatnonzero(self.is_dead & ~is_whole[nodes.item]).tolist()
        return *_name_buses(self.table.bus_id[is_whole].tolist()), *(self.node_names[node] for node in alone)

    @property
    def open_around_dead(self) -> tuple[str, ...]:
        """Ids of the open branches with an end without supply."""
        opened = [branch.id for branch in self.branches if not branch.in_service] if self.dead else []
        return tuple(sorted(branch for branch in opened if self.is_dead[self.nodes_of(branch)].any()))

    @cached_property
    def with_tap_steps(self) -> tuple[Branch, ...]:
        """Branches in service whose tap changer has steps, but those whose taps are estimated."""
        given = any(read_given(self.branches, "tap_steps"))
        stepped = (branch for branch in self.active_branches if branch.tap_steps and not branch.estimate_tap)
        return tuple(stepped) if given else ()

    @cached_property
    def estimated_taps(self) -> dict[str, int]:
        """Branch in service whose tap is estimated -> its place among those in service."""
        given = any(read_given(self.branches, "estimate_tap"))
        return {b.id: k for k, b in enumerate(self.active_branches) if b.estimate_tap} if given else {}

    @property
    def are_taps_dead(self) -> np.ndarray:
        """True for estimated taps with an end without supply, (n_tap,)."""
        at = np.array([*self.estimated_taps.values()], dtype=int)
        return np.asarray(self.is_dead[self.table.f[at]] | self.is_dead[self.table.t[at]])

    @property
    def taps(self) -> np.ndarray:
        """Taps at which the estimates of estimated ones begin, (n_tap,)."""
        return np.array([self.branch(branch).tap for branch in self.estimated_taps])

    def with_taps(self, taps: Mapping[str, float]) -> Network:
        """The same network with other ``taps``: branch -> its tap."""
        if not taps:
            return self
        return replace(self, branches=tuple(replace(b, tap=taps.get(b.id, b.tap)) for b in self.branches))

    @cached_property
    def slack(self) -> Generator | None:
        return next((g for g in self.generators if g.control is Control.SLACK), None)

    def bus(self, bus_id: int) -> Bus:
        return self.buses[self.row[bus_id]]

    def branch(self, branch_id: str) -> Branch:
        return self.branch_by_id[branch_id]

    @cached_property
    def branch_by_id(self) -> dict[str, Branch]:
        return {branch.id: branch for branch in self.branches}

    @cached_property
    def legs(self) -> Legs:
        """The legs of all loads but those at dead phases; of a balanced network one for each bus."""
        if self.table.nodes.is_balanced:
            node = np.arange(self.n_nodes)
            ground, exponents = np.full(len(node), GROUND), np.zeros((len(node), 2))
            return Legs(node, ground, self.table.load, exponents, find_nominal(self.table.nodes))
        ends = [[self.node(load.bus, phase) for phase in list_phases(load.phases)] for load in self.loads]
        node, other = np.array([[*of_leg, GROUND][:2] for of_leg in ends], dtype=np.int64).reshape(-1, 2).T
        s = np.array([load.s for load in self.loads], dtype=complex)
        exponents = np.array([load.exponents for load in self.loads], dtype=float).reshape(-1, 2)
        lives = ~np.append(self.is_dead, False)  # the last one for GROUND
        at = np.flatnonzero(lives[node] & lives[other])
        return Legs(node[at], other[at], s[at], exponents[at], find_nominal(self.table.nodes))

    @cached_property
    def scheduled(self) -> np.ndarray:
        """Scheduled generation minus load at nominal voltage, of all nodes, complex, p.u., (n_nodes,), without shunts.

        A generator produces at each phase of its bus.
        """
        produced = np.zeros(self.n_nodes, dtype=complex)
        for generator in self.generators:
            produced[self.nodes_at(generator.bus)] += complex(generator.p, generator.q)
        scheduled: np.ndarray = produced - self.legs.at_nominal
        return scheduled

    def find_scheduled(self, v: np.ndarray) -> np.ndarray:
        """``scheduled`` at the voltages ``v``, complex, p.u., (n_nodes,)."""
        scheduled: np.ndarray = self.scheduled - self.legs.find_excess(v)
        return scheduled

    def scheduled_injection(self, bus_id: int) -> complex:
        """Scheduled generation minus load of a balanced bus, p.u.; shunts do not count."""
        self.check_balanced("a schedule by bus")
        return complex(self.scheduled[self.row[bus_id]])

    def find_unreached_buses(self, start: int) -> tuple[int, ...]:
        """Buses that no path of branches in service joins to ``start``, in network order."""
        island = self.table.island
        return tuple(self.table.bus_id[island != island[self.row[start]]].tolist())

    def _find_unreached_phases(self, start: int, gone: Collection[int]) -> tuple[str, ...]:
        """Phases that no path of conductors and windings in service joins to ``start``, of buses but ``gone``."""
        island, nodes = self.table.node_island, self.table.nodes
        loose = np.flatnonzero(~np.isin(island, island[self.nodes_at(start)])).tolist()
        places = ((PHASES[nodes.phase[node]], self.node_buses[node]) for node in loose)
        return tuple(f"phase {phase} of bus {bus}" for phase, bus in places if bus not in gone)

    @cached_property
    def median_impedance(self) -> float:
        """The median |r + jx| of the branches in service, p.u.; 0 if there are none."""
        impedances = abs(self.table.series[self.table.active])
        return float(np.median(impedances)) if len(impedances) else 0.0

    def find_zero_impedances(self) -> tuple[Branch, ...]:
        """Branches in service whose |r + jx| is below their ``zero_share`` of the median of the whole network.

        Only of a whole network: an area's part of it has another median.
        """
        active, median = self.table.active, self.median_impedance
        short = active[abs(self.table.series[active]) < max(ZERO_LINE, ZERO_IMPEDANCE) * median]
        branches = [self.branches[k] for k in short.tolist()]
        return tuple(b for b in branches if abs(complex(b.r, b.x)) < self.zero_share(b) * median)

    @staticmethod
    def zero_share(branch: Branch) -> float:
        """The share of the median |r + jx| below which ``branch`` counts as without impedance."""
        return ZERO_LINE if branch.primitive and branch.primitive.is_straight else ZERO_IMPEDANCE

    def find_supply_problems(self) -> list[str]:
        """Problems of supply, as text: no substation, or buses or phases that no path in service joins to it;
        else loads and sources to ground where there is none."""
        if self.slack is None:
            return ["the network has no slack bus (substation); give it one source of kind 'slack'"]
        return list(self.find_unreached(self.slack.bus, "the substation")) or list(self.find_ungrounded_supply())

    def find_unreached(self, start: int, called: str) -> Iterator[str]:
        """Buses and phases that no path in service joins to bus ``start``, ``called`` so, as text; none where they are
        ``dead``, which is known.
        """
        if self.dead:
            return
        path = "no path of branches in service joins"
        if buses := self.find_unreached_buses(start):
            yield f"{path} bus {', '.join(map(str, buses))} to {called}"
        if not self.table.nodes.is_balanced and (phases := self._find_unreached_phases(start, set(buses))):
            yield f"{path} {listed(phases)} to {called}; feed the phase, or leave it out of the bus"

    def find_ungrounded_supply(self, further: Iterable[int] = ()) -> Iterator[str]:
        """Loads and sources from a phase to ground in parts without ground, as text.

        ``further``: buses with loads to ground beside those of the network.
        """
        if not (ungrounded := self.gauge.ungrounded):
            return
        supplied = [(load.bus, f"the load {load.bus}.{load.phases}") for load in self.loads if load.phases in PHASES]
        supplied += [(g.bus, f"the generator at bus {g.bus}") for g in self.generators if g.control is Control.POWER]
        supplied += [(bus, f"the extra load at bus {bus}") for bus in further]
        dead = {bus for bus in ungrounded if self.is_dead[self.nodes_at(bus)].all()}
        for bus, called in supplied:
            if bus in ungrounded and bus not in dead:
                yield f"{called} stands between phase and ground in a part without ground; use a leg between two phases"


def _duplicates(items: Iterable[object]) -> list[object]:
    return [item for item, count in Counter(items).items() if count > 1]


def _name_buses(buses: Iterable[int]) -> tuple[str, ...]:
    """Names of buses: "7" or "12-19"."""
    runs: list[list[int]] = []
    for bus in sorted(buses):
        if runs and bus == runs[-1][-1] + 1:
            runs[-1].append(bus)
        else:
            runs.append([bus])
    return tuple(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _find_problems(network: Network) -> Iterable[str]:
    if not (math.isfinite(network.base_mva) and network.base_mva > 0):
        yield f"base_mva is {network.base_mva}; it must be a positive power in MVA"
    if not _is_possible(network):
        yield from _find_problems_of_buses_and_branches(network)
    yield from _find_problems_of_generators(network)
    yield from _find_problems_of_legs(network)
    yield from _find_problems_of_taps(network)
    if gauge := network.gauge_of_whole:
        for bus in sorted({*gauge.ungrounded, *gauge.pinned} - set(network.table.bus_id.tolist())):
            yield f"the gauge names bus {bus}, which is not defined"


def _find_problems_of_taps(network: Network) -> Iterable[str]:
    if not any(read_given(network.branches, "estimate_tap")):
        return
    for branch in network.branches:
        if branch.estimate_tap and branch.switch:
            yield f"branch {branch.id}: a switch has no tap to estimate; leave `switch` or `estimate_tap` out"
        if branch.estimate_tap and branch.primitive:
            yield f"branch {branch.id}: only taps of balanced networks are estimated; leave `estimate_tap` out"


def _is_possible(network: Network) -> bool:
    """True where no bus and no branch has a problem; all are checked at once and no texts are made."""
    ids = network.branch_ids
    return all(ids) and len(set(ids)) == len(ids) and network.table.is_possible() and _have_possible_ratings(network)


def _have_possible_ratings(network: Network) -> bool:
    """True where all ratings that are given are positive and finite."""
    ratings = set(read_given(network.branches, "i_max")).union(read_given(network.branches, "s_max"))
    return all(0 < rating < math.inf for rating in ratings - {None})


def _find_problems_of_buses_and_branches(network: Network) -> Iterable[str]:
    ids = {bus.id for bus in network.buses}
    if not network.buses:
        yield "it has no bus"
    for bus_id in _duplicates(bus.id for bus in network.buses):
        yield f"bus {bus_id} is defined more than once; give each bus its own id"
    for branch_id in _duplicates(branch.id for branch in network.branches):
        yield f"branch {branch_id} is defined more than once; give parallel branches ids of their own"
    for bus in network.buses:
        if not all(map(math.isfinite, (bus.p_load, bus.q_load, bus.g_shunt, bus.b_shunt))):
            yield f"bus {bus.id}: load or shunt is not a finite number"
        if not (math.isfinite(bus.base_kv) and bus.base_kv > 0):
            yield f"bus {bus.id}: base_kv is {bus.base_kv}; it must be positive"
    for branch in network.branches:
        if not branch.id:
            yield f"a branch from bus {branch.from_bus} to bus {branch.to_bus} has an empty id; give it one"
        for bus_id in (branch.from_bus, branch.to_bus):
            if bus_id not in ids:
                yield f"branch {branch.id} ends at bus {bus_id}, which is not defined"
        if branch.from_bus == branch.to_bus:
            yield f"branch {branch.id} joins bus {branch.from_bus} to itself"
        if not all(map(math.isfinite, (branch.r, branch.x, branch.b, branch.g, branch.tap, branch.shift))):
            yield f"branch {branch.id}: r, x, b, g, tap or shift is not a finite number"
        elif branch.r == 0 and branch.x == 0:
            yield f"branch {branch.id} has no impedance; merge its two buses into one"
        for rating in (branch.i_max, branch.s_max):
            if rating is not None and not (math.isfinite(rating) and rating > 0):
                yield f"branch {branch.id}: i_max or s_max is {rating}; a rating is positive, or is not given"
        if branch.tap <= 0:
            yield f"branch {branch.id}: tap is {branch.tap}; it must be positive (1.0 for a line)"
        elif not 0 <= branch.tap_steps < branch.tap:
            yield f"branch {branch.id}: tap_steps is {branch.tap_steps}; a step is 0 or more, and less than the tap"
    yield from _find_problems_of_phases(network)


def _find_problems_of_phases(network: Network) -> Iterable[str]:
    texts = {bus.id: bus.phases for bus in network.buses}
    if without := [str(bus) for bus, phases in texts.items() if not phases] if any(texts.values()) else []:
        yield f"bus {', '.join(without)} has no phases, and others have; give each bus its phases"
    for bus, phases in texts.items():
        if not read_phases([phases])[0]:
            yield f"bus {bus}: phases {explain_phases(phases)}"
    sound = _find_sound_phases(network)
    for branch in network.branches:
        if (primitive := branch.primitive) is None:
            if texts.get(branch.from_bus) or texts.get(branch.to_bus):
                yield f"branch {branch.id} joins buses with phases; give it admittances over its ports"
            continue
        ports = 0
        for bus, phases in ((branch.from_bus, primitive.from_phases), (branch.to_bus, primitive.to_phases)):
            ports += len(list_phases(phases))
            if bus in sound and (missing := sorted({*list_phases(phases)} - {*list_phases(sound[bus])})):
                at = f"branch {branch.id} has phase {', '.join(missing)} at bus {bus}, which lacks it"
                yield f"{at}; leave it out of the branch, or add it to the bus"
        for y in (primitive.y, primitive.charging):
            if y.shape != (ports, ports) or not np.isfinite(y).all():
                yield f"branch {branch.id}: admittances over its {ports} ports are no finite {ports} x {ports} matrix"


def _find_sound_phases(network: Network) -> dict[int, str]:
    """Bus -> its phases, but of buses whose phases are refused: what stands there is no further mistake."""
    has_phases = any(bus.phases for bus in network.buses)
    sound = zip(network.buses, network.table.phases.tolist(), strict=True)
    return {bus.id: bus.phases for bus, phases in sound if phases and (bus.phases or not has_phases)}


def _find_problems_of_legs(network: Network) -> Iterable[str]:
    sound = _find_sound_phases(network) if network.loads or network.shunts else {}
    if not network.table.nodes.is_balanced:
        stated = network.table.bus_id[network.table.load != 0].tolist()
        yield from (f"bus {bus} has phases, and a load of its own; state the load by its legs" for bus in stated)
    for load in network.loads:
        yield from _find_problems_of_leg(network, load, "load", sound)
        if not all(map(cmath.isfinite, (load.s, *load.exponents))):
            yield f"a load at bus {load.bus}: s or an exponent is not a finite number"
    for shunt in network.shunts:
        yield from _find_problems_of_leg(network, shunt, "shunt", sound)
        if not cmath.isfinite(shunt.y):
            yield f"a shunt at bus {shunt.bus}: y is not a finite number"


def _find_problems_of_leg(network: Network, leg: Load | Shunt, called: str, sound: Mapping[int, str]) -> Iterator[str]:
    is_there, wanted = leg.bus in network.row, list_phases(leg.phases)
    there = sound.get(leg.bus, "")
    if is_there and leg.bus not in sound:
        return
    if not there:
        yield f"a {called} with phases {leg.phases} stands at bus {leg.bus}, which has none"
    elif len(wanted) not in (1, 2) or len(set(wanted)) < len(wanted) or not {*wanted} <= {*list_phases(there)}:
        known = ", ".join(list_phases(there))
        yield f"a {called} at bus {leg.bus}: phases is {leg.phases!r}; name one or two of {known}"


def _find_problems_of_generators(network: Network) -> Iterable[str]:
    for generator in network.generators:
        if network.table.rows.row_of(generator.bus) < 0:
            yield f"a generator stands at bus {generator.bus}, which is not defined"
        if not all(map(math.isfinite, (generator.p, generator.q, generator.vm, generator.va))):
            yield f"generator at bus {generator.bus}: p, q, vm or va is not a finite number"
        elif generator.vm <= 0:
            yield f"generator at bus {generator.bus}: vm is {generator.vm}; it must be positive"
    set_points: dict[int, set[float]] = {}
    for generator in network.generators:
        if generator.control is not Control.POWER:
            set_points.setdefault(generator.bus, set()).add(generator.vm)
    for bus_id, values in set_points.items():
        if len(values) > 1:
            yield f"generators at bus {bus_id} hold different voltages, vm {sorted(values)}; give them one set-point"
    slacks = [str(g.bus) for g in network.generators if g.control is Control.SLACK]
    if len(slacks) > 1:
        yield f"buses {', '.join(slacks)} are all slack; keep one"
