"""Switches of a history: ties and branches that may be operated, and orders that are lost, cross, and meet kills."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from agents.messages.packing import Header, Incarnation, TelemetryMessage
from agents.protocol.events import Ordered
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from dsse_core.errors import DsseError
from dsse_core.grid.network import Branch, Network
from dsse_core.grid.nodes import Primitive, list_phases
from dsse_core.grid.primitives import build_line
from dsse_core.grid.switches import READ_AS, name_status_meter, name_statuses
from scenarios.telemetry import solve_with_supply

RTU = "rtu"  # gateway of the statuses that are read
REPEAT_S = 0.1
MOST_TIES = 3


def draw_switches(rng: np.random.Generator, network: Network) -> Network:
    """``network`` with 1 to 3 open ties, and 1 or 2 of its branches, which may be operated, all phases at once."""
    ids, buses = network.branch_ids, [bus.id for bus in network.buses]
    opened = set(rng.choice(len(ids), size=int(rng.integers(1, 3)), replace=False).tolist())
    branches = [replace(branch, switch=k in opened) for k, branch in enumerate(network.branches)]
    for k in range(int(rng.integers(1, MOST_TIES + 1))):
        tie = Branch(f"tie{k}", 0, 0, r=0.007, x=0.01, in_service=False, switch=True)
        one, other = rng.choice(buses, size=2, replace=False).tolist()
        while (primitive := _join(network, one, other)) is None:
            one, other = rng.choice(buses, size=2, replace=False).tolist()
        branches.append(replace(tie, from_bus=one, to_bus=other, primitive=primitive or None))
    return replace(network, branches=tuple(branches))


def _join(network: Network, *ends: int) -> Primitive | Literal[""] | None:
    """A line of the phases that both ends have, "" where buses have no phases; None where no line can join them."""
    if network.table.nodes.is_balanced:
        return ""
    one, other = map(network.bus, ends)
    phases = "".join(phase for phase in list_phases(one.phases) if phase in other.phases)
    if not phases or one.base_kv != other.base_kv:
        return None
    return build_line(phases, np.full((len(phases),) * 2, 0.003j) + np.eye(len(phases)) * (0.007 + 0.007j))


def draw_statuses(rng: np.random.Generator, network: Network, closed: Mapping[str, bool]) -> Mapping[str, bool]:
    """The statuses after one or two switches are operated; those before where the grid then has no power flow."""
    count = int(rng.integers(1, min(3, len(closed) + 1)))
    after = dict(closed) | {switch: not closed[switch] for switch in rng.choice([*closed], size=count, replace=False)}
    try:
        solve_with_supply(network.operated(after))
    except DsseError:
        return closed
    return after


@dataclass
class Operator:
    """The operator, who repeats orders until areas have written them, and the gateway of the statuses that are read.

    ``written``: area -> the order on its disk. ``loss``: probability that a repeat, or a status, is lost.
    """

    bus: SimulatedBus
    rng: np.random.Generator
    loss: float
    is_read: frozenset[str]
    wanted: dict[str, dict[str, bool]] = field(default_factory=dict)  # area -> switches as ordered
    status: dict[str, bool] = field(default_factory=dict)  # of those that are read
    written: dict[str, Ordered] = field(default_factory=dict)
    _sequence: int = 0

    def operate(self, area: str, switch: str, *, closed: bool) -> None:
        """Orders a switch, or has its status read from now on."""
        if switch in self.is_read:
            self.status[switch] = closed
        else:
            self.wanted.setdefault(area, {})[switch] = closed

    def restart(self, area: str) -> None:
        """Starts an area again, with the order that is on its disk."""
        self.bus.kill(area)
        self.bus.start(area)
        if area in self.written:
            self.bus.post(area, self.written[area], delay_s=0.0)

    def repeat(self) -> None:
        """Sends orders that are not written yet, and statuses, each of which may be lost."""
        for area, switches in self.wanted.items():
            is_written = area in self.written and self.written[area].switches == switches
            if is_written or area not in self.bus.protocols or self.rng.random() < self.loss:
                continue
            self._sequence += 1
            self.written[area] = Ordered((5, 6, self._sequence), (), switches=dict(switches))
            self.bus.post(area, self.written[area])
        for area, content in self.bus.files.items():
            own = name_statuses({s: c for s, c in self.status.items() if s in content.area.network.switches})
            if own and self.rng.random() >= self.loss:
                self._sequence += 1
                at = STARTED_AT + self.bus.now
                header = Header(content.run, RTU, Incarnation(1, 1), self._sequence, self._sequence, at)
                values, n = tuple(READ_AS[status] for status in own.values()), len(own)
                columns = tuple(map(name_status_meter, own)), values, (0.0,) * n, (at,) * n, (True,) * n
                self.bus.publish_readings(TelemetryMessage(header, area, *columns))
        self.bus.at(self.bus.now + REPEAT_S, self.repeat)


def draw_orders(
    rng: np.random.Generator,
    severity: float,
    bus: SimulatedBus,
    closed: Sequence[Mapping[str, bool]],
    times: Sequence[float],
) -> Operator:
    """Orders and statuses around the ``times`` of scans in which switches are ``closed``, some with a kill at once."""
    is_read = frozenset(switch for switch in closed[0] if rng.random() < 0.4)
    operator = Operator(bus, np.random.default_rng(rng.integers(2**32)), 0.5 * severity, is_read)
    holder = {switch: name for name, content in bus.files.items() for switch in content.area.network.switches}
    last: dict[str, float] = {}  # switch -> time of its last order
    for before, after, time in zip(closed, closed[1:], times, strict=False):
        for switch in after:
            if after[switch] == before[switch]:
                continue
            at = last[switch] = max(last.get(switch, 0.0) + 0.1, time + float(rng.uniform(-0.2, 0.4)))
            bus.at(at, partial(operator.operate, holder[switch], switch, closed=after[switch]))
            if rng.random() < 0.4 * severity:
                killed = at + float(rng.uniform(0.0, 0.15))
                bus.at(killed, partial(bus.kill, holder[switch]))
                bus.at(killed + float(rng.uniform(0.01, 0.8)), partial(operator.restart, holder[switch]))
    bus.at(REPEAT_S, operator.repeat)
    return operator
