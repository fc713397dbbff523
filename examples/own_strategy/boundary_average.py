"""Strategy ``boundary-average``: each area estimates alone, then neighbours average the voltage of the bus they share.

Magnitudes: both sides of a boundary know the bus with a standard deviation; the mean weighs them by their variances. An
area moves all its magnitudes by the mean of its steps to the means at its boundaries. Angles: an area adds the
difference to its parent's angle, as ``angle-offset`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from agents.strategies import BoundaryUpdate, Configuration, Estimate, Header, Knowledge, Neighbour, Number, Strategy
from dsse_core.errors import DsseError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.partition import Area

CHANGE = 1e-9  # p.u. and rad: smaller changes are not worth a message


@dataclass(frozen=True, slots=True)
class VoltageMessage(BoundaryUpdate):
    """The shared bus as the sender sees it, p.u. and rad: ``own_vm`` with ``sigma`` from its own meters alone.

    ``referenced``: ``va`` counts from the substation.
    """

    kind: ClassVar[str] = "voltage"
    own_vm: Number
    sigma: Number
    va: Number
    referenced: bool


class BoundaryAverage(Strategy):
    """One area under ``boundary-average``."""

    message_types = (VoltageMessage,)
    estimates_alone = True  # so `dsse check` asks that each area is observable with its local_meters
    reconciles_magnitudes = False  # the two sides come closer; they do not become equal

    def __init__(self, content: Configuration) -> None:
        self._area = content.area
        self._measurements: tuple[Measurement, ...] = ()
        self._own: Estimate | None = None  # from the area's own meters alone

    @classmethod
    def local_meters(cls, area: Area, own: Sequence[Meter]) -> list[Meter]:
        """Meters of ``own`` that see nothing beyond the boundary: no injections there, no angles but in the reference
        area.
        """
        at_boundary = [m for m in own if m.kind.of_injection and m.bus in area.boundary_buses]
        angles = [m for m in own if m.kind is MeasurementKind.VA and not area.is_reference]
        return [m for m in own if m not in at_boundary and m not in angles]

    def solve(self, known: Knowledge) -> tuple[Estimate | None, tuple[str, ...]]:
        if known.measurements != self._measurements or self._own is None:
            self._measurements = known.measurements
            try:
                self._own = self._estimate_alone(known.measurements)
            except DsseError as error:
                self._own = None
                return None, (f"no estimate: {error}",)
        received = {name: m for name, m in known.boundary.items() if isinstance(m, VoltageMessage)}
        return self._correct(self._own, received), self._list_missing(received)

    def message_for(self, neighbour: Neighbour, estimate: Estimate, header: Header) -> VoltageMessage:
        assert self._own is not None
        row = self._area.network.row[neighbour.bus]
        own_vm, sigma = float(self._own.vm[row]), float(self._own.sigma_vm[row])
        return VoltageMessage(header, neighbour.bus, own_vm, sigma, float(estimate.va[row]), estimate.referenced)

    def is_update(self, neighbour: Neighbour, message: BoundaryUpdate, last: BoundaryUpdate) -> bool:
        assert isinstance(message, VoltageMessage)
        assert isinstance(last, VoltageMessage)
        moved = max(abs(message.own_vm - last.own_vm), abs(message.sigma - last.sigma), abs(message.va - last.va))
        return moved > CHANGE or message.referenced != last.referenced

    def find_rejection(self, message: BoundaryUpdate) -> str:
        assert isinstance(message, VoltageMessage)
        return "" if message.own_vm > 0 and message.sigma > 0 else "numbers beyond reason"

    def _estimate_alone(self, measurements: Sequence[Measurement]) -> Estimate:
        area = self._area
        usable = set(self.local_meters(area, [m.meter for m in measurements]))
        reference = area.reference[0] if area.reference else area.slack_bus
        result = estimate_state(area.network, [m for m in measurements if m.meter in usable], reference=reference)
        sigma_vm, sigma_va = result.state_sigma()
        return Estimate(
            vm=result.vm,
            va=result.va,
            sigma_vm=sigma_vm,
            sigma_va=sigma_va,
            referenced=area.is_reference,
            objective=result.objective,
            degrees_of_freedom=result.degrees_of_freedom,
            removed=(),
        )

    def _correct(self, own: Estimate, received: dict[str, VoltageMessage]) -> Estimate:
        """``own``, moved to the means at the boundaries and turned to the parent's angle."""
        row = self._area.network.row
        steps = []
        for message in received.values():
            vm, variance = own.vm[row[message.bus]], own.sigma_vm[row[message.bus]] ** 2
            share = variance / (variance + message.sigma**2)
            steps.append(share * (message.own_vm - vm))
        vm = own.vm + (sum(steps) / len(steps) if steps else 0.0)
        parent = self._area.parent
        above = received.get(parent.area) if parent else None
        if above is None or not above.referenced:
            return replace(own, vm=vm)
        return replace(own, vm=vm, va=own.va + above.va - own.va[row[above.bus]], referenced=True)

    def _list_missing(self, received: dict[str, VoltageMessage]) -> tuple[str, ...]:
        return tuple(f"no voltage from {n.area} yet" for n in self._area.neighbours if n.area not in received)
