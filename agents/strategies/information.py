"""``information``: the exact boundary exchange (``dsse_core.exchange``); its fixed point is the centralised estimate.

Each area takes damped Gauss-Newton steps on its own telemetry and its neighbours' information, and tells each
neighbour what all the others and it know about their boundary: 14 numbers, absolute. Load messages and the
local power flow only start the iteration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agents.area_file import AreaFile
from agents.messages import BoundaryNews, Header, Incarnation, InformationMessage, TallyMessage, content_of
from agents.strategies.angle_turns import (
    agree_on_full_turns,
    find_turn_to_angle_meter,
    find_turn_to_neighbour,
    knows_angle,
)
from agents.strategies.bad_data_tree import BadDataTree
from agents.strategies.boundary_marginal import distance_between, has_moved
from agents.strategies.information_to_tell import InformationToTell
from agents.strategies.interface import Estimate, Knowledge, Strategy
from agents.strategies.local_iteration import LocalIteration
from agents.strategies.start import start_state
from agents.triangle import write_triangle
from dsse_core.area_model import AreaModel, build_area_model, choose_backend
from dsse_core.bad_data import DEAD_VM, chi_square_limit
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange import find_variances, state_variance
from dsse_core.feeder_bad_data import NoLoadModel, build_no_load_model, count_freedom, find_objective
from dsse_core.measurement import Measurement, MeasurementKind
from dsse_core.partition import Neighbour

SURELY_NEWS = 1e-4  # p.u., rad; what is told after moving by more, and takes longer to compare than to tell
ANSWERED = 1e-6  # p.u., rad: what a neighbour is told after moving less changes its answer by its square, or next to it
NEWS_PER_NEIGHBOUR = 500  # of one set of measurements, all areas heard; with more, areas swing against each other
CONTRADICTION = 0.9999  # confidence of the test of a neighbour's information against the rest


class Information(Strategy):
    """One area's side: the model of its readings, what it has heard, and the estimate that it shows."""

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
        self._iteration = LocalIteration()
        self._newest: dict[str, tuple[Incarnation, int]] = {}
        self._heard: dict[str, BoundaryInformation] = {}
        self._referenced: set[str] = set()  # neighbours whose side knows the substation's angle
        self._complete: set[str] = set()  # neighbours whose side has been heard, all of it
        self._has_new_readings = False  # or a decision which of them are in use
        self._to_tell = InformationToTell()
        self._news = 0  # since all areas have been heard, of these measurements
        self._shown: Estimate | None = None
        self._shown_x = np.zeros(0)
        self._variances: tuple[np.ndarray, np.ndarray] | None = None  # in the shown state, once asked for

    @property
    def restless(self) -> bool:
        return self._iteration.steps_left > 0

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
            self._iteration.take_news(by_halves=self._seems_to_swing)
        elif self._is_informed:
            self._iteration.go_on()
        if self._is_swinging:
            self._iteration.stop()
        if self.restless:
            self._step()
        if self._shown is None and self._is_swinging:
            assert self._model is not None
            self._shown = self._estimate(self._model, self._iteration.x)  # no step of this scan was ever small
        return self._shown, self._notes()

    def judge(self, known: Knowledge, estimate: Estimate) -> tuple[Estimate, tuple[str, ...]]:
        assert self._model is not None  # there is an estimate
        tree = self._tree
        settled = self._is_informed and not self._is_swinging
        tree.judge(self._model, self._iteration.x, lambda: self._find_variances()[1], settled, known)
        if (known.measurements, tree.decisions) != self._basis:
            self._iteration.steps_left = 1  # solve is to be called again
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
        information = self._to_tell.find(self._model, self._iteration.x, neighbour, self._heard)
        R, z = write_triangle(information.R), tuple(information.z.tolist())
        return InformationMessage(header, neighbour.bus, R, z, referenced, complete=others <= self._complete)

    def is_news(self, neighbour: Neighbour, message: BoundaryNews, last: BoundaryNews) -> bool:
        assert isinstance(message, InformationMessage)
        assert isinstance(last, InformationMessage)
        assert self._model is not None
        if content_of(message) == content_of(last):
            return False
        if self._to_tell.moved[neighbour.area] > SURELY_NEWS:
            return True
        y = self._model.boundary_values(self._iteration.x, neighbour)
        moved = has_moved(y, message.information, last.information, self._heard.get(neighbour.area))
        return moved or (message.referenced, message.complete) != (last.referenced, last.complete)

    def expects_answer(self, neighbour: Neighbour) -> bool:
        return self._to_tell.moved[neighbour.area] > ANSWERED

    def find_refusal(self, message: BoundaryNews) -> str:
        assert isinstance(message, InformationMessage)
        return "" if message.is_within_reason else "information beyond reason"

    @property
    def _is_referenced(self) -> bool:
        return self._has_own_angle or bool(self._referenced)

    @property
    def _is_informed(self) -> bool:
        return len(self._complete) == len(self._area.neighbours) and self._is_referenced

    @property
    def _is_swinging(self) -> bool:
        return self._news > NEWS_PER_NEIGHBOUR * max(1, len(self._area.neighbours))

    @property
    def _seems_to_swing(self) -> bool:
        """Halfway there with current magnitudes, whose residuals bend what areas tell: half steps settle that."""
        halfway = self._news > NEWS_PER_NEIGHBOUR * max(1, len(self._area.neighbours)) / 2
        return halfway and self._model is not None and MeasurementKind.CURRENT in self._model.kinds

    def _take_measurements(self, telemetry: tuple[Measurement, ...]) -> None:
        """A new scan, or a decision on it: the state so far is the start."""
        dead = [m.meter.id for m in telemetry if m.value < DEAD_VM and m.meter.kind is MeasurementKind.VM]
        own = {m.meter.id for m in telemetry} if self._tree.decisions else set()
        self._removed = (*dead, *(meter for meter in self._tree.decisions if meter in own and meter not in dead))
        selected = self._tree.select(telemetry)
        self._measurements = tuple(m for m in selected if not (dead and m.meter.id in dead))
        has_angle_meter = any(m.meter.kind is MeasurementKind.VA for m in self._measurements)
        self._has_own_angle = has_angle_meter or self._area.reference is not None
        held_back = len(telemetry) - len(self._measurements) - len(self._removed)
        self._build_models()
        assert self._no_load is not None
        self._tree.take_measurements(self._no_load, held_back)
        self._shown = None
        self._has_new_readings = True
        self._to_tell.forget()
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
            self._iteration.begin_at(start_state(self._content, known.loads))
            self._iteration.turn(self._model, find_turn_to_angle_meter(self._model, self._iteration.x))
        messages = {name: m for name, m in known.boundary.items() if isinstance(m, InformationMessage)}
        self._heard = {name: m.information for name, m in messages.items()}
        self._complete = {name for name, m in messages.items() if m.complete}
        was_referenced = self._is_referenced
        self._referenced = {name for name, m in messages.items() if m.referenced and knows_angle(self._heard[name])}
        if self._referenced and not was_referenced:
            first = next(n for n in self._area.neighbours if n.area == min(self._referenced))
            angle = find_turn_to_neighbour(self._model, self._iteration.x, first, self._heard[first.area])
            self._iteration.turn(self._model, angle)
        angle, self._heard = agree_on_full_turns(self._model, self._iteration.x, self._heard, self._referenced)
        self._iteration.turn(self._model, angle)

    def _step(self) -> None:
        assert self._model is not None
        if not self._is_informed:
            x = self._iteration.step_near_start(self._model, self._heard)
            self._shown = self._estimate(self._model, x)
        elif self._iteration.step(self._model, self._heard):
            self._shown = self._estimate(self._model, self._iteration.x)

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
            sent, y = known.sent.get(n.area), self._model.boundary_values(self._iteration.x, n)
            if not isinstance(sent, InformationMessage):
                continue  # it has nothing yet that it could contradict
            distance, freedom = distance_between(y, sent.information, self._heard[n.area])
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
