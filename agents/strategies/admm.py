"""``admm``: consensus ADMM (``dsse_core.exchange``), for comparison; its fixed point is the centralised estimate.

An area waits for the neighbours that have the turn. Then it takes up to ``MOST_STEPS`` steps on its own telemetry and
the pulls of its boundaries, and sends the neighbours the result (``admm_boundary``). Load messages and the local power
flow only start the iteration.
"""

from __future__ import annotations

import numpy as np

from agents.messages.packing import BoundaryUpdate, Header
from agents.protocol.configuration import Configuration
from agents.strategies.admm_boundary import AdmmMessage, BoundaryIteration
from agents.strategies.interface import Estimate, Knowledge, Strategy
from agents.strategies.start import start_state
from dsse_core.exchange.consensus_admm import compute_weight, pull, solve_damped_step
from dsse_core.gauss_newton import MOST_STEPS, NO_STEP
from dsse_core.grid.boundary import boundary_of
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.partition import Neighbour
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import BEYOND_REASON, EXACT_SIGMA

LARGEST_R = np.array([1e6, 1e6, 1e3, 1e3])  # by kind, p.u. and rad; a larger r would cost z some of its digits
SETTLED = 1e-6  # p.u., rad: a last step below it shows the end


class Admm(Strategy):
    """One area's state x and its boundaries' iterations."""

    message_types = (AdmmMessage,)
    why_no_phases = ""

    def __init__(self, content: Configuration) -> None:
        self._content = content
        self._area = content.area
        self._measurements: tuple[Measurement, ...] = ()
        self._model: AreaModel | None = None
        self._x = np.zeros(0)
        self._boundaries = self._begin_iterations()
        self._sigma = np.zeros(0)
        self._moved = 0.0  # in the last step, p.u. and rad
        self._shown: Estimate | None = None

    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        changed = known.measurements != self._measurements or self._model is None
        if changed:
            self._take_measurements(known)
        changed |= self._receive(known)
        boundaries = list(self._boundaries.values())
        # Steps at other boundaries meanwhile take more messages and no less time. No wait for absent ones.
        waits = any(b.is_owed for b in boundaries if b.neighbour.area in known.present)
        for _ in range(MOST_STEPS):
            stepped = [] if waits else [b for b in boundaries if b.step(self._y(b))]
            moving = self._moved > NO_STEP and not any(b.is_owed for b in boundaries)
            if not (stepped or changed or moving):
                break
            changed = False
            self._take_step()
            for b in boundaries:
                if b in stepped or b.z is None:
                    b.set_sent(self._y(b))
        for b in boundaries:
            b.note_sent()
        return self._shown, self._notes()

    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> AdmmMessage:
        b = self._boundaries[neighbour.area]
        return AdmmMessage(
            header,
            neighbour.bus,
            variables=b.boundary.names,
            iteration=b.k,
            r=tuple(b.sent.tolist()),
            r_before=tuple(b.sent_before.tolist()),
            weight=tuple(b.weight.tolist()),
            unsettled=b.unsettled,
            referenced=b.angle_known,
        )

    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        assert isinstance(message, AdmmMessage)
        assert isinstance(last, AdmmMessage)
        return (message.iteration, message.weight, message.referenced) != (last.iteration, last.weight, last.referenced)

    def find_rejection(self, message: BoundaryUpdate) -> str:
        assert isinstance(message, AdmmMessage)
        largest = boundary_of(message.variables).per_kind(*LARGEST_R)
        possible = (np.abs([message.r, message.r_before]) < largest).all()
        weighs = min(message.weight) > 0 and max(message.weight) < BEYOND_REASON
        return "" if possible and weighs else "numbers beyond reason"

    def _begin_iterations(self) -> dict[str, BoundaryIteration]:
        return {n.area: BoundaryIteration(n, self._area.boundaries[n.area]) for n in self._area.neighbours}

    @property
    def _has_own_angle(self) -> bool:
        angle_meters = any(m.meter.kind.needs_reference for m in self._measurements)
        return self._area.reference is not None or angle_meters

    def _take_measurements(self, known: Knowledge) -> None:
        """Begin a new scan from the state and iterations so far, unless a flat start is closer to the readings."""
        reference = self._area.reference[0] if self._area.reference else None
        if self._model is not None:
            self._model.end()
        model = self._model = build_area_model(self._area, known.measurements, reference)
        self._measurements = known.measurements
        if all(b.z is None for b in self._boundaries.values()):
            self._x = start_state(self._content, known.loads)
        elif _distance(model, self._x) > _distance(model, flat := start_state(self._content, {})):
            self._x = flat
            self._boundaries = self._begin_iterations()
        self._sigma = self._own_sigma(model)
        for b in self._boundaries.values():
            b.weight = compute_weight(model, self._x, b.neighbour)

    def _receive(self, known: Knowledge) -> bool:
        """Take in the newest messages; True where their fields beside r change the pull on the area.

        The first message of a boundary must be of the current scan: an iteration that went astray may have ended with
        the scan before.
        """
        before = [b.terms for b in self._boundaries.values()]
        messages = {name: m for name, m in known.boundary.items() if isinstance(m, AdmmMessage)}
        started = {name for name, b in self._boundaries.items() if b.z is not None}
        received = {name: m for name, m in messages.items() if name in started or m.header.scan == known.scan}
        for name, b in self._boundaries.items():
            b.received = received.get(name)
            b.angle_known = self._has_own_angle or any(m.referenced for other, m in received.items() if other != name)
        return before != [b.terms for b in self._boundaries.values()]

    def _take_step(self) -> None:
        """Take one Gauss-Newton step on the own J plus all pulls; solving to the end each time saves no message."""
        assert self._model is not None
        pulls = {}
        for name, b in self._boundaries.items():
            if (pulled := b.pull(self._content.penalty)) is not None:
                pulls[name] = pulled
            self._x[: self._model.n_nodes] += b.find_turn(self._y(b))  # all at once: meters see no difference
        dx = solve_damped_step(self._model, self._x, pulls)
        self._x, self._moved = self._x + dx, float(abs(dx).max(initial=0.0))
        self._shown = self._estimate(self._model)

    def _y(self, boundary: BoundaryIteration) -> np.ndarray:
        assert self._model is not None
        return self._model.boundary(self._x, boundary.neighbour)[0]

    def _own_sigma(self, model: AreaModel) -> np.ndarray:
        """Standard deviations of x from the area's own meters alone, its angles relative to its parent's bus."""
        given = {}
        if self._area.parent and not self._has_own_angle:
            is_angle = self._boundaries[self._area.parent.area].is_angle
            given[self._area.parent.area] = pull(is_angle * EXACT_SIGMA**-2.0, np.zeros(len(is_angle)))
        sigma: np.ndarray = np.sqrt(np.maximum(model.linear.variances(self._x, given)[0], 0.0))
        return sigma

    def _estimate(self, model: AreaModel) -> Estimate:
        n = model.n_nodes
        weighted = model.residual(self._x) / model.sigma
        return Estimate(
            vm=self._x[n : 2 * n],
            va=self._x[:n],
            sigma_vm=self._sigma[n : 2 * n],
            sigma_va=self._sigma[:n],
            referenced=self._has_own_angle or any(b.angle_received for b in self._boundaries.values()),
            objective=float(weighted @ weighted),
            degrees_of_freedom=len(model.z) - self._area.n_unknown,
            removed=(),
            settled=self._moved <= SETTLED,
        )

    def _notes(self) -> tuple[str, ...]:
        return tuple(f"no message from {name} yet" for name, b in self._boundaries.items() if b.received is None)


def _distance(model: AreaModel, x: np.ndarray) -> float:
    """Distance of ``x`` from the readings: J without the virtual measurements; infinity if it is not a number."""
    weighted = (model.residual(x) / model.sigma)[~model.virtual]
    return float(np.nan_to_num(weighted @ weighted, nan=np.inf))
