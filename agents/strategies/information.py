"""``information``: the exact boundary exchange (``dsse_core.exchange``); its fixed point is the centralised estimate.

Each area takes damped Gauss-Newton steps on its own telemetry and its neighbours' information, and tells each
neighbour what all the others and it know about their boundary: 14 numbers, absolute. Load messages and the
local power flow only start the iteration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from agents.area_file import AreaFile
from agents.messages import BoundaryNews, Header, Incarnation, InformationMessage, TallyMessage
from agents.strategies.bad_data_tree import BadDataTree
from agents.strategies.boundary_marginal import distance_between, has_moved
from agents.strategies.interface import Estimate, Knowledge, Strategy
from agents.strategies.start import start_state
from agents.triangle import read_triangle, write_triangle
from dsse_core.area_model import AreaModel, build_area_model, choose_backend
from dsse_core.bad_data import DEAD_VM, chi_square_limit
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange import (
    compute_information,
    find_variances,
    solve_step,
    solve_step_near,
    solve_steps,
    state_variance,
)
from dsse_core.feeder_bad_data import NoLoadModel, build_no_load_model, count_freedom, find_objective
from dsse_core.kept_factor import ON_THE_WAY, KeptFactor, find_rest
from dsse_core.measurement import Measurement, MeasurementKind
from dsse_core.partition import Neighbour

SETTLED_STEP = 1e-11  # p.u., rad: below it a further step changes nothing
TOLD_EARLY = 1e-6  # p.u., rad: after a smaller step neighbours are told, further ones change nothing of it
SAME_STATE = 1e-8  # p.u., rad: what it is told at; information about it changes by as little, relatively
SAME_MESSAGE = 1e-7  # the same, where the state moves ever less: the next time by less than
SAME_NEXT = 1e-10  # p.u., rad
SURELY_NEWS = 1e-4  # p.u., rad; what is told after moving by more, and takes longer to compare than to tell
ANSWERED = 1e-6  # p.u., rad: what a neighbour is told after moving less changes its answer by its square, or next to it
SETTLED_NEAR_START = 1e-6  # p.u., rad: while news is missing
STEPS_PER_NEWS = 40
TINY = 1e-30
FULL_STEPS = 10  # at once; what takes longer swings around the answer, and half steps settle it
NEWS_PER_NEIGHBOUR = 100  # of one set of measurements, all areas heard; with more, areas swing against each other
CONTRADICTION = 0.9999  # confidence of the test of a neighbour's information against the rest


class Information(Strategy):
    """One area's state x between messages, and what it last used."""

    kind = InformationMessage.kind
    other_kinds = (TallyMessage.kind,)
    passes_on = True

    def __init__(self, content: AreaFile) -> None:
        self._content = content
        self._area = content.area
        self._tree = BadDataTree(content.area, {meter.id for meter in content.meters})
        self._basis: object = None  # telemetry and decisions that the model is made from
        self._measurements: tuple[Measurement, ...] = ()
        self._removed: tuple[str, ...] = ()  # the area's own meters
        self._has_own_angle = content.area.reference is not None
        self._model: AreaModel | None = None
        self._no_load: NoLoadModel | None = None
        self._x = self._start = np.zeros(0)
        self._newest: dict[str, tuple[Incarnation, int]] = {}
        self._heard: dict[str, BoundaryInformation] = {}
        self._referenced: set[str] = set()  # neighbours whose side knows the substation's angle
        self._complete: set[str] = set()  # neighbours whose side has been heard, all of it
        self._has_new_readings = False  # or a decision which of them are in use
        self._steps_left = 0
        self._last_step = np.inf
        self._factor: KeptFactor | None = None
        # neighbour -> information last computed for it, after the messages of others that it rests on
        self._computed: dict[str, tuple[dict[str, BoundaryInformation], BoundaryInformation]] = {}
        # neighbour -> the state at which that was, and before it by how much it had moved since the time before
        self._moved: dict[str, tuple[float, np.ndarray]] = {}
        self._is_released = False  # a state that rests on the newest messages, for neighbours to be told
        self._news = 0  # since all areas have been heard, of these measurements
        self._shown: Estimate | None = None
        self._shown_x = np.zeros(0)
        self._variances: tuple[np.ndarray, np.ndarray] | None = None  # in the shown state, once asked for

    @property
    def restless(self) -> bool:
        return self._steps_left > 0

    def describe_backend(self) -> str:
        chosen = choose_backend(self._area)
        tree = self._model.tree if self._model else None
        left = [f"{count} for {why}" for why, count in tree.declined.most_common()] if tree else []
        return f"{chosen}, calls left to sparse matrices: {', '.join(left)}" if left else chosen

    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        self._tree.adopt(known)
        basis = (known.measurements, self._tree.decisions)
        if basis != self._basis:
            self._basis = basis
            self._take_measurements(known.measurements)
        newest = {name: message.header.order for name, message in known.boundary.items()}
        if {name: order[0] for name, order in newest.items()} != {n: order[0] for n, order in self._newest.items()}:
            self._news = 0  # another life of a neighbour starts from nothing
        if newest != self._newest or self._has_new_readings:
            self._newest, self._has_new_readings = newest, False
            self._take_messages(known)
            self._news += self._is_informed
            self._last_step = np.inf
            self._is_released = False
            self._steps_left = 0 if self._is_swinging else STEPS_PER_NEWS
        elif self._is_informed and self._steps_left == 0 and self._last_step > ON_THE_WAY and not self._is_swinging:
            self._steps_left = STEPS_PER_NEWS  # it was not enough, and there is time now
        if self._steps_left > 0:
            self._step()
        if self._shown is None and self._is_swinging:
            assert self._model is not None
            self._shown = self._estimate(self._model, self._x)  # no step of this scan was ever small
        return self._shown, self._notes()

    def judge(self, known: Knowledge, estimate: Estimate) -> tuple[Estimate, tuple[str, ...]]:
        assert self._model is not None  # there is an estimate
        tree = self._tree
        settled = self._is_informed and not self._is_swinging
        tree.judge(self._model, self._measurements, self._x, lambda: self._find_variances()[1], settled, known)
        if (known.measurements, tree.decisions) != self._basis:
            self._steps_left = 1
        checked = tree.finished and settled
        n, sigma = len(self._area.network.buses), np.sqrt(np.maximum(self._find_variances()[0], 0.0))
        estimate = replace(
            estimate, sigma_vm=sigma[n : 2 * n], sigma_va=sigma[:n], checked=checked, critical=tree.critical
        )
        return estimate, self._find_contradictions(known) if tree.searched and settled else ()

    def tally_for(self, neighbour: Neighbour, header: Header) -> TallyMessage:
        return self._tree.message_for(neighbour, header)

    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> InformationMessage:
        assert self._model is not None  # there is an estimate
        others = {n.area for n in self._area.neighbours} - {neighbour.area}
        referenced = self._has_own_angle or bool(others & self._referenced)
        told = self._information_for(neighbour)
        R, z = write_triangle(told.R), tuple(told.z.tolist())
        return InformationMessage(header, neighbour.bus, R, z, referenced, complete=others <= self._complete)

    def _information_for(self, neighbour: Neighbour) -> BoundaryInformation:
        """What was computed last, where neither the others' messages nor, but for rounding, the state has changed."""
        assert self._model is not None
        others = {name: heard for name, heard in self._heard.items() if name != neighbour.area}
        before, told_at = self._moved.get(neighbour.area, (np.inf, np.zeros(0)))
        moved = float(abs(self._x - told_at).max()) if told_at.shape == self._x.shape else np.inf
        if (last := self._computed.get(neighbour.area)) is not None:
            ends = moved <= SAME_MESSAGE and moved * moved <= SAME_NEXT * before < np.inf
            if (moved <= SAME_STATE or ends) and _are_same(last[0], others):
                return last[1]
        self._moved[neighbour.area] = moved, self._x
        information = compute_information(self._model, self._x, neighbour, self._heard)
        self._computed[neighbour.area] = others, information
        return information

    def is_news(self, neighbour: Neighbour, message: BoundaryNews, last: BoundaryNews) -> bool:
        assert isinstance(message, InformationMessage)
        assert isinstance(last, InformationMessage)
        assert self._model is not None
        if replace(message, header=last.header) == last:
            return False
        if self._moved[neighbour.area][0] > SURELY_NEWS:
            return True
        y = self._model.boundary_values(self._x, neighbour)
        moved = has_moved(y, _read(message), _read(last), self._heard.get(neighbour.area))
        return moved or (message.referenced, message.complete) != (last.referenced, last.complete)

    def expects_answer(self, neighbour: Neighbour) -> bool:
        return self._moved[neighbour.area][0] > ANSWERED

    def find_refusal(self, message: BoundaryNews) -> str:
        assert isinstance(message, InformationMessage)
        return "" if _read(message).is_reasonable else "information beyond reason"

    @property
    def _is_referenced(self) -> bool:
        return self._has_own_angle or bool(self._referenced)

    @property
    def _is_informed(self) -> bool:
        return len(self._complete) == len(self._area.neighbours) and self._is_referenced

    @property
    def _is_swinging(self) -> bool:
        return self._news > NEWS_PER_NEIGHBOUR * max(1, len(self._area.neighbours))

    def _take_measurements(self, telemetry: tuple[Measurement, ...]) -> None:
        """A new scan, or a decision on it: the state so far is the start."""
        dead = [m.meter.id for m in telemetry if m.meter.kind is MeasurementKind.VM and m.value < DEAD_VM]
        own = {m.meter.id for m in telemetry}
        self._removed = (*dead, *(meter for meter in self._tree.decisions if meter in own and meter not in dead))
        selected = self._tree.select(telemetry)
        self._measurements = tuple(m for m in selected if m.meter.id not in dead)
        has_angle_meter = any(m.meter.kind is MeasurementKind.VA for m in self._measurements)
        self._has_own_angle = has_angle_meter or self._area.reference is not None
        held_back = len(telemetry) - len(self._measurements) - len(self._removed)
        self._build_models()
        assert self._no_load is not None
        self._tree.take_measurements(self._no_load, held_back)
        self._shown = None
        self._has_new_readings = True
        self._computed = {}
        self._news = 0

    def _build_models(self) -> None:
        """For other meters anew; other readings of the same ones change neither rows nor what cannot be spared."""
        if self._model is not None and self._model.meters == tuple(m.meter for m in self._measurements):
            self._model = self._model.with_readings(self._measurements)
            return
        reference = self._area.reference[0] if self._area.reference else None
        self._model = build_area_model(self._area, self._measurements, reference)
        self._no_load = build_no_load_model(self._area, self._measurements, reference)

    def _take_messages(self, known: Knowledge) -> None:
        assert self._model is not None
        if not self._heard:
            self._x = self._start = start_state(self._content, known.loads)
            self._turn_to_angle_meter()
        messages = {name: m for name, m in known.boundary.items() if isinstance(m, InformationMessage)}
        self._heard = {name: _read(m) for name, m in messages.items()}
        self._complete = {name for name, m in messages.items() if m.complete}
        was_referenced = self._is_referenced
        self._referenced = {name for name, m in messages.items() if m.referenced}
        if self._referenced and not was_referenced:
            self._turn(self._angle_from(min(self._referenced)))
        self._agree_on_full_turns()

    def _agree_on_full_turns(self) -> None:
        """Angles mean the same with 2 pi added: as the parent counts them, and children are read as we count."""
        for n in sorted(self._area.neighbours, key=lambda n: not n.is_parent):
            if n.area in self._referenced and (turns := round(self._angle_from(n.area) / (2 * np.pi))):
                if n.is_parent:
                    self._turn(2 * np.pi * turns)
                else:
                    told = self._heard[n.area]
                    self._heard[n.area] = replace(told, z=told.z - 2 * np.pi * turns * told.R[:, 3])

    def _angle_from(self, name: str) -> float:
        """By how much neighbour ``name`` would have us turn all angles, power and magnitude as they are."""
        assert self._model is not None
        neighbour = next(n for n in self._area.neighbours if n.area == name)
        y = self._model.boundary_values(self._x, neighbour)
        told = self._heard[name]
        of_angle = told.R[:, 3]
        return float(of_angle @ (told.z - told.R @ y) / max(of_angle @ of_angle, TINY))

    def _turn_to_angle_meter(self) -> None:
        """An angle meter too says where the substation's zero is, where the area does not see it."""
        assert self._model is not None
        angles = np.flatnonzero(self._model.kinds == MeasurementKind.VA)
        if angles.size and self._area.reference is None:
            most_exact = angles[np.argmin(self._model.sigma[angles])]
            self._turn(float(self._model.residual(self._x)[most_exact]))

    def _turn(self, angle: float) -> None:
        all_angles = np.arange(len(self._x)) < len(self._area.network.buses)
        self._x, self._start = (x + angle * all_angles for x in (self._x, self._start))

    def _step(self) -> None:
        assert self._model is not None
        if not self._is_informed:
            self._steps_left = 0
            self._x = self._near_start(self._x)
            self._shown = self._estimate(self._model, self._settled_near_start())
            return
        self._steps_left -= 1
        dx, sizes = self._solve_steps(self._model)
        self._x = _with_positive_magnitudes(self._x + dx, len(self._area.network.buses))
        rest = find_rest([self._last_step, *sizes])
        self._last_step = sizes[-1]
        if rest <= SETTLED_STEP:
            self._steps_left = 0
            self._start = self._x
        early = not self._is_released and self._last_step <= TOLD_EARLY
        if self._steps_left == 0 or early:
            self._is_released = True
            self._shown = self._estimate(self._model, self._x)

    def _solve_steps(self, model: AreaModel) -> tuple[np.ndarray, list[float]]:
        """All that one factor serves for, or half a step after too many."""
        if self._steps_left >= STEPS_PER_NEWS - FULL_STEPS:
            dx, sizes, self._factor = solve_steps(
                model, self._x, self._heard, self._last_step, SETTLED_STEP, self._factor
            )
            return dx, sizes
        dx = solve_step(model, self._x, self._heard, self._last_step) / 2
        return dx, [float(abs(dx).max(initial=0.0))]

    def _near_start(self, x: np.ndarray) -> np.ndarray:
        assert self._model is not None
        step = solve_step_near(self._model, x, self._heard, self._start)
        return _with_positive_magnitudes(x + step, len(self._area.network.buses))

    def _settled_near_start(self) -> np.ndarray:
        """What the area can say before all have been heard. Messages do not rest on it: half of the news misleads."""
        x = self._x
        for _ in range(FULL_STEPS):
            before, x = x, self._near_start(x)
            if abs(x - before).max(initial=0.0) <= SETTLED_NEAR_START:
                break
        return x

    def _estimate(self, model: AreaModel, x: np.ndarray) -> Estimate:
        """The state ``x``; how well it is known, and what of it is sure, neighbours need not wait for (``judge``)."""
        n = len(self._area.network.buses)
        self._shown_x = x
        self._variances = None
        return Estimate(
            vm=x[n : 2 * n],
            va=x[:n],
            sigma_vm=np.zeros(n),
            sigma_va=np.zeros(n),
            referenced=self._is_referenced,
            objective=find_objective(model, x),
            degrees_of_freedom=count_freedom(model),
            removed=self._removed,
            checked=False,
        )

    def _find_variances(self) -> tuple[np.ndarray, np.ndarray]:
        """diag(G^-1) and diag(Omega) in the shown state; of the latter nothing before all areas have been heard."""
        if self._variances is None:
            assert self._model is not None
            if self._is_informed:
                self._variances = find_variances(self._model, self._shown_x, self._heard)
            else:
                of_state = state_variance(self._model, self._shown_x, self._heard, near_start=True)
                self._variances = of_state, np.zeros(0)
        return self._variances

    def _find_contradictions(self, known: Knowledge) -> tuple[str, ...]:
        """Neighbours whose information is farther from that of this side than their covariances allow."""
        assert self._model is not None
        notes = []
        for n in self._area.neighbours:
            told, y = known.told.get(n.area), self._model.boundary_values(self._x, n)
            if not isinstance(told, InformationMessage):
                continue  # it has nothing yet that it could contradict
            distance, freedom = distance_between(y, _read(told), self._heard[n.area])
            limit = chi_square_limit(freedom, CONTRADICTION)
            if distance >= limit:
                notes.append(
                    f"information from {n.area} contradicts the rest: distance {distance:.4g}, limit {limit:.4g}"
                )
        return tuple(notes)

    def _notes(self) -> tuple[str, ...]:
        silent = [n.area for n in self._area.neighbours if n.area not in self._heard]
        notes = [f"no information from {name} yet" for name in silent]
        partial = sorted(self._heard.keys() - self._complete)
        notes += [f"{name} has not heard all areas of its side yet" for name in partial]
        if self._is_swinging:
            notes.append(
                f"does not settle: the neighbours' information has changed {self._news} times since the last reading "
                "or decision; a false message can do this, or currents metered far better than flows and injections"
            )
        return tuple(notes)


def _with_positive_magnitudes(x: np.ndarray, n: int) -> np.ndarray:
    """The same phasors: a step may have led through zero."""
    through_zero = np.flatnonzero(x[n : 2 * n] < 0)
    x[n + through_zero] *= -1
    x[through_zero] += np.pi
    return x


def _read(message: InformationMessage) -> BoundaryInformation:
    return BoundaryInformation(read_triangle(message.R), np.array(message.z))


def _are_same(some: Mapping[str, BoundaryInformation], others: Mapping[str, BoundaryInformation]) -> bool:
    if some.keys() != others.keys():
        return False
    return all((heard.R == others[name].R).all() and (heard.z == others[name].z).all() for name, heard in some.items())
