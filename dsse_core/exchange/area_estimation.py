"""One area's part in the Gauss-Newton iteration of the whole grid: x_k of its own buses, and the messages about it.

At each x_k an area passes on the information of its side and takes in that of all other sides. From these it knows its
part of the step of the whole grid. It carries out here the verdicts of ``decision``. A grid of one area gives the
centralised estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from dsse_core.errors import DsseError
from dsse_core.estimation.decision import MOST_NAMED, Decision, Memory, Totals, Verdict, limit_total
from dsse_core.estimation.residuals import DEAD_VM, MeterChecks, find_dead, find_switches, find_taps
from dsse_core.estimation.switches import Alternatives, Gain, build_alternatives, find_wrong_switches, weigh_switches
from dsse_core.estimation.taps import find_wrong_taps
from dsse_core.exchange.boundary_load import Loads, powers_from, stand_in_for
from dsse_core.exchange.feeder_bad_data import (
    NoLoadModel,
    build_no_load_model,
    count_freedom,
    find_objective,
)
from dsse_core.grid.gauge import Change, draw_common, shift_common
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.nodes import list_phases
from dsse_core.grid.partition import Area
from dsse_core.grid.quantities import Quantity
from dsse_core.grid.supply import FED, Pieces, find_alternatives, find_pieces, find_pieces_for
from dsse_core.grid.switches import find_dead_meters, keep_in_service
from dsse_core.linear import choose_backend
from dsse_core.linear.area_measurements import Backend
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import BoundaryInformation, are_within_reason
from dsse_core.linear.contributions import VoltageReadings

FAILURES = (ArithmeticError, np.linalg.LinAlgError, RuntimeError, ValueError, DsseError)  # caused by absurd numbers

T = TypeVar("T")
Received = Mapping[str, BoundaryInformation]


class AreaEstimation:
    """Estimation of one area, scan by scan.

    ``x``: the state x_k, shape (size,), see ``AreaModel``; p.u. and rad. ``failure``: the reason why the area has no
    numbers, else empty. ``linearized_at``: x before the last step. The neighbours' information belongs to that state.
    Only there does the area have its part of the inverse of the whole grid, whose diagonal gives the variances. With
    rows at x two areas would state two standard deviations of the bus that they share.
    """

    def __init__(self, area: Area) -> None:
        self.area = area  # with its switches as this start has them
        self._as_read = area  # with its switches as of the last ``begin``
        self._reference = area.reference[0] if area.reference else None
        self._n = area.network.n_nodes
        self._by_name = {n.area: n for n in area.neighbours}
        self._flat = self._flat_of_split = _flat_start(area)
        self._drawn_in_split = self._draw_common(area)
        self.x = self._flat
        self.failure = ""
        self.removed: tuple[str, ...] = ()
        self.gains: Mapping[str, Gain] = {}  # of the other statuses of switches at x, see ``weigh_switches``
        self._are_weighed = False  # in this start
        self._alternatives: Alternatives | None = None  # for the meters in use; None while not needed
        self.taps: Mapping[str, tuple[float, float]] = {}  # branch -> its estimated tap, sigma, from ``find_sigmas``
        self.critical: tuple[str, ...] = ()
        self.unobservable: tuple[int, ...] = ()  # nodes, by rows
        self.is_first = False  # no step of this start has been taken, and no-load information is wanted
        self.reported: set[str] = set()  # own suspects that the area has named as the worst in this term
        self.own_meters: frozenset[str] = frozenset()  # that have a reading
        self._readings: tuple[Measurement, ...] = ()
        self._all_readings: Sequence[Measurement] = ()  # those of meters at open branches included
        self._meters_read: tuple[Meter, ...] = ()
        self._silent: frozenset[str] = frozenset()
        self._is_stale = False
        self._start = self._start_of_term = self.x
        self.linearized_at, self._step = self.x, np.zeros_like(self.x)
        self._step_before = self._step
        of_nodes = area.network.table.bus_id[area.network.table.nodes.item]
        self._is_own = np.tile(~np.isin(of_nodes, area.not_owned), 2)  # of va, then of vm
        self._worst: tuple[tuple[str, float], ...] = ()
        self._tied: tuple[tuple[str, float], ...] = ()
        self._uses_currents = False
        self._n_current = 0  # current meters that can be used
        self.received: Received = {}  # at ``linearized_at``
        self._boundary_values: dict[str, tuple[np.ndarray, tuple[float, ...]]] = {}  # neighbour -> x, and y there
        self.before_removal: tuple[np.ndarray, Received] | None = None  # x with all meters, and messages of its step
        self._last_y: dict[str, np.ndarray] = {}  # neighbour -> y at the last end with it in use
        self.stand_ins: dict[str, BoundaryInformation] = {}
        self._omega: np.ndarray | None = None  # variances of the residuals, from ``find_sigmas``
        self._model: AreaModel | None = None
        self._no_load: NoLoadModel | None = None  # None while it is not needed
        self._measured_at_no_load: Sequence[Measurement] = ()
        self._meters_of_no_load: tuple[Meter, ...] = ()
        self._kept_no_load: dict[tuple[str, ...], tuple[object, object]] = {}  # query -> its input, its result
        self._supplied = area  # ``area`` with the nodes that are dead in this start
        self._pieces: Mapping[str, Pieces] = {}  # of all neighbours, as of this start

    @property
    def model(self) -> AreaModel:
        assert self._model is not None  # ``begin`` was called
        return self._model

    def describe_backend(self) -> str:
        """Text for the log: the name of the back end, and how often sparse matrices had to take a call."""
        linear = self._model.linear if self._model else None
        if linear is None:
            return choose_backend(self.area)
        left = [f"{count} for {why}" for why, count in linear.declined.most_common()]
        return f"{linear.name}, calls left to sparse matrices: {', '.join(left)}" if left else linear.name

    # A term

    def begin(
        self,
        readings: Sequence[Measurement],
        *,
        silent: Collection[str],
        stale: bool,
        loads: Mapping[str, Loads] | None = None,
        closed: Mapping[str, bool] | None = None,
    ) -> None:
        """Starts at the state so far, with ``readings``, virtual ones included; ``silent``: neighbours not in use.

        ``closed``: switch of the area -> True where it is closed; others stay as they are. Meters of open ones are left
        out. ``stale``: the readings are not of this scan. ``loads``: neighbour -> its load message.
        """
        self._as_read, self._all_readings = self._as_read.operated(closed or {}), readings
        self._silent, self._is_stale = frozenset(silent), stale
        self.reported, self.before_removal = set(), None
        self._operate(())
        self._find_dead({name: self._pieces[name] for name in self._pieces.keys() - self._silent})  # as they last were
        self._start = self._start_of_term = self._hold_dead(self._flat if self.failure else self.x)
        self._start_anew(())
        self.stand_ins = self._find_stand_ins(loads or {})

    def _operate(self, removed: Sequence[str]) -> None:
        """Sets the area's switches as they were read, those of ``removed`` the other way, and takes the readings of
        meters in service. The state stays; models and no-load information of other statuses are dropped.
        """
        as_read = self._as_read.network.switches
        area = self._as_read.operated({s: not as_read[s] for s in find_switches(removed) if s in as_read})
        self._readings = tuple(keep_in_service(area.network, self._all_readings))
        if (meters := tuple(m.meter for m in self._readings)) != self._meters_read:
            self._meters_read, self.own_meters = meters, frozenset(meter.id for meter in meters)
        if area.network.switches == self.area.network.switches:
            return
        self.area = area
        self._supplied = replace(area, network=area.network.with_dead(self.dead))
        self._drop_model()
        self._no_load, self._meters_of_no_load, self._kept_no_load = None, (), {}

    def _drop_model(self) -> None:
        if self._model is not None:
            self._model.end()
        self._model, self._alternatives, self._boundary_values = None, None, {}

    def _hold_dead(self, x: np.ndarray) -> np.ndarray:
        """``x`` with nodes without supply at no load: there they begin when they are fed again."""
        network, powers = self.area.network, self.area.powers_into_children
        of_powers = self.dead[np.array([network.node(p.bus, p.phase) for p in powers], dtype=np.intp)]
        of_taps = self._supplied.network.are_taps_dead
        return np.where(np.concatenate([self._of_dead, of_powers, of_taps]), self._flat, x)

    @property
    def _of_dead(self) -> np.ndarray:
        """True for the angles, then the magnitudes, of nodes without supply, (2 n_nodes,)."""
        return np.tile(self.dead, 2)

    @property
    def dead(self) -> np.ndarray:
        """True for nodes without supply, (n_nodes,)."""
        return self._supplied.network.is_dead

    def _find_dead(self, pieces: Mapping[str, Pieces]) -> bool:
        """Leaves out the nodes that ``pieces``, of all neighbours in use, show to be without supply; True where these
        are others than before.
        """
        network = self.area.network.with_dead(find_pieces(self.area, pieces) != FED)
        if network.dead == self._supplied.network.dead:
            return False
        self._supplied = replace(self.area, network=network)
        self._drop_model()
        return True

    def _keep_supplied(self, readings: Sequence[Measurement]) -> list[Measurement]:
        """The ``readings`` of meters where there is supply."""
        is_dead = find_dead_meters(self._supplied.network, [m.meter for m in readings]).tolist()
        return [m for m, dead in zip(readings, is_dead, strict=True) if not dead]

    def _leave_dead(self, pieces: Mapping[str, Pieces]) -> None:
        """``_find_dead`` before the first step, with a new model where it finds others."""
        if self._find_dead(pieces):
            self.x, self._start = self._hold_dead(self.x), self._hold_dead(self._start)
            self._start_of_term = self._hold_dead(self._start_of_term)
            self._build()

    @property
    def dead_places(self) -> tuple[str, ...]:
        """Names of the area's places without supply, see ``Network.dead_places``."""
        return self._supplied.network.dead_places

    def pieces_for(self, neighbour: str, received: Mapping[str, Pieces]) -> Pieces:
        """The pieces of the boundary to ``neighbour`` on this side of it, before the first step; empty afterwards."""
        return find_pieces_for(self.area, neighbour, received) if self.is_first else ()

    def _find_stand_ins(self, loads: Mapping[str, Loads]) -> dict[str, BoundaryInformation]:
        """Silent neighbour -> information that stands in for its own, see ``stand_in_for``.

        The boundary is as it was at the last end with the neighbour. If there was none, it is that of the unloaded grid
        with the load of the neighbour's side, where that has one flow. Without a load message nothing is known.
        """
        own = sum(map(abs, self.area.network.scheduled.tolist()))
        all_load = own + sum(abs(load.s) for of_side in loads.values() for load in of_side)
        found = {}
        for name in self._silent & (self._last_y.keys() | loads.keys()):
            boundary = self.area.boundaries[name]
            y = self._last_y.get(name)
            if y is None:
                y = self.model.boundary_values(self._flat, self._by_name[name]).copy()
                if boundary.has_one_flow:
                    y[: boundary.n_powers] = powers_from(self.area.name, boundary, loads[name])
            found[name] = stand_in_for(boundary, y, all_load)
        return found

    def owns(self, suspect: str) -> bool:
        """True where no other area can name ``suspect``: a meter of this area that has a reading, or a tap or switch of
        one of its branches.
        """
        branches = {*find_switches((suspect,)), *find_taps((suspect,))}
        return suspect in self.own_meters or not branches.isdisjoint(self.area.network.branch_ids)

    def _start_anew(self, removed: Sequence[str]) -> None:
        self.failure, self.gains, self._are_weighed = "", {}, False
        self.removed = tuple(meter for meter in removed if meter in self.own_meters)
        self.x = self.linearized_at = self._start
        self._step = np.zeros_like(self.x)
        self._worst, self._tied, self._uses_currents, self.received = (), (), False, {}
        self.is_first, self.unobservable, self.critical = True, (), ()
        self._build()

    @property
    def dead_voltmeters(self) -> tuple[str, ...]:
        """Ids of the voltmeters that are left out because no grid works at the voltage that they read, where there is
        supply.
        """
        voltmeters = self._keep_supplied([m for m in self._readings if m.meter.kind is MeasurementKind.VM])
        rows = find_dead([m.meter for m in voltmeters], [m.value for m in voltmeters])
        return tuple(voltmeters[k].meter.id for k in rows)

    def _in_use(self) -> list[Measurement]:
        out = {*self.removed, *self.dead_voltmeters}
        return [m for m in self._readings if m.meter.id not in out] if out else list(self._readings)

    @property
    def _is_blank(self) -> bool:
        """True where the readings of the scan are missing and no earlier ones are known."""
        return self._is_stale and not any(m.meter.source is not Source.VIRTUAL for m in self._readings)

    def _build(self) -> None:
        """Builds the models of the meters in use; new readings of the same meters keep rows and no-load model."""
        self._omega = None
        with_currents = self._in_use()
        without = [m for m in with_currents if m.meter.kind.quantity is not Quantity.CURRENT]
        self._n_current = len(with_currents) - len(without)
        in_use = with_currents if self._uses_currents else without
        as_before = self._silent or self._is_blank
        further: tuple[VoltageReadings, ...] = (VoltageReadings(self._start[: 2 * self._n]),) if as_before else ()
        if self.dead.any():
            in_use = self._keep_supplied(in_use)
            further += (VoltageReadings(self._flat[: 2 * self._n], there=self._of_dead),)
        meters = tuple(m.meter for m in in_use)
        former = self._model
        if former is not None and former.meters == meters:
            self._model = former.with_readings(in_use, further)
        else:
            self._alternatives = None
            backend: Backend = "pieces" if self.dead.any() else "auto"  # solves lose digits where a part is dead
            self._model = replace(
                build_area_model(self._supplied, in_use, self._reference, backend=backend), further=further
            )
        if former is not None:
            former.end()
        if self.is_first:
            self._build_no_load(without)

    def _build_no_load(self, in_use: Sequence[Measurement]) -> None:
        meters = tuple(m.meter for m in in_use)
        if self._meters_of_no_load != meters:
            self._meters_of_no_load, self._no_load, self._kept_no_load = meters, None, {}
        self._measured_at_no_load = in_use

    def _at_no_load(self) -> NoLoadModel:
        """The no-load model, built on the first call and kept until the no-load information of this start is sent.

        Later scans of the same meters need only the results, which ``_keep`` keeps.
        """
        if self._no_load is None:
            self._no_load = build_no_load_model(self.area, self._measured_at_no_load, self._reference)
        return self._no_load

    # Messages to neighbours

    def set_power(self, neighbour: str, power: Sequence[float]) -> None:
        """Takes the powers of a boundary at x_k, as the neighbour states them, but those into the own branches."""
        places, columns = self.model.other_powers[neighbour]
        if len(power) == self.area.boundaries[neighbour].n_powers and columns:
            self.x = self.x.copy()
            self.x[columns] = np.array(power)[places]

    def power_for(self, neighbour: str) -> tuple[float, ...]:
        """The powers at the boundary at x_k; empty where the neighbour computes all of them."""
        if not self.area.boundaries[neighbour].needs_powers(neighbour):
            return ()
        n_powers = self.area.boundaries[neighbour].n_powers
        return tuple(self.model.boundary_values(self.x, self._by_name[neighbour])[:n_powers].tolist())

    def boundary_values(self, neighbour: str) -> tuple[float, ...]:
        """y of the boundary to ``neighbour`` at x_k; found once for each x, as every heartbeat repeats it."""
        kept = self._boundary_values.get(neighbour)
        if kept is None or kept[0] is not self.x:
            values = tuple(self.model.boundary_values(self.x, self._by_name[neighbour]).tolist())
            self._boundary_values[neighbour] = kept = self.x, values
        return kept[1]

    def information_for(self, neighbour: str, received: Received) -> BoundaryInformation:
        """Information of this side, all areas but those behind ``neighbour``, at x_k.

        ``received``: the information of the other neighbours in use.

        Raises:
            FAILURES: numbers that no estimate can have.
        """
        found = self.model.linear.information(self.x, self._by_name[neighbour], self._with_stand_ins(received))
        return _checked(found)

    def no_load_for(self, neighbour: str, received: Mapping[str, BoundaryInformation]) -> BoundaryInformation | None:
        """No-load information of this side; None where the information of some area of this side is missing."""
        others = {n for n in self._by_name if n != neighbour}
        if self._silent or self._is_blank or others - received.keys():
            return None
        beyond, n = {name: received[name] for name in others}, self._by_name[neighbour]
        return self._keep((neighbour,), beyond, lambda: _checked(self._at_no_load().information_for(n, beyond)))

    def _keep(self, what: tuple[str, ...], received: Received, find: Callable[[], T]) -> T | None:
        """Result of ``find`` under the key ``what``, kept as long as the no-load model and ``received`` do not change.

        None where ``find`` fails.
        """
        of = tuple((name, received[name].R.tobytes()) for name in sorted(received))
        if what not in self._kept_no_load or self._kept_no_load[what][0] != of:
            try:
                found = find()
            except FAILURES:
                found = None  # readings that determine next to nothing
            self._kept_no_load[what] = of, found
        return cast("T | None", self._kept_no_load[what][1])

    def _with_stand_ins(self, received: Received) -> Received:
        """``received``, with the information that stands in for that of silent neighbours."""
        return self.stand_ins | dict(received)

    def totals(self) -> Totals:
        """The area's own part of the totals at x_k."""
        name, model, n = self.area.name, self.model, self._n
        size = abs(self._step)
        sizes = find_objective(model, self.x), float(size[:n].max()), float(size[n : 2 * n].max())
        if np.isnan(sizes).any():
            self.fail(ArithmeticError("the state is beyond reason"))
        numbers: dict[str, Any] = {"failed": (name,)}
        if not self.failure:
            objective, dva, dvm = map(limit_total, sizes)
            numbers = {
                "objective": objective,
                "degrees_of_freedom": count_freedom(model) + self._count_dead(),
                "dva": dva,
                "dvm": dvm,
                "square": limit_total(self._multiply_own(self._step, self._step)),
                "turn": limit_total(self._multiply_own(self._step_before, self._step)),
                "held_back": 0 if self._uses_currents else self._n_current,
                "worst": self._worst,
                "tied": self._tied,
            }
        return Totals(
            **numbers,
            areas=1,
            referenced=self.area.is_at_reference or model.reads_reference,
            silent=tuple(sorted(self._silent)),
            stale=(name,) if self._is_stale else (),
            unobservable=self.area.network.name_nodes([node for node in self.unobservable if self._is_own[node]]),
            energised=self._find_energised()[:MOST_NAMED],
            dark=self._supplied.network.open_around_dead[:MOST_NAMED],
            common=self._find_changes() if self._drawn_in_split else (),
        )

    def _find_changes(self) -> tuple[Change, ...]:
        """Changes of what charging and bus shunts draw, by switches and nodes without supply."""
        drawn = self._draw_common(self._supplied)
        changes = ((part, (drawn[part] - before).tolist()) for part, before in self._drawn_in_split.items())
        return tuple((part, *change) for part, change in changes if any(change))

    def _draw_common(self, area: Area) -> dict[int, np.ndarray]:
        va, vm = self._flat_of_split[: 2 * area.network.n_nodes].reshape(2, -1)
        return draw_common(area.network.table, area.network.gauge, vm * np.exp(1j * va))

    def _find_flat(self, changes: Sequence[Change]) -> np.ndarray:
        """x of the flat start after ``changes`` of all areas since the split."""
        network, n = self._supplied.network, 2 * self._n
        va, vm = self._flat_of_split[:n].reshape(2, -1)
        v = vm * np.exp(1j * va)
        moved = shift_common(network.table, network.gauge, v, changes)
        return np.concatenate([va + np.angle(moved / v), abs(moved), self._flat_of_split[n:]])

    def _count_dead(self) -> int:
        """The number of voltages of own nodes, and of estimated taps, without supply."""
        return int((self._of_dead & self._is_own).sum() + self._supplied.network.are_taps_dead.sum())

    def _find_energised(self) -> tuple[str, ...]:
        """Ids of the voltmeters that read a voltage where no node has supply."""
        if not (network := self._supplied.network).dead:
            return ()
        read = (m.meter for m in self._readings if m.meter.kind is MeasurementKind.VM and m.value >= DEAD_VM)
        at = {meter.id: [network.node(meter.bus, phase) for phase in list_phases(meter.phases)] for meter in read}
        return tuple(sorted(meter for meter, nodes in at.items() if network.is_dead[nodes].all()))

    def _multiply_own(self, a: np.ndarray, b: np.ndarray) -> float:
        """Product of two steps over the voltages of the area's own buses."""
        own = self._is_own
        return float(a[: len(own)][own] @ b[: len(own)][own])

    # Carrying out verdicts

    def carry_out(
        self,
        verdict: Verdict,
        memory: Memory,
        received: Received,
        no_load: Received,
        pieces: Mapping[str, Pieces] | None = None,
    ) -> None:
        """Carries out ``verdict`` at x_k with the information ``received`` of all neighbours in use.

        ``no_load``, ``pieces``: of these neighbours, before the first step.
        """
        try:
            if self.is_first:
                if (pieces := pieces or {}) != self._pieces:
                    self._pieces, self._alternatives = pieces, None
                self._leave_dead(self._pieces)
            self._check_no_load(no_load)
            if verdict.takes_step:
                self._check_information(received)
                self.received = self._with_stand_ins(received)
                self.linearized_at, self._step_before = self.x, self._step
                self._step = self.model.linear.step(self.x, self.received)
                self._step[: 2 * self._n][self._of_dead] = 0.0
                self.x = self.x + verdict.share * self._step
                self._check()
                if verdict.with_step and len(find_switches(memory.removed)) == len(memory.removed):
                    self.before_removal = self.x, self.received
            match verdict.decision:
                case Decision.SHORTEN:
                    self.x = self.linearized_at + verdict.share * self._step
                    self._step = np.zeros_like(self.x)
                case Decision.USE_CURRENTS:
                    self._uses_currents = True
                    self._step = np.zeros_like(self.x)
                    self._build()
                case Decision.ANEW:
                    if memory.from_flat_start:
                        self._flat = self._find_flat(memory.common)
                    self._start = self._flat if memory.from_flat_start else self._start_of_term
                    self._operate(memory.removed)
                    self._start_anew(memory.removed)
                case Decision.EVALUATE:
                    self._evaluate()
                case Decision.FINAL:
                    for name in self.received.keys() - self._silent:
                        self._last_y[name] = self.model.boundary_values(self.x, self._by_name[name])
        except FAILURES as error:
            self.fail(error)

    def prepare(self) -> None:
        """Computes the part of the next round that needs no message."""
        if not self.failure:
            self.model.linear.prepare(self.x)

    def fail(self, error: BaseException) -> None:
        """Goes on without numbers; the totals then name the area as failed, so that all areas end the scan."""
        self.failure = f"{type(error).__name__}: {error}"
        self.x = self._flat
        self._step = np.zeros_like(self.x)

    @property
    def deviation(self) -> float:
        """The root mean square of the weighted residuals of the real meters in use, at x before the last step."""
        n_real = len(self.model.real_ids)
        return float(np.sqrt(find_objective(self.model, self.linearized_at) / n_real)) if n_real else 0.0

    def _check_information(self, received: Received) -> None:
        """Raises ArithmeticError where a neighbour in use has sent no information, as an area without numbers does.

        A step without the information of one side would be that of another grid.
        """
        if missing := self._by_name.keys() - self._silent - received.keys():
            raise ArithmeticError(f"no numbers from {', '.join(sorted(missing))}")

    def _check(self) -> None:
        if not np.isfinite(self.x).all():
            raise ArithmeticError("the step has no numbers")

    def _check_no_load(self, received: Received) -> None:
        """Finds unobservable buses and critical meters, if the no-load information of all neighbours is there."""
        if not self.is_first:
            return
        self.is_first = False
        if not (self._silent or self._is_blank or self._by_name.keys() - received.keys()):
            self._examine_no_load(received)
        self._no_load, self._measured_at_no_load = None, ()

    def _examine_no_load(self, received: Received) -> None:
        found = self._keep((), received, lambda: self._at_no_load().examine(received))
        undetermined, indispensable = found or ((), frozenset())
        self.unobservable = tuple(node for node in undetermined if not self.dead[node])
        if not self.unobservable:
            self.critical = tuple(sorted(indispensable & self.model.real_ids))

    def _evaluate(self) -> None:
        """Finds the critical meters, and the largest normalised residual of the others, of taps and of switches."""
        self.weigh_switches()
        checks = self._check_meters(self._variances()[1])
        self.critical, (worst, tied) = checks.critical, checks.suspects()
        self._worst, self._tied = (tuple(sorted(found.items()))[:MOST_NAMED] for found in (worst, tied))
        self.reported |= worst.keys()

    def weigh_switches(self) -> None:
        """Finds by how much J of the whole grid is less with the other status of each switch, at x."""
        if self._are_weighed:
            return
        if self._alternatives is None:
            self._alternatives = build_alternatives(self.model, find_alternatives(self.area, self._pieces))
        self.gains = weigh_switches(self.model, self.x, self.received, self._alternatives)
        self._are_weighed = True

    def find_sigmas(self) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """Standard deviations (sigma_vm, sigma_va), shape (n_nodes,), p.u. and rad, and the critical meters.

        Raises:
            FAILURES: numbers that no estimate can have.
        """
        of_state, variance = self._variances()
        self._omega = variance
        sigma, first = np.sqrt(np.maximum(of_state, 0.0)), self.area.first_tap
        found = zip(self.x[first:].tolist(), sigma[first:].tolist(), strict=True)
        is_dead = self._supplied.network.are_taps_dead.tolist()
        taps = zip(self.area.network.estimated_taps, found, is_dead, strict=True)
        self.taps = {branch: tap for branch, tap, without_supply in taps if not without_supply}
        sigma[: 2 * self._n][self._of_dead] = 0.0
        return sigma[self._n : 2 * self._n], sigma[: self._n], self._check_meters(variance).critical

    def describe_readings(self) -> dict[str, tuple[float, float]]:
        """Id of each real meter in use -> its reading as predicted in this state, p.u. or rad, and normalised residual.

        The residual is 0 where no other meter checks the reading. Empty before ``find_sigmas``.
        """
        if self._omega is None:
            return {}
        checks, model = self._check_meters(self._omega), self.model
        estimates, normalized = (model.z - checks.residual).tolist(), checks.normalized.tolist()
        return {model.ids[k]: (estimates[k], normalized[k]) for k in np.flatnonzero(checks.real).tolist()}

    def _check_meters(self, variance: np.ndarray) -> MeterChecks:
        """Checks of the meters at x, with ``variance`` = diag(Omega), (n_meas,)."""
        model = self.model
        of_meters = model.residual(self.x), variance, model.sigma, ~model.virtual
        return MeterChecks(
            model.meters,
            *of_meters,
            lambda: np.array([m in self.critical for m in model.ids], dtype=bool),
            lambda: find_wrong_taps(model, self.linearized_at, self.received) | find_wrong_switches(self.gains),
        )

    def _variances(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances at ``linearized_at``: of all state variables, (size,), and of the residuals, (n_meas,)."""
        return self.model.linear.variances(self.linearized_at, self.received)

    @property
    def no_load_va(self) -> np.ndarray:
        """Angles of the unloaded area, shape (n_nodes,), rad."""
        return self._flat[: self._n]

    @property
    def into_children(self) -> tuple[float, ...]:
        """Powers into the branches of other areas, p.u., in the order of ``Area.powers_into_children``.

        Empty where a neighbour on the way to such an area is not in use.
        """
        silent = (self.area.boundaries[name] for name in self._silent)
        is_known = not any(power.area != self.area.name for there in silent for power in there.powers)
        return tuple(self.x[2 * self._n : self.area.first_tap].tolist()) if is_known else ()

    @property
    def voltages(self) -> tuple[np.ndarray, np.ndarray]:
        """(vm, va), shape (n_nodes,), p.u. and rad."""
        return self.x[self._n : 2 * self._n], self.x[: self._n]


def _checked(information: BoundaryInformation) -> BoundaryInformation:
    """``information``, checked as its receiver does. After a rejected message areas would wait for each other for ever.

    Raises:
        ArithmeticError: the receiver would reject the information.
    """
    if not are_within_reason((*information.R.flat, *information.z)):
        raise ArithmeticError("the information of this side is beyond reason")
    return information


def _flat_start(area: Area) -> np.ndarray:
    """x of the flat start of the whole grid, without power into children."""
    vm, va = area.find_no_load()
    return area.join_state(vm, va)
