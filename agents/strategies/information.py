"""``information``: the exact boundary exchange (``dsse_core.exchange``); its fixed point is the centralised estimate.

Each area takes damped Gauss-Newton steps on its own telemetry and its neighbours' information, and tells each
neighbour what all the others and it know about their boundary: 14 numbers, absolute. Load messages and the
local power flow only start the iteration.
"""

from __future__ import annotations

import numpy as np

from agents.area_file import AreaFile
from agents.messages import BoundaryNews, Header, InformationMessage
from agents.strategies.interface import Estimate, Knowledge, Strategy
from dsse_core.admittance import flat_start
from dsse_core.boundary_load import boundary_loads
from dsse_core.errors import DsseError
from dsse_core.exchange import (
    AreaModel,
    BoundaryInformation,
    build_area_model,
    compute_information,
    solve_step,
    state_variance,
)
from dsse_core.measurement import Measurement, MeasurementKind
from dsse_core.partition import Neighbour
from dsse_core.power_flow import solve_power_flow

SETTLED_STEP = 1e-11  # p.u., rad: below it a further step changes nothing
MEAN_MOVES = 1e-10  # p.u., rad: what of a boundary's marginal is worth a message
MEAN_MOVES_SIGMA = 1e-7  # or, if that is more, this part of its standard deviation
SIGMA_MOVES = 1e-3  # of its standard deviations
SINGULAR_MOVES = 1e-6  # relative change of L or e where the marginal does not exist
SINGULAR = 1e-13  # scaled eigenvalues below it leave a direction of y open
STEPS_PER_NEWS = 10
UPPER = np.triu_indices(4)


class Information(Strategy):
    """One area's state x between messages, and what it last used."""

    kind = InformationMessage.kind

    def __init__(self, content: AreaFile) -> None:
        self._content = content
        self._area = content.area
        self._measurements: tuple[Measurement, ...] = ()
        self._model: AreaModel | None = None
        self._x = np.zeros(0)
        self._newest: object = None
        self._heard: dict[str, BoundaryInformation] = {}
        self._referenced: set[str] = set()  # neighbours whose side knows the substation's angle
        self._steps_left = 0
        self._shown: Estimate | None = None

    @property
    def restless(self) -> bool:
        return self._steps_left > 0

    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        if known.measurements != self._measurements or self._model is None:
            self._take_measurements(known.measurements)
        newest = {name: message.header.order for name, message in known.boundary.items()}
        if newest != self._newest or self._shown is None:
            self._newest = newest
            self._take_messages(known)
            all_heard = len(self._heard) == len(self._area.neighbours)
            self._steps_left = STEPS_PER_NEWS if all_heard else 1  # alone, the state would run away from the start
        if self._steps_left > 0:
            self._step()
        return self._shown, self._notes()

    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> InformationMessage:
        assert self._model is not None  # there is an estimate
        others = [name for name in self._referenced if name != neighbour.area]
        referenced = self._has_own_angle or bool(others)
        told = compute_information(self._model, self._x, neighbour, self._heard, angle_known=referenced)
        L, e = tuple(told.L[UPPER].tolist()), tuple(told.e.tolist())
        return InformationMessage(header, neighbour.bus, L, e, referenced)

    def is_news(self, neighbour: Neighbour, message: BoundaryNews, last: BoundaryNews) -> bool:
        assert isinstance(message, InformationMessage)
        assert isinstance(last, InformationMessage)
        moved = _has_moved(_read(message), _read(last), self._heard.get(neighbour.area))
        return moved or message.referenced != last.referenced

    def find_refusal(self, message: BoundaryNews) -> str:
        assert isinstance(message, InformationMessage)
        return "" if _read(message).is_semidefinite else "information not semidefinite"

    @property
    def _has_own_angle(self) -> bool:
        angle_meters = any(m.meter.kind is MeasurementKind.VA for m in self._measurements)
        return self._area.reference is not None or angle_meters

    def _take_measurements(self, measurements: tuple[Measurement, ...]) -> None:
        """A new scan: the state so far is the start for it."""
        reference = self._area.reference[0] if self._area.reference else None
        self._model = build_area_model(self._area, measurements, reference)
        self._measurements = measurements
        self._shown = None

    def _take_messages(self, known: Knowledge) -> None:
        assert self._model is not None
        if not self._heard:
            self._start(known)
        self._heard = {name: _read(m) for name, m in known.boundary.items() if isinstance(m, InformationMessage)}
        was_referenced = bool(self._referenced) or self._has_own_angle
        self._referenced = {
            name for name, m in known.boundary.items() if isinstance(m, InformationMessage) and m.referenced
        }
        if self._referenced and not was_referenced:
            self._turn_to(min(self._referenced))

    def _start(self, known: Knowledge) -> None:
        """Start from the local power flow, once load messages allow one, else from the flat start."""
        area, network = self._area, self._area.network
        bus = area.reference[0] if area.reference else area.slack_bus
        vm, va = flat_start(network, bus)
        loads = boundary_loads(area, known.loads, self._content.load_error)
        if len(loads) == len(area.boundary_buses) and area.slack_vm is not None:
            try:
                beyond = {b: load.s for b, load in loads.items()}
                flow = solve_power_flow(network, slack=(area.slack_bus, area.slack_vm), extra_load=beyond)
                vm, va = flow.vm, flow.va
            except DsseError:
                pass  # a start, no more: a wrong load message must not stop the estimate
        if area.reference:
            va = va + area.reference[1] - va[network.row[bus]]
        children = [known.loads.get(n.area) for n in area.neighbours if not n.is_parent]
        powers = [part for load in children for part in ((load.s.real, load.s.imag) if load else (0.0, 0.0))]
        self._x = np.concatenate([va, vm, powers])

    def _turn_to(self, name: str) -> None:
        """Turn all angles to those of the side of the reference, so that no step has to; meters see no difference."""
        neighbour = next(n for n in self._area.neighbours if n.area == name)
        mean, _ = _marginal(self._heard[name])
        row = self._area.network.row[neighbour.bus]
        n = len(self._area.network.buses)
        self._x[:n] += mean[1] - self._x[row]

    def _step(self) -> None:
        assert self._model is not None
        dx = solve_step(self._model, self._x, self._heard)
        self._x = self._x + dx
        settled = abs(dx).max(initial=0.0) <= SETTLED_STEP
        self._steps_left = 0 if settled else self._steps_left - 1
        self._shown = self._estimate(self._model)

    def _estimate(self, model: AreaModel) -> Estimate:
        n = len(self._area.network.buses)
        sigma = np.sqrt(np.maximum(state_variance(model, self._x, self._heard), 0.0))
        weighted = model.residual(self._x) / model.sigma
        owned = n - (self._area.parent is not None)
        return Estimate(
            vm=self._x[n : 2 * n],
            va=self._x[:n],
            sigma_vm=sigma[n : 2 * n],
            sigma_va=sigma[:n],
            referenced=self._has_own_angle or bool(self._referenced),
            objective=float(weighted @ weighted),
            degrees_of_freedom=len(model.z) - 2 * owned + self._area.is_reference,
            removed=(),
        )

    def _notes(self) -> tuple[str, ...]:
        silent = [n.area for n in self._area.neighbours if n.area not in self._heard]
        return tuple(f"no information from {name} yet" for name in silent)


