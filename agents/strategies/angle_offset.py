"""``angle-offset``, the thesis's algorithm (section 4.1, steps 4-8), for any tree of areas.

Each area: (a) puts the net load beyond a boundary bus there as a load, (b) solves its power flow from its
local slack, which gives the starting point and a pseudo-measurement of the boundary injection, (c) runs
bad-data processing and WLS on its own telemetry, (d) shifts its angles by the difference to its parent's
angle at their boundary bus (eqs. 5.3, 5.8, 5.9). Magnitudes are not reconciled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from agents.messages.checks import Number, Numbers
from agents.messages.packing import BoundaryUpdate, Header
from agents.protocol.configuration import Configuration
from agents.strategies.interface import Estimate, Knowledge, Strategy
from dsse_core.errors import DsseError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.exchange.boundary_load import UNSURE_OF_LOAD, NetLoad, add_loads, boundary_loads, measured_net_loads
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.linear.boundary_information import are_within_reason
from dsse_core.power_flow.newton_raphson import solve_power_flow

FLOOR_MVA = 1e-3
SLACK_VOLTAGE_SIGMA = 0.01
CHANGE = 1e-9  # p.u., rad


@dataclass(frozen=True, slots=True)
class BoundaryMessage(BoundaryUpdate):
    """The sender's corrected state at a boundary bus, p.u. and rad.

    ``referenced``: the angle counts from the substation.
    """

    kind: ClassVar[str] = "boundary"
    vm: Number
    va: Number
    referenced: bool

    def falsified(self, falsify: Callable[[Numbers], Numbers]) -> Self:
        _, _, vm, va = falsify((0.0, 0.0, self.vm, self.va))
        return replace(self, vm=vm, va=va)


class AngleOffset(Strategy):
    """The state of one area between messages: its relative estimate, reused while only the offset changes."""

    message_types = (BoundaryMessage,)
    estimates_alone = True
    reconciles_magnitudes = False
    why_no_phases = "one offset turns all phases alike, and turning each by itself changes the flows of coupled lines"

    def __init__(self, content: Configuration) -> None:
        self._content = content
        self._area = content.area
        self._solved_for: object = None
        self._local: Estimate | None = None
        self._notes: tuple[str, ...] = ()

    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        parent = self._area.parent
        received = known.boundary.get(parent.area) if parent else None
        assert received is None or isinstance(received, BoundaryMessage)  # the protocol passes no other kind
        slack_vm = self._area.slack_vm if self._area.slack_vm is not None else received.vm if received else None
        inputs = (known.measurements, dict(known.loads), slack_vm)
        if inputs != self._solved_for:
            self._solved_for = inputs
            self._local, self._notes = self._estimate(known, slack_vm)
        if self._local is None:
            return None, self._notes
        return self._shift(self._local, received)

    @classmethod
    def local_meters(cls, area: Area, own: Sequence[Meter]) -> list[Meter]:
        """Meters of the local estimate: ``own`` ones and pseudo-measurements.

        At boundary buses the load messages, P and Q pseudo-measurements, stand in for injection meters. An area without
        voltage meter gets its local slack voltage as a pseudo-measurement. Only the substation's area uses angle
        meters.
        """
        kind = MeasurementKind
        boundary = area.boundary_buses
        meters = [m for m in own if not (m.kind.of_injection and m.bus in boundary)]
        if not area.is_reference:
            meters = [m for m in meters if not m.kind.needs_reference]
        injection = (kind.P_INJECTION, kind.Q_INJECTION)
        meters += [Meter(k, bus, source=Source.PSEUDO) for bus in boundary for k in injection]
        if not any(m.kind is kind.VM for m in meters):
            meters.append(Meter(kind.VM, area.slack_bus, source=Source.PSEUDO))
        return meters

    def find_rejection(self, message: BoundaryUpdate) -> str:
        assert isinstance(message, BoundaryMessage)
        possible = are_within_reason((message.vm, message.va)) and message.vm > 0
        return "" if possible else "numbers beyond reason"

    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> BoundaryMessage:
        row = self._area.network.row[neighbour.bus]
        return BoundaryMessage(
            header, neighbour.bus, float(estimate.vm[row]), float(estimate.va[row]), estimate.referenced
        )

    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        assert isinstance(message, BoundaryMessage)
        assert isinstance(last, BoundaryMessage)
        return (
            abs(message.vm - last.vm) > CHANGE
            or abs(message.va - last.va) > CHANGE
            or message.referenced != last.referenced
        )

    def _estimate(self, known: Knowledge, slack_vm: float | None) -> tuple[Estimate | None, tuple[str, ...]]:
        """Steps (a) to (c), angles relative to the local slack bus; None where the measurements allow no estimate."""
        loads = boundary_loads(self._area, known.loads, self._content.load_error)
        silent = [n.area for n in self._area.neighbours if n.area not in known.loads]
        notes = [f"no load message from {name} yet" for name in silent]
        reference, angle = self._reference()
        start = None
        if slack_vm is None:
            notes.append(f"no voltage from {self._area.parent.area} yet" if self._area.parent else "no slack voltage")
        elif not silent:
            try:
                flow = solve_power_flow(
                    self._area.network,
                    slack=(self._area.slack_bus, slack_vm),
                    extra_load={bus: load.s for bus, load in loads.items()},
                )
                start = (flow.vm, flow.va + angle - flow.va[self._area.network.row[reference]])
            except DsseError as error:
                notes.append(f"local power flow: {error}")
        measurements = self._local_measurements(known, loads, slack_vm)
        try:
            report = process_bad_data(
                self._area.network,
                measurements,
                reference=reference,
                start=start,
                tolerance=self._content.tolerance,
            )
        except DsseError as error:
            return None, (*notes, f"no estimate: {error}")
        if report.detected:
            notes.append(
                f"bad data detected but not identified: J = {report.objective:.4g}, limit {report.chi_square_limit:.4g}"
            )
        return _as_estimate(report), tuple(notes)

    def _reference(self) -> tuple[int, float]:
        """Bus and angle from which local angles count: the substation's, elsewhere 0 at the local slack bus."""
        slack = self._area.network.slack
        return (slack.bus, slack.va) if slack else (self._area.slack_bus, 0.0)

    def _local_measurements(
        self, known: Knowledge, loads: dict[int, NetLoad], slack_vm: float | None
    ) -> list[Measurement]:
        """Own telemetry, and pseudo-measurements of the injections at boundary buses, which count the network beyond.

        Angle meters count from the substation: only its own area, whose local angles do so too, can use them.
        """
        boundary = set(self._area.boundary_buses)
        chosen = [m for m in known.measurements if not (m.meter.kind.of_injection and m.meter.bus in boundary)]
        if not self._area.is_reference:
            chosen = [m for m in chosen if not m.meter.kind.needs_reference]
        telemetered = self._content.generation == "telemetered"
        own = measured_net_loads(self._area, known.measurements) if telemetered else {}
        for bus, beyond in loads.items():
            here = own.get(self._area.network.row[bus], NetLoad(-self._area.network.scheduled_injection(bus)))
            total = add_loads([here, beyond])
            s = -total.s
            sigma = math.hypot(UNSURE_OF_LOAD * abs(s), FLOOR_MVA / self._area.network.base_mva)
            sigma = math.hypot(sigma, math.sqrt(total.variance))
            for kind, value in ((MeasurementKind.P_INJECTION, s.real), (MeasurementKind.Q_INJECTION, s.imag)):
                chosen.append(Measurement(Meter(kind, bus, source=Source.PSEUDO), value, sigma))
        if slack_vm is not None and not any(m.meter.kind is MeasurementKind.VM for m in chosen):
            meter = Meter(MeasurementKind.VM, self._area.slack_bus, source=Source.PSEUDO)
            chosen.append(Measurement(meter, slack_vm, SLACK_VOLTAGE_SIGMA))
        return chosen

    def _shift(self, local: Estimate, received: BoundaryMessage | None) -> tuple[Estimate, tuple[str, ...]]:
        """Step (d): add the difference of boundary angles to all angles; the substation's area is the reference."""
        parent = self._area.parent
        if parent is None:
            return replace(local, referenced=True), self._notes
        if received is None or not received.referenced:
            return local, (*self._notes, f"angles are relative: no angle from {parent.area} yet")
        offset = received.va - local.va[self._area.network.row[parent.bus]]
        return replace(local, va=local.va + offset, referenced=True), self._notes


def _as_estimate(report: BadDataReport) -> Estimate:
    result = report.result
    sigma_vm, sigma_va = result.state_sigma()
    return Estimate(
        vm=result.vm,
        va=result.va,
        sigma_vm=sigma_vm,
        sigma_va=sigma_va,
        referenced=False,
        objective=report.objective,
        degrees_of_freedom=report.degrees_of_freedom,
        removed=tuple(removed.measurement.meter.id for removed in report.removed),
        critical=report.critical,
        undecided=report.undecided,
    )
