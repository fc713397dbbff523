"""Test of all power readings of one gateway together: as stated, or multiplied by one factor, such as a wrong sign.

Readings of one gateway that are wrong alike contradict each other nowhere. Residuals cannot show the mistake: bad-data
removal would take out a sound meter at the boundary instead. This test compares hypotheses about the readings z as a
whole. Under H_f the true powers are f times the gateway's readings; f = 1 is as stated. The evidence is all other
information of the area: its voltmeters and other gateways, the information of its neighbours, and the range of its
loads (``Load``). With M_f the least weighted sum of squares of all that under H_f, over the state of the area,

    log p(z | H_f) = n log|f| - M_f / 2 + constant,

with n the number of readings that are multiplied: the density of z is that of f z, times the Jacobian of the change of
variables. Where standard deviations grow with f, the density is divided by the growth of these standard deviations,
joined with those of the loads. Beside f = 1 stands "something else": all standard deviations are wrong by one factor,
the likeliest one. Then N residuals have log p = -N/2 (1 + log(M_1 / N)). So a mistake is only found where it fits.
Beside a factor above 1 stands that the standard deviations, not the readings, have the wrong unit. Otherwise sound
readings that are far more exact than stated would pass for too small ones.

The information of neighbours may rest on a wrong gateway of theirs: two sides of opposite sign contradict each other,
and a change of either side mends it. So the smaller of the evidence with and without their information counts.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from dsse_core.estimation.residuals import FALSE_ALARMS, find_dead
from dsse_core.gauss_newton import LAST_STEP, MOST_STEPS
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Control
from dsse_core.grid.partition import Area
from dsse_core.grid.quantities import Quantity
from dsse_core.linear.area_model import build_area_model
from dsse_core.linear.boundary_information import BoundaryInformation
from dsse_core.linear.contributions import VoltageReadings

KIND = MeasurementKind
MISTAKES: Mapping[float, str] = {-1.0: "sign", 1e-3: "unit, 1000 times too large", 1e3: "unit, 1000 times too small"}
"""Factor by which readings would have to be multiplied -> name of the mistake."""
LOWEST_LOAD, HIGHEST_LOAD = 0.2, 1.5  # range of a load, in parts of its schedule
THRESHOLD = math.log(len(MISTAKES) / FALSE_ALARMS)  # of the sum of log-likelihood ratios, see ``add_up``

Received = Mapping[str, BoundaryInformation]


def add_up(so_far: float, of_scan: float) -> float:
    """Evidence of several scans: Page's cumulative sum, which stays between 0 and twice ``THRESHOLD``.

    With readings as stated it exceeds ``THRESHOLD`` once in exp(``THRESHOLD``) scans or more on average (Lorden 1971),
    as long as the noise of two scans is independent.
    """
    return min(max(0.0, so_far + of_scan), 2 * THRESHOLD)


@dataclass(frozen=True, slots=True)
class Load:
    """Mean and standard deviation of an injection according to the schedule, p.u."""

    mean: float
    sigma: float


Place = tuple[MeasurementKind, int, str]  # kind, bus and phase of an injection


def expect_loads(area: Area) -> dict[Place, Load]:
    """Place -> expected injection, for the nodes that the area owns and that have a schedule.

    The Q of a load lies between ``LOWEST_LOAD`` and ``HIGHEST_LOAD`` of its schedule, evenly distributed. The standard
    deviation is in parts of the apparent power, as the power factor is not constant. The P of a load lies between minus
    and plus ``HIGHEST_LOAD`` of the apparent power, as photovoltaics outside the schedule may turn it. At a bus with a
    generator P and Q both lie in that range, of the apparent power of load and generation. So they do at a node with a
    leg to another one, as the angle of their voltages counts. A bus whose generator holds the voltage has no expected
    injection.
    """
    network = area.network
    spread, spread_of_either_sign = (HIGHEST_LOAD - LOWEST_LOAD) / math.sqrt(12), HIGHEST_LOAD / math.sqrt(3)
    produced: dict[int, float] = {}
    for generator in network.generators:
        size = abs(complex(generator.p, generator.q)) if generator.control is Control.POWER else math.inf
        produced[generator.bus] = produced.get(generator.bus, 0.0) + size
    drawn, between, legs = [0.0] * network.n_nodes, set[int](), network.legs
    q = [0.0] * network.n_nodes
    for node, other, s in zip(legs.node.tolist(), legs.other.tolist(), legs.s.tolist(), strict=True):
        for end in (node, other)[: 1 + (other >= 0)]:
            drawn[end] += abs(s)
        q[node] += s.imag
        between |= {node, other} if other >= 0 else set()
    expected = {}
    for node, (bus, phase) in enumerate(zip(network.node_buses, network.node_phases or repeat(""), strict=False)):
        size = drawn[node] + produced.get(bus, 0.0)
        if bus in area.not_owned or not 0 < size < math.inf:
            continue
        either = Load(0.0, spread_of_either_sign * size)
        of_load = Load(-(LOWEST_LOAD + HIGHEST_LOAD) / 2 * q[node], spread * size)
        expected[KIND.P_INJECTION, bus, phase] = either
        expected[KIND.Q_INJECTION, bus, phase] = either if bus in produced or node in between else of_load
    return expected


@dataclass(frozen=True)
class _Hypothesis:
    """Readings under a hypothesis, each joined with the expected injection of its load; p.u. and rad, (n_meas,).

    ``beside``: the part of M that does not depend on the state. ``spread``: log of the product of its variances; the
    density is divided by the root of this product.
    """

    z: np.ndarray
    sigma: np.ndarray
    beside: float
    spread: float = 0.0


class GatewayTest:
    """The test of gateways in ``area``."""

    def __init__(self, area: Area) -> None:
        self._area = area
        self._reference = area.reference[0] if area.reference else None
        self._loads = expect_loads(area)
        self._rows: _Rows | None = None

    def weigh(
        self, readings: Sequence[Measurement], of_gateway: Collection[str], x: np.ndarray | None, received: Received
    ) -> dict[float, float]:
        """Factor -> log of the likelihood ratio of its mistake to "as stated" or "something else", the likelier one.

        Minus infinity where a bound shows that the ratio is below 0; empty without power readings of the gateway.

        Args:
            readings: of the area, virtual ones included.
            of_gateway: ids of the gateway's meters.
            x: state of the area, see ``AreaModel``, to which ``received`` belongs; None without both.
        """
        rows = self._rows_of(readings)
        z, sigma = rows.put(readings)
        multiplied = (
            rows.is_power & (z != 0.0) & np.array([meter.id in of_gateway for meter in rows.meters], dtype=bool)
        )
        if not multiplied.any():
            return {}
        start = self._flat_start() if x is None else x
        stated = rows.join(z, sigma)
        least = rows.solve(stated, start, received) if x is None else math.inf
        bound = min(least, rows.find_misfit(stated, start, received))
        n_known = len(self._loads) + sum(self._area.boundaries[name].n_powers for name in received)
        by_factor, jacobians, at_most = {}, {}, {}
        for factor in MISTAKES:
            by_factor[factor] = rows.join(*_multiply(z, sigma, multiplied, factor))
            growth = (by_factor[factor].spread - stated.spread) / 2
            jacobians[factor] = rows.count(multiplied, factor, n_known) * math.log(abs(factor)) - growth
            at_most[factor] = jacobians[factor] - by_factor[factor].beside / 2 + bound / 2
        found = dict.fromkeys(MISTAKES, -math.inf)
        if max(at_most.values()) <= 0:
            return found
        if x is not None:
            least = rows.solve(stated, start, received)
        if math.isinf(least) and received:
            return self.weigh(readings, of_gateway, None, {})
        least = min(least, bound)
        n = rows.n_residuals + sum(len(message.rows[1]) for message in received.values())
        reference = max(-least / 2, -n / 2 * (1 + math.log(max(least / n, 1.0))))
        for factor, hypothesis in by_factor.items():
            if at_most[factor] > 0:
                other = reference
                if abs(factor) > 1:
                    exact = rows.join(z, np.where(multiplied, sigma / abs(factor), sigma))
                    density = rows.count_apart(multiplied, n_known) * math.log(abs(factor))
                    density += (stated.spread - exact.spread) / 2
                    other = max(other, density - rows.solve(exact, start, received) / 2)
                found[factor] = jacobians[factor] - rows.solve(hypothesis, start, received) / 2 - other
        if received and max(found.values()) > 0:
            alone = self.weigh(readings, of_gateway, None, {})
            return {factor: min(ratio, alone[factor]) for factor, ratio in found.items()}
        return found

    def _rows_of(self, readings: Sequence[Measurement]) -> _Rows:
        """Rows of the meters read, but currents and dead voltmeters; kept as long as these meters stay the same."""
        used = [m.meter for m in readings if m.meter.kind.quantity is not Quantity.CURRENT]
        dead = {
            used[k]
            for k in find_dead(used, [m.value for m in readings if m.meter.kind.quantity is not Quantity.CURRENT])
        }
        read = tuple(meter for meter in used if meter not in dead)
        if self._rows is None or self._rows.read != read:
            self._rows = _Rows(self._area, self._reference, read, self._loads)
        return self._rows

    def _flat_start(self) -> np.ndarray:
        vm, va = self._area.find_no_load()
        return self._area.join_state(vm, va)


class _Rows:
    """Rows of a model of ``area``: the meters ``read``, then injections that only their schedules state."""

    def __init__(self, area: Area, reference: int | None, read: tuple[Meter, ...], loads: Mapping[Place, Load]) -> None:
        places = [(meter.kind, meter.bus, meter.phases) if meter.kind.of_injection else None for meter in read]
        unread = [place for place in loads if place not in set(places)]
        self.read = read
        self.meters = (*read, *(Meter(kind, bus, source=Source.PSEUDO, phases=phase) for kind, bus, phase in unread))
        self.is_virtual = np.array([meter.source is Source.VIRTUAL for meter in self.meters], dtype=bool)
        self.is_power = np.array([meter.kind.of_power for meter in self.meters], dtype=bool) & ~self.is_virtual
        self._is_injection = np.array([meter.kind.of_injection for meter in self.meters], dtype=bool)
        known = [
            loads.get(place) if place and meter.source is not Source.VIRTUAL else None
            for place, meter in zip(places, read, strict=True)
        ]
        self._joined = np.array([k for k, load in enumerate(known) if load], dtype=int)
        self._mean = np.array([load.mean for load in known if load])
        self._sigma = np.array([load.sigma for load in known if load])
        self._unread = [loads[place] for place in unread]
        self._n_nodes = area.network.n_nodes
        self.n_residuals = int((~self.is_virtual).sum()) + len(self._joined)
        z, sigma = np.zeros(len(self.meters)), np.ones(len(self.meters))
        self._model = build_area_model(area, self._list(_Hypothesis(z, sigma, 0.0)), reference)

    def put(self, readings: Sequence[Measurement]) -> tuple[np.ndarray, np.ndarray]:
        """Values and standard deviations of all rows, (n_meas,); of virtual ones 0 and 1."""
        by_meter = {m.meter: m for m in readings}
        used = [by_meter[meter] for meter in self.read]
        z = np.array([*(m.value for m in used), *(load.mean for load in self._unread)])
        sigma = np.array([*(m.sigma for m in used), *(load.sigma for load in self._unread)])
        return z, np.where(self.is_virtual, 1.0, sigma)

    def join(self, z: np.ndarray, sigma: np.ndarray) -> _Hypothesis:
        """Hypothesis of the readings; that of an injection and its expected load become one of their joint weight."""
        k, z, sigma = self._joined, z.copy(), sigma.copy()
        of_reading, of_load = sigma[k] ** -2, self._sigma**-2
        variance = sigma[k] ** 2 + self._sigma**2
        beside, spread = float(((z[k] - self._mean) ** 2 / variance).sum()), float(np.log(variance).sum())
        z[k] = (of_reading * z[k] + of_load * self._mean) / (of_reading + of_load)
        sigma[k] = (of_reading + of_load) ** -0.5
        return _Hypothesis(z, sigma, beside, spread)

    def count(self, multiplied: np.ndarray, factor: float, n_known: int) -> int:
        """Number of readings that count in the Jacobian.

        Where standard deviations may grow with the readings, redundant readings tell nothing of the factor. Without
        redundancy are at least the injections, or the flows, of which those of one kind at one branch count once. No
        more readings count than the ``n_known`` powers whose size schedules and neighbours state.
        """
        if abs(factor) <= 1:
            return int(multiplied.sum())
        at_branches = {
            (m.kind, m.branch) for m, is_one in zip(self.meters, multiplied, strict=True) if is_one and m.branch
        }
        return min(n_known, max(int((multiplied & self._is_injection).sum()), len(at_branches)))

    def count_apart(self, multiplied: np.ndarray, n_known: int) -> int:
        """Number of readings that count in the Jacobian of a factor above 1 and are joined with no expected load."""
        n_joined = int(multiplied[self._joined].sum())
        return max(0, self.count(multiplied, math.inf, n_known) - n_joined)

    def find_misfit(self, hypothesis: _Hypothesis, x: np.ndarray, received: Received) -> float:
        """M at ``x``; virtual measurements hold exactly and do not count."""
        model = self._model
        residual = model.model.subtract(hypothesis.z, model.predict(x))
        weighted = np.where(self.is_virtual, 0.0, residual / hypothesis.sigma)
        _, of_messages = model.rows.messages(x, received)
        return hypothesis.beside + float(weighted @ weighted) + sum(float(r @ r) for r in of_messages)

    def solve(self, hypothesis: _Hypothesis, x: np.ndarray, received: Received) -> float:
        """M: the least sum of squares; infinity where no state is found."""
        assert self._model.linear  # built here, so that the next model keeps the part that depends on meters only
        further = () if received else (VoltageReadings(x[: 2 * self._n_nodes]),)  # an area alone is not determined
        model = self._model.with_readings(self._list(hypothesis), further)
        try:
            for _ in range(MOST_STEPS):
                step = model.linear.step(x, received)
                x = x + step
                if abs(step[: 2 * self._n_nodes]).max() < LAST_STEP:
                    return self.find_misfit(hypothesis, x, received)
        except (ArithmeticError, np.linalg.LinAlgError, RuntimeError, ValueError):
            pass
        finally:
            model.end()
        return math.inf

    def _list(self, hypothesis: _Hypothesis) -> list[Measurement]:
        numbers = zip(self.meters, hypothesis.z.tolist(), hypothesis.sigma.tolist(), strict=True)
        return [Measurement(meter, value, sigma) for meter, value, sigma in numbers]


def _multiply(z: np.ndarray, sigma: np.ndarray, multiplied: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Readings and sigmas, (n_meas,), under ``factor``; above 1, it also multiplies sigmas below the reading's size."""
    grows = multiplied & (sigma < abs(z)) & (abs(factor) > 1)
    return np.where(multiplied, factor * z, z), np.where(grows, abs(factor) * sigma, sigma)