def _read(message: InformationMessage) -> BoundaryInformation:
    L = np.zeros((4, 4))
    L[UPPER] = message.L
    return BoundaryInformation(L + np.triu(L, 1).T, np.array(message.e))


def _marginal(*sides: BoundaryInformation) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of y, shape (4,), and its standard deviations, None where the sides together leave some of y open."""
    L, e = sum(side.L for side in sides), sum(side.e for side in sides)
    diagonal = np.diag(L)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    eigenvalues, vectors = np.linalg.eigh(L * np.outer(scale, scale))
    known = eigenvalues > SINGULAR * eigenvalues[-1]
    inverse = (vectors[:, known] / eigenvalues[known]) @ vectors[:, known].T
    sigma = scale * np.sqrt(np.diag(inverse)) if known.all() else None
    return scale * (inverse @ (scale * e)), sigma


def _has_moved(now: BoundaryInformation, last: BoundaryInformation, other: BoundaryInformation | None) -> bool:
    """Whether the marginal of y, together with the ``other`` side's information, differs enough to be told."""
    others = [other] if other is not None else []
    mean, sigma = _marginal(now, *others)
    last_mean, last_sigma = _marginal(last, *others)
    if sigma is None or last_sigma is None:
        pairs = ((now.L, last.L), (now.e, last.e))
        return any(abs(a - b).max() > SINGULAR_MOVES * abs(b).max() for a, b in pairs)
    worth_telling = np.maximum(MEAN_MOVES, MEAN_MOVES_SIGMA * sigma)
    return bool((abs(mean - last_mean) > worth_telling).any() or (abs(sigma / last_sigma - 1) > SIGMA_MOVES).any())
